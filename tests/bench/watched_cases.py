"""Hard cases that end in every way there is; a process that runs them imports nothing heavy for it."""

import os
import time

import numpy as np

from tomo_polysplat.bench.hard_cases.case import Findings


def good(device):
    findings = Findings()
    findings.at_most("error", 0.5, 1.0)
    findings.equal("device", device, "cpu")
    return findings


def bad(device):
    findings = Findings()
    findings.at_most("error", 1.5, 1.0)
    return findings


def noisy(device):
    np.zeros(1) / np.zeros(1)
    return good(device)


def crashing(device):
    os._exit(11)


def hanging(device):
    time.sleep(600)
