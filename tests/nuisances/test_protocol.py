"""What every nuisance owes: a start that does nothing, a gate that no failed fit passes, its place in the list."""

import importlib
import inspect
import math
import pkgutil
from collections import defaultdict

import pytest
from docs_examples import run_page

from tomo_polysplat import nuisances
from tomo_polysplat.nuisances.detector_blur import BlurOfDetector
from tomo_polysplat.nuisances.drift import Drift
from tomo_polysplat.nuisances.filters import Filters
from tomo_polysplat.nuisances.gains import Gains
from tomo_polysplat.nuisances.known import NUISANCES
from tomo_polysplat.nuisances.light_gate import more_likely
from tomo_polysplat.nuisances.nuisance import Nuisance
from tomo_polysplat.nuisances.open_beam import OpenBeam
from tomo_polysplat.nuisances.pixel_light import PixelLight
from tomo_polysplat.nuisances.scatter import ScatteredLight
from tomo_polysplat.nuisances.tube_voltage import TubeVoltage
from tomo_polysplat.physics.spectrum import Spectrum


def test_every_nuisance_is_listed_and_no_two_share_a_parameter():
    found = set()
    for module in pkgutil.iter_modules(nuisances.__path__):
        of = importlib.import_module(f"tomo_polysplat.nuisances.{module.name}")
        found |= {kind for _, kind in inspect.getmembers(of, inspect.isclass) if issubclass(kind, Nuisance)}
    assert {kind for kind in found if not inspect.isabstract(kind)} == set(NUISANCES)
    names = [name for kind in NUISANCES for name in kind.parameters]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("kind", NUISANCES, ids=lambda kind: kind.name)
def test_at_its_start_nothing_is_told_and_a_failed_fit_confirms_nothing(kind):
    assert kind.told({}) == kind.told({name: one.start for name, one in kind.parameters.items()}) == ""
    assert all(one.unit and one.least <= one.start <= one.most for one in kind.parameters.values())
    assert kind.gauge and kind.cost
    verdict = kind.gate(defaultdict(lambda: math.nan))
    assert not verdict.kept and verdict.why


ERRORS = {"held_out_before": 1.0, "held_out_after": 0.9}
DARKEST = {"darkest_before": 1.0, "darkest_after": 0.9}


@pytest.mark.parametrize(
    ("evidence", "scatter", "beam"),
    [
        (ERRORS, True, True),
        (ERRORS | {"held_out_after": 0.98}, False, False),
        (ERRORS | DARKEST, True, True),
        # Scatter is what dark rays hold most of; a brighter beam leaves them as they were.
        (ERRORS | DARKEST | {"darkest_after": 1.01}, False, True),
        (ERRORS | DARKEST | {"held_out_rival": 0.9, "darkest_rival": 0.92}, False, False),
        (ERRORS | DARKEST | {"held_out_rival": 0.9, "darkest_rival": 0.99}, True, True),
        (ERRORS | DARKEST | {"held_out_rival": 1.4, "darkest_rival": 0.92}, True, True),
    ],
)
def test_more_light_has_to_explain_the_rays_better_than_what_looks_alike(evidence, scatter, beam):
    assert ScatteredLight.gate(evidence).kept is scatter
    assert OpenBeam.gate(evidence).kept is beam


def test_what_explains_far_more_of_the_rays_is_not_left_out_for_its_likeness():
    """Both leave half of the misfit: neither would be worse than either. Alike, it is the beam."""
    both = ERRORS | DARKEST | {"held_out_after": 0.5}
    assert more_likely(both, both) == more_likely(both | {"held_out_after": 0.49}, both) == "beam"
    assert more_likely(both | {"held_out_after": 0.47, "darkest_after": 0.89}, both) == "scatter"
    assert more_likely(both | {"held_out_after": 0.47, "darkest_after": 0.91}, both) == "beam"
    # Nothing false explains all rays far better than what is true, whatever a short fit makes of a few dark ones.
    assert more_likely(both | {"held_out_after": 0.3, "darkest_after": 1.4}, both) == "scatter"
    assert more_likely(both | {"held_out_after": 0.37, "darkest_after": 1.4}, both) == "beam"


