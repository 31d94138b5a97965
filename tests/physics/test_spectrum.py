"""Tube spectra against SpekPy and published half-value layers; the laws a spectrum obeys."""

import json
import pickle

import numpy as np
import pytest

from tomo_polysplat.physics.detector import Detector
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.tube_tables import anodes, tube_counts, voltage_range

# NIST mass energy-absorption of air: keV, cm2/g.
AIR = np.array(
    [(5, 39.31), (6, 22.7), (8, 9.446), (10, 4.742), (15, 1.334), (20, 0.5389), (30, 0.1537), (40, 0.06833)]
    + [
        (50, 0.04098),
        (60, 0.03041),
        (80, 0.02407),
        (100, 0.02325),
        (150, 0.02496),
        (200, 0.02672),
        (300, 0.02872),
    ]
).T


def half_value_layer(spectrum):
    """Millimetres of aluminium that halve the air kerma."""
    energies = spectrum.energies
    kerma = spectrum.weights * energies * np.exp(np.interp(np.log(energies), *np.log(AIR)))
    thickness = np.linspace(0.0, 3.0, 3001)
    mu = 2.699 * mass_attenuation("Al", energies)
    return 10 * np.interp(-0.5, -(np.exp(-np.outer(thickness, mu)) @ kerma) / kerma.sum(), thickness)


# kVp, anode, filters in cm, then mean energy (keV) and first half-value layer (mm Al) by SpekPy 2.5.4 itself
# with 0.5 keV bins and its own attenuation data. Half of the voltages lie between those of the
# packaged tables.
SPEKPY = [
    (90.0, "W", {"Al": 0.1}, 42.108, 1.8238),
    (92.3, "W", {"Al": 0.1}, 42.827, 1.8773),
    (72.5, "W", {"Al": 0.2}, 39.260, 2.1816),
    (120.0, "W", {"Al": 0.25}, 54.439, 4.2192),
    (122.5, "W", {"Al": 0.25}, 55.045, 4.3124),
    (222.5, "W", {"Cu": 0.1}, 104.004, 14.7799),
    (33.0, "W", {"Al": 0.05}, 20.203, 0.3504),
    (33.0, "Mo", {"Mo": 0.003}, 17.225, 0.3220),
    (45.0, "Ag", {"Al": 0.03}, 22.163, 0.4201),
    (237.5, "W", {"Cu": 0.1}, 107.789, 15.1734),
    (437.5, "W", {"Cu": 0.4}, 196.989, 21.4336),
    (41.0, "Au", {"Al": 0.05}, 22.420, 0.3276),
    (21.0, "Mo", {"Al": 0.01}, 12.340, 0.0899),
]


@pytest.mark.parametrize(("kvp", "anode", "filters", "mean", "layer"), SPEKPY)
def test_agrees_with_spekpy(kvp, anode, filters, mean, layer):
    spectrum = Spectrum.from_tube(kvp, anode, filters)
    assert spectrum.effective_energy == pytest.approx(mean, rel=4e-3)
    assert half_value_layer(spectrum) == pytest.approx(layer, rel=0.01)


def test_half_value_layer_of_a_standard_beam():
    # IEC 61267 RQR 9: 120 kV whose half-value layer is 5.00 mm Al, reached with about 3.5 mm Al in all.
    assert half_value_layer(Spectrum.from_tube(120, filters={"Al": 0.35})) == pytest.approx(5.0, rel=0.05)


def test_no_photons_above_the_voltage():
    for anode in anodes():
        low, high = voltage_range(anode)
        for kvp in (low, low + 0.7, 0.5 * (low + high) + 0.3, high):
            energies, counts = tube_counts(kvp, anode)
            assert energies[-1] < kvp
            assert np.all(counts >= 0) and np.all(np.isfinite(counts))


def test_characteristic_lines_keep_their_photons_and_energy():
    # Tungsten's K-alpha lines over a straight base; there are none below the K edge at 69.5 keV.
    def lines(kvp):
        energies, counts = tube_counts(kvp)
        window = (energies > 55) & (energies < 62)
        base = np.interp(energies[window], [55.5, 61.5], np.interp([55.5, 61.5], energies, counts))
        excess = counts[window] - base
        return excess.sum(), (excess @ energies[window]) / excess.sum()

    photons, centre = lines(120.0)
    assert centre == pytest.approx(58.84, abs=0.1)  # intensity-weighted K-alpha, 57.98 and 59.32 keV
    assert lines(68.0)[0] < 0.01 * photons
    middle = [lines(kvp)[0] for kvp in (120.0, 122.5, 125.0)]
    assert middle[1] == pytest.approx(0.5 * (middle[0] + middle[2]), rel=4e-3)


def test_yield_is_continuous_in_the_voltage():
    totals = [tube_counts(kvp)[1].sum() for kvp in (89.99, 90.0, 90.01)]
    np.testing.assert_allclose(totals, totals[1], rtol=1e-3)


