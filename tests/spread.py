"""How the tests are spread over the workers of ``-n``: long files first, the notebooks one by one.

A file that begins last and takes a minute leaves the other worker idle for as long.
"""

from xdist.scheduler import LoadFileScheduling

# Their tests share nothing, so each may go to another worker.
SPLIT = ("tests/test_notebooks.py",)
# Files that go on in the worker of another one, which has compiled most of what they need.
AFTER = {"tests/simulate/test_chords.py": "tests/bench/test_bench_hard.py"}
# Files that take longest, the longest first; the order of the others does not matter. Of the first four only the second
# runs kernels of numba's: the other worker goes through the rest of them meanwhile, so that these are compiled once.
LONGEST = (
    "tests/kernels/test_triton.py",
    "tests/bench/test_bench_hard.py",
    "tests/scan/test_hdf5_stored.py",
    "tests/test_package.py",
    "tests/test_several_devices.py",
    "tests/plan/test_scatter_search.py",
    "tests/plan/test_tv_factor.py",
    "tests/start/test_fdk.py",
    "tests/test_threads.py",
    "tests/scan/test_check.py",
    "tests/bench/test_bench_physics.py",
    "tests/fuzz/test_fuzz.py",
    "tests/test_reconstruct.py",
    "tests/baselines/test_baselines.py",
    "tests/plan/test_align.py",
    "tests/plan/test_edges.py",
    "tests/test_reconstruct_filter_map.py",
    "tests/plan/test_pixel_rays.py",
    "tests/plugins/test_tomopy.py",
    "tests/plan/test_axis_by_fits.py",
    "tests/test_process_state.py",
    "tests/test_checkpoint.py",
    "tests/test_reconstruct_control.py",
    "tests/test_reconstruct_inputs.py",
    "tests/test_reconstruct_smooth.py",
    "tests/test_readme.py",
    "tests/plan/test_steady_light.py",
    "tests/scan/test_scanner_folders.py",
    "tests/bench/test_bench_ablation.py",
    "tests/plan/test_calibration.py",
    "tests/physics/test_quadrature.py",
    "tests/plan/test_never_worse.py",
    "tests/plan/test_early_light.py",
    "tests/bench/test_bench_recon.py",
    "tests/simulate/test_artefacts.py",
    "tests/scan/test_axis_offset.py",
    "tests/scan/test_counts_memory.py",
    "tests/result/test_residuals.py",
    "tests/plan/test_plan.py",
    "tests/plan/test_light.py",
    "tests/test_interruptions.py",
    "tests/bench/test_bench_accuracy.py",
    "tests/plan/test_realignment.py",
    "tests/baselines/test_of_scan.py",
    "tests/quality/test_quality.py",
    "tests/plan/test_unit_check.py",
    "tests/bench/test_bench_scale.py",
    "tests/fit/test_long_object.py",
    "tests/fuzz/test_campaign.py",
    "tests/test_texts.py",
    "tests/test_reconstruct_view_order.py",
    "tests/test_reconstruct_fat.py",
    "tests/result/test_report.py",
    "tests/test_safe_writing.py",
    "tests/fit/test_metal_numbers.py",
    "tests/scan/test_nxtomo.py",
    "tests/scan/test_skyscan.py",
    "tests/fuzz/test_hdf5_bombs.py",
    "tests/kernels/test_project.py",
    "tests/nuisances/test_alignment.py",
    "tests/plan/test_expected.py",
    "tests/plan/test_seed_spacing.py",
    "tests/start/test_initial.py",
    "tests/test_notebooks.py",
)


def begin_with_the_longest(items) -> None:
    """Sort collected tests by their file's place in ``LONGEST``; the others keep their order behind them."""
    place = {name: float(k) for k, name in enumerate(LONGEST)}
    place |= {name: place[other] + 0.5 for name, other in AFTER.items()}
    items.sort(key=lambda item: place.get(item.nodeid.split("::", 1)[0], len(LONGEST)))


class LongestFirst(LoadFileScheduling):
    """Files to workers in the order of the tests, and not by the number of tests in them."""

    def __init__(self, config, log=None):
        super().__init__(config, log)
        config.option.loadscopereorder = False

    def _split_scope(self, nodeid):
        scope = super()._split_scope(nodeid)
        return nodeid if scope in SPLIT else AFTER.get(scope, scope)
