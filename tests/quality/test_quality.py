"""Resolution and contrast of results, told without a truth and compared with one."""

from dataclasses import replace

import numpy as np
import pytest
from small_scans import cone, fan, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.quality.halves import compared
from tomo_polysplat.quality.inserts import ball_in_voxels, paths_through_balls, places_for_balls, with_balls
from tomo_polysplat.quality.refit import fit_again, settings_of
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.start.joseph import JosephProjector

# What pixels and source did to the light is asked in other files.
LIGHT = {"gains": False, "drift": False}
SHORT = {"passes": 6.0, "views_per_step": 2, "tv_factor": 1.0, "edges": "blurred", "growth": 1.0} | LIGHT


@pytest.fixture(scope="module")
def result():
    return reconstruct(fan(), settings=SHORT, align=False)


@pytest.fixture(scope="module")
def found(result):
    return tps.resolution(result, fan())


def test_halves_of_the_views_tell_a_resolution_and_where_they_disagree(result, found):
    assert 2 <= found.period / found.voxel < 8 and found.doubt.shape == (1, 48, 48)
    assert found.describe().startswith("Two halves of the views agree") and found.seconds > 0
    wrong = np.abs(result.volume - fan().truth)
    doubtful = found.doubt > np.median(found.doubt)
    assert wrong[doubtful].mean() > 2 * wrong[~doubtful].mean()


def test_noise_is_told_by_the_difference_of_halves(result):
    """Volumes of known noise: the mean of both has 1 / sqrt(2) of that of each."""
    rng, shape = np.random.default_rng(0), result.volume.shape
    halves = [result.volume + 0.01 * rng.standard_normal(shape) for _ in range(2)]
    assert np.sqrt((compared(result, halves, 0.0).doubt ** 2).mean()) == pytest.approx(
        0.01 / np.sqrt(2), rel=0.1
    )


def test_what_was_decided_is_not_asked_again(result):
    plan = result.plan | {
        "growth": Answer(2.5, "", Status.ASKED),
        "closer_seeds": Answer(0.9, "", Status.ASKED),
    }
    chosen = settings_of(replace(result, plan=plan))
    assert chosen["closer_seeds"] == 0.9 and chosen["growth"] == 1.0, "what was asked for stays"
    again = reconstruct(fan(), settings=settings_of(result), align=False)
    assert np.array_equal(again.volume, result.volume)
    assert all(again.plan[name].status is Status.GIVEN for name in ("seed_spacing", "passes", "tv_factor"))


def test_the_scanner_is_the_one_that_the_result_was_made_with(result, monkeypatch):
    """Where the axis was mended, and behind the scan's filter."""
    told = {}

    def remember(_, proj_geom, *__, **options):
        told.update(options, proj_geom=proj_geom)
        return result

    monkeypatch.setattr("tomo_polysplat.quality.refit.reconstruct", remember)
    scan = replace(fan(), filter_map=("Al", np.full((1, fan().projections.shape[2]), 0.1)))
    fit_again(result, scan)
    assert told["filter_map"] is scan.filter_map and told["proj_geom"] is scan.proj_geom
    fit_again(replace(result, plan=result.plan | {"mended": Answer.found("the axis", "")}), scan)
    assert told["proj_geom"] is result.geometry is not None


def test_faint_balls_keep_a_share_of_their_contrast(result):
    found = tps.contrast(result, fan(), diameters=(3.0, 6.0))
    assert found.added == 0.05 and np.isfinite(found.kept).all()
    assert (found.kept > -0.1).all() and (found.kept < 1.2).all() and found.kept[1] > 0.2
    assert "keeps" in found.describe()


@pytest.mark.parametrize("kind", ["cone", "fan", "parallel"])
def test_paths_through_balls_are_those_of_a_voxel_projector(kind):
    scan = cone(metal=False) if kind == "cone" else fan(False)
    if kind == "parallel":
        scan = tps.simulate_scan("pins", size=24, views=12, geometry="parallel")
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    radius = 4.3 * float(grid.voxel_size[0])
    centre = grid.centre + [radius / 2, -radius / 3, 0.0]
    paths = paths_through_balls(geometry, [(centre, radius)])
    volume = ball_in_voxels(grid, centre, radius)
    seen = JosephProjector(geometry, grid).forward(volume, np.arange(geometry.views))
    assert paths.sum() == pytest.approx(seen.sum(), rel=0.02)
    assert np.abs(paths - seen).max() < 0.5 * radius and paths.max() <= 2 * radius * 1.0001


def test_balls_are_where_there_is_matter_and_apart(result):
    grid = result.grid
    volume = result.volume
    radii = np.array([1.5, 3.0]) * float(grid.voxel_size[0])
    balls = places_for_balls(volume, result, radii, 0)
    assert len(balls) > 4 and balls[0][1] == radii[1]
    for k, (centre, radius) in enumerate(balls):
        inside = ball_in_voxels(grid, centre, radius) > 0
        assert volume[inside].min() > 0.4 * np.median(volume[inside])
        for other, its in balls[:k]:
            assert np.linalg.norm(centre - other) > radius + its


def test_thin_matter_on_the_way_of_a_ray_adds_its_attenuation_there():
    """Behind nothing, where soft photons are left, it counts for more than behind much matter."""
    scan = cone(metal=True)
    found = reconstruct(scan, settings={"passes": 1.0})
    paths = np.full((scan.views, scan.rows, scan.columns), 1e-3, np.float32)
    rise = (with_balls(scan, found, paths, 0.2) - scan.projections)[np.isfinite(scan.projections)]
    depth = scan.projections[np.isfinite(scan.projections)]
    thin, thick = rise[np.abs(depth) < 0.02].mean(), rise[depth > 2].mean()
    assert 0.8 * 2e-4 < thick < 2e-4 < thin < 1.5 * 2e-4


@pytest.mark.parametrize(("kind", "word"), [("few", "views"), ("other", "scan")])
def test_what_cannot_be_told_is_refused(result, kind, word):
    scan = cone() if kind == "other" else fan()
    if kind == "few":
        vectors = scan.proj_geom["Vectors"][:12]
        scan = replace(
            scan, projections=scan.projections[:, :12], proj_geom=scan.proj_geom | {"Vectors": vectors}
        )
    with pytest.raises(ValueError, match=word):
        tps.resolution(result, scan)


def test_the_report_has_a_section_on_it(result, found, tmp_path):
    result.report(tmp_path / "a.html", resolution=found)
    page = (tmp_path / "a.html").read_text()
    assert "How fine, and how faint" in page and found.describe()[:40] in page
    result.report(tmp_path / "b.html")
    assert "How fine" not in (tmp_path / "b.html").read_text()


def test_what_was_not_fitted_or_is_of_another_unit_is_refused(result):
    """Half a fit of Gaussians would tell nothing of a volume by FDK."""
    plain = tps.baselines.fdk(fan())
    for judge in (tps.resolution, tps.contrast):
        with pytest.raises(ValueError, match="Gaussians were fitted.*reconstruct"):
            judge(plain, fan())
        with pytest.raises(ValueError, match="the scan of the result"):
            judge(result, replace(fan(), unit="mm"))