def test_scatter_that_varies_and_explains_more_is_no_beam_whatever_the_darkest_rays_say():
    beam = ERRORS | DARKEST | {"held_out_after": 0.5}
    soft = beam | {"held_out_after": 0.47, "darkest_after": 1.5, "of_light": -0.1}
    assert more_likely(soft, beam) == "scatter"
    assert (
        more_likely(soft | {"of_light": 0.0}, beam)
        == more_likely(soft | {"held_out_after": 0.49}, beam)
        == "beam"
    )


def test_few_dark_rays_do_not_outweigh_all_others_where_the_beam_explains_these():
    far = ERRORS | DARKEST | {"held_out_after": 0.69, "darkest_after": 1.06}
    assert OpenBeam.gate(far).kept and not ScatteredLight.gate(far).kept
    assert not OpenBeam.gate(far | {"held_out_after": 0.75}).kept


@pytest.mark.parametrize(("rays", "share", "tell"), [(23, 0.1, False), (23, 0.3, True), (400, 0.1, True)])
def test_dark_rays_tell_where_scatter_in_them_would_stand_out_of_their_noise(rays, share, tell):
    told = {"darkest_rays": rays, "darkest_share": share}
    scatter = ERRORS | DARKEST | told | {"held_out_rival": 0.9, "darkest_rival": 1.4}
    assert ScatteredLight.gate(scatter).kept is tell
    # A brighter beam is not refused for what few rays with much light make of it.
    assert OpenBeam.gate(ERRORS | DARKEST | told | {"darkest_after": 1.5}).kept is not tell
    beam = scatter | {"darkest_after": 1.0}
    assert more_likely(scatter | {"held_out_after": 0.8}, beam) == ("scatter" if tell else "beam")


def test_a_rival_that_explains_the_darkest_rays_wholly_is_not_beaten():
    rival = ERRORS | DARKEST | {"held_out_rival": 0.9, "darkest_rival": 0.0}
    assert not ScatteredLight.gate(rival).kept


def test_rays_darker_than_scatter_exclude_it():
    assert ScatteredLight.gate(ERRORS | {"darker": 7, "rays": 1000}).kept
    assert not ScatteredLight.gate(ERRORS | {"darker": 8, "rays": 1000}).kept
    assert ScatteredLight.gate(ERRORS | {"darker": 8, "rays": 100_000}).kept


def test_scatter_is_suspected_where_the_beam_is_steady():
    shown = {"most": 0.02, "left": 0.9}
    assert ScatteredLight.suspected(shown | {"drift": 0.003}).kept
    for evidence in (shown | {"left": 0.98, "drift": 0.0}, shown, shown | {"drift": 0.01}):
        assert not ScatteredLight.suspected(evidence).kept


def test_a_known_density_is_believed_unless_the_rays_contradict_it():
    inside = {"factor": 1.1, "least": 0.8, "most": 1.25}
    assert Filters.gate(inside | ERRORS | {"held_out_after": 1.05}).kept
    assert not Filters.gate(inside | ERRORS | {"held_out_after": 1.15}).kept
    assert not Filters.gate(inside | ERRORS | {"factor": 1.2499}).kept


def test_a_voltage_ends_where_tables_of_tubes_do():
    low, high = TubeVoltage.bounds(Spectrum.from_tube(400, filters={"Al": 0.1}))
    assert low == 0.8 and 1.0 < high < 1.25


def test_reports_tell_of_each():
    assert BlurOfDetector.told({"blur": 0.25}).startswith("a detector that blurs by 0.5 pixels")
    assert PixelLight.told({"pixel_rays": 2}) and TubeVoltage.told({"kvp": 1.1}).endswith("1.1 times as told")


def test_the_example_of_the_docs_runs():
    blocks, names = run_page("nuisances.md")
    assert len(blocks) == 2
    names["test_a_lag_is_kept_where_the_held_out_rays_fit_better"]()


@pytest.mark.parametrize("kind", [Drift, Gains])
def test_light_is_corrected_where_that_is_sure_and_worth_it(kind):
    """Very many rays are sure of what changes nothing."""
    assert kind.gate({"rms": 1e-2, "better": 0.02, "error": 0.005}).kept
    assert not kind.gate({"rms": 1e-2, "better": 0.02, "error": 0.01}).kept
    assert not kind.gate({"rms": 2e-5, "better": 2e-4, "error": 1e-5}).kept