def test_filters_harden_and_compose():
    bare = Spectrum.from_tube(90, filters={"Al": 0.1})
    means = [bare.filtered({"Cu": t}).effective_energy for t in (0.0, 0.01, 0.05, 0.5)]
    assert np.all(np.diff(means) > 0.5)
    assert means[0] == pytest.approx(bare.effective_energy)
    twice = bare.filtered({"Cu": 0.02}).filtered({"Cu": 0.03})
    np.testing.assert_allclose(twice.weights, bare.filtered({"Cu": 0.05}).weights, rtol=1e-9)
    with_density = bare.filtered({"aluminium": (0.1, 2.7)}).weights
    np.testing.assert_allclose(with_density, bare.filtered({"Al": 0.1}).weights, rtol=1e-6)


def test_a_filter_too_thick_for_floats_leaves_its_hardest_photons():
    spectrum = Spectrum.from_tube(60).filtered({"Pb": 20.0})
    assert spectrum.effective_energy > 58
    assert spectrum.weights.sum() == pytest.approx(1.0)


def test_detector_weighs_by_energy():
    counted = Spectrum.from_tube(90, filters={"Al": 0.1})
    ideal = Spectrum.from_tube(90, filters={"Al": 0.1}, detector=Detector.energy_integrating(None))
    np.testing.assert_allclose(ideal.weights, counted.weights * counted.energies / counted.effective_energy)
    panel = Spectrum.from_tube(90, filters={"Al": 0.1}, detector=Detector.energy_integrating("CsI", 0.06))
    assert counted.effective_energy < panel.effective_energy < 60
    assert "CsI" in panel.label


def test_measured_spectrum_is_sorted_merged_and_normalised():
    spectrum = Spectrum([60.0, 20.0, 40.0, 20.0, 0.0], [2, 1, 4, 1, 0])
    np.testing.assert_array_equal(spectrum.energies, [20, 40, 60])
    np.testing.assert_allclose(spectrum.weights, [0.25, 0.5, 0.25])
    assert spectrum.effective_energy == pytest.approx(40.0)
    with pytest.raises(ValueError, match="read-only"):
        spectrum.weights[0] = 1.0


def test_monochromatic():
    spectrum = Spectrum.monochromatic(60)
    assert spectrum.is_monochromatic
    assert spectrum.effective_energy == 60.0
    assert spectrum.sampled(15) == spectrum
    assert not Spectrum([20, 60], [1, 1]).is_monochromatic


def test_plain_sampling_approaches_the_spectrum():
    spectrum = Spectrum.from_tube(90, filters={"Al": 0.1})
    assert spectrum.sampled(15).energies.size == 15
    np.testing.assert_allclose(np.diff(spectrum.sampled(15).energies, 2), 0.0, atol=1e-9)
    assert spectrum.sampled(400).effective_energy == pytest.approx(spectrum.effective_energy, rel=2e-3)
    assert spectrum.sampled(1).effective_energy == pytest.approx(spectrum.effective_energy)


def test_survives_json_and_pickle():
    spectrum = Spectrum.from_tube(75.5, filters={"Al": 0.1}, detector=Detector.energy_integrating())
    assert Spectrum.from_dict(json.loads(json.dumps(spectrum.to_dict()))) == spectrum
    assert pickle.loads(pickle.dumps(spectrum)) == spectrum
    assert "75.5 kVp" in repr(spectrum) and "effective" in spectrum.describe()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Spectrum.from_tube(19), "20-450 kVp"),
        (lambda: Spectrum.from_tube(451), "20-450 kVp"),
        (lambda: Spectrum.from_tube(80, "Mo"), "20-50 kVp"),
        (lambda: Spectrum.from_tube(90, "Xe"), "anode"),
        (lambda: Spectrum.from_tube(90, filters={"Alu": 0.1}), "material"),
        (lambda: Spectrum.from_tube(90, filters={"Al": -0.1}), "filters"),
        (lambda: Spectrum.from_tube(40, detector=Detector.photon_counting(threshold_kev=50)), "threshold"),
        (lambda: Spectrum([20, 30], [1, -1]), "negative"),
        (lambda: Spectrum([20, 30], [0, 0]), "only zeros"),
        (lambda: Spectrum([20, np.nan], [1, 1]), "NaN"),
        (lambda: Spectrum([20, 30, 40], [1, 1]), "one weight for each"),
        (lambda: Spectrum([20e3, 30e3], [1, 1]), "divide by 1000"),
        (lambda: Spectrum([], []), "at least one"),
        (lambda: Spectrum.monochromatic(0), "kev"),
        (lambda: Spectrum.from_dict({"weights": [1]}), "energies_kev"),
    ],
)
def test_clear_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()
