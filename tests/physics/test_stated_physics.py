"""Filters, detectors and anodes in words: what they mean, what is told where they are left out, what is refused."""

import logging

import numpy as np
import pytest

from tomo_polysplat.physics.detector import Detector
from tomo_polysplat.physics.filter_text import require_filters
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum


@pytest.mark.parametrize(
    ("text", "filters"),
    [
        ("Al 1mm", {"Al": 0.1}),
        ("Al:0.1", {"Al": 0.1}),
        ("1 mm Al and Cu:0.01", {"Al": 0.1, "Cu": 0.01}),
        ("Al 0.5mm + Al 500um", {"Al": 0.1}),
        ("ti6al4v 0.3mm", {"ti6al4v": 0.03}),
        ("none", {}),
    ],
)
def test_filters_in_words_are_those_in_numbers(text, filters):
    assert require_filters("filters", text) == pytest.approx(filters)
    told, given = (Spectrum.from_tube(90, filters=f, detector="counting") for f in (text, filters))
    np.testing.assert_allclose(told.weights, given.weights, rtol=1e-12)


def test_a_detector_by_name_absorbs_as_the_law_says():
    energies = np.array([25.0, 60.0, 90.0])
    absorbed = 1 - np.exp(-4.51 * 0.06 * mass_attenuation("CsI", energies))
    np.testing.assert_allclose(Detector.named("csi:0.6mm").response(energies), energies * absorbed)
    counted = 1 - np.exp(-5.85 * 0.1 * mass_attenuation("CdTe", energies))
    named = Detector.named("CdTe:1mm:30keV")
    np.testing.assert_allclose(named.response(energies), counted * (energies > 30))
    assert Detector.named("gos:200um") == Detector.energy_integrating("gadolinium oxysulfide", 0.02)
    assert Detector.named("counting:Ge:0.3") == Detector.photon_counting("Ge", 0.3)
    assert Detector.named("counting") == Detector.photon_counting()
    assert Detector.named("integrating") == Detector.energy_integrating(None)


def test_a_flat_panel_sees_a_harder_beam_than_one_that_counts():
    """The order of mean energies at 90 kV: soft photons count for less where the energy is integrated."""
    means = [
        Spectrum.from_tube(90, filters="Al 1mm", detector=named).effective_energy
        for named in ("silicon:0.3mm", "counting", "csi:0.6mm", "integrating")
    ]
    assert np.all(np.diff(means) > 1.0)


@pytest.mark.parametrize("given", [{}, {"detector": "counting"}, {"detector": Detector.named("gos:0.2mm")}])
def test_a_detector_that_nobody_named_is_told(given, caplog):
    with caplog.at_level(logging.WARNING):
        Spectrum.from_tube(90, "tungsten", "Al 1mm", **given)
    assert ("detector='csi:0.6mm'" in caplog.text) == (not given) == bool(caplog.records)


def test_a_thick_filter_without_a_unit_is_told(caplog):
    with caplog.at_level(logging.WARNING):
        assert require_filters("--filter", "Al:1") == {"Al": 1.0}
    assert "1 cm thick" in caplog.text and "write Al 1mm" in caplog.text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Al", "--filter: expected a material and its thickness, got 'Al'; .* 'Al 1mm'"),
        ("Al 1", "expected a material and its thickness, got 'Al 1'"),
        ("Al 1 inch", "a material and its thickness"),
        ("Al:-1", "a material and its thickness"),
        ("Al:nan", "a material and its thickness"),
        ("", "got ''; .* or 'none'"),
        ("Unobtainium 1mm", "--filter: expected a known material, got 'Unobtainium 1mm'"),
        ("Alu:0.1", "did you mean"),
    ],
)
def test_what_is_no_filter_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        require_filters("--filter", text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("film", "expected counting, integrating, or one of csi, gos"),
        ("csii", "did you mean csi"),
        ("csi:0.6", "a thickness with its unit, got 'csi:0.6'; write csi:0.6mm"),
        ("csi:thick", "expected a length, got 'thick'"),
        ("csi:0mm", "a known material of some thickness"),
        ("csi:0.6mm:20", "expected NAME:THICKNESS"),
        ("cdte:1mm:high", "a threshold in keV"),
        ("integrating:Unob:1mm", "did you mean Nb"),
        ("counting:Ge", "with its thickness"),
    ],
)
def test_what_is_no_detector_is_refused(text, message):
    with pytest.raises(ValueError, match=f"^--detector: .*{message}"):
        Detector.named(text, "--detector")
