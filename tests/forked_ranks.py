"""Processes that share out a fit, forked from this one: they have at once what takes others seconds to load."""

import os
import signal
import sys
import traceback
from contextlib import contextmanager
from unittest import mock

import torch.distributed as dist

from tomo_polysplat import cli, rank_processes
from tomo_polysplat.fit import follow


class _Forked:
    """What `subprocess.Popen` is asked for here, of a follower."""

    def __init__(self, command, *, env, **_):
        assert command[:3] == [sys.executable, "-m", "tomo_polysplat.fit.follow"]
        assert not dist.is_initialized(), "a fork would take this process for itself"
        heard, told = os.pipe()
        self.returncode, self.pid = None, os.fork()
        if not self.pid:
            self._follow(command[3:], env, heard, told)
        os.close(heard)
        self.stdin = os.fdopen(told, "wb")

    @staticmethod
    def _follow(arguments, environment, heard, told):
        status = 1
        try:
            os.dup2(heard, 0)
            os.close(told)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.environ.update(environment)
            status = follow.main(*arguments)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)

    def poll(self):
        if self.returncode is None:
            done, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if done else None
        return self.returncode

    def kill(self):
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)

    def wait(self):
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.returncode


@contextmanager
def forked_followers():
    """Whoever begins to follow meanwhile is forked."""
    with mock.patch.object(rank_processes.subprocess, "Popen", _Forked):
        yield


def torchrun(arguments, logs, count=2):
    """The command line in processes of torchrun's own launcher, which it forks; their output goes to files.

    To be called in a child: the launcher answers signals in its own way from then on.
    """
    from torch.distributed.elastic.multiprocessing import DefaultLogsSpecs, Std
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=count,
        start_method="fork",
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
        logs_specs=DefaultLogsSpecs(log_dir=str(logs), redirects=Std.ALL),
    )
    statuses = elastic_launch(config, cli.main)(arguments)
    return max(statuses.values())
