"""The Triton kernels: their logic in Triton's interpreter on the CPU, the kernels themselves on a GPU."""

import numpy as np
import pytest
import torch
from triton_cases import CASES
from triton_interpreter import interpret

from tomo_polysplat.kernels import spatial_order as module
from tomo_polysplat.kernels.spatial_order import spatial_order
from tomo_polysplat.kernels.views import DetectorViews


@pytest.fixture(scope="module")
def interpreted() -> dict[str, str]:
    return interpret(CASES)


@pytest.mark.parametrize("name", CASES)
def test_in_the_interpreter(name, interpreted):
    assert name not in interpreted, interpreted[name]


def test_spatial_order_keeps_neighbours_together(monkeypatch):
    """Groups of 32 along the curve span a small part of the volume; one Gaussian or none is no matter."""
    position = torch.rand((32 * 64, 3), generator=torch.Generator().manual_seed(0)) - 0.5
    order = spatial_order(position)
    assert torch.equal(order.sort().values, torch.arange(len(position)))
    groups = position[order].reshape(64, 32, 3)
    # 64 groups of a unit cube in cells of side 1/4 each.
    assert (groups.amax(1) - groups.amin(1)).mean() < 0.35
    # No leap between any two that follow each other, in a cube and in planes of eight cells along an edge.
    grid = torch.cartesian_prod(*[torch.arange(8.0)] * 3)
    for cells in (grid, *(grid[grid[:, k] == 3] for k in range(3))):
        assert (cells[spatial_order(cells)].diff(dim=0).abs().sum(1) == 1).all()
    monkeypatch.setattr(module, "_AT_ONCE", 100)
    assert torch.equal(spatial_order(position), order), "whatever is placed at once"
    assert spatial_order(torch.ones(5, 3)).tolist() == [0, 1, 2, 3, 4]
    assert spatial_order(position[:0]).tolist() == []
    assert spatial_order(position[:1]).tolist() == [0]


@pytest.mark.gpu
@pytest.mark.parametrize("name", CASES)
def test_on_the_gpu(name):
    CASES[name]("cuda")


@pytest.mark.gpu
def test_more_pixels_than_32_bits_count():
    """The last of three views lies beyond 2^31 pixels; alone it does not."""
    from tomo_polysplat.kernels.project.triton_kernel import project

    if torch.cuda.mem_get_info()[0] < 60e9:
        pytest.skip("needs 60 GB of GPU memory")
    size = 28000
    step_u, step_v, ahead = np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.array([0, 1.0, 0])
    matrix = np.stack([step_u, step_v, ahead], axis=1)
    views = DetectorViews(False, np.zeros((3, 3)), np.stack([matrix] * 3), size, size)
    results = []
    for some in (views, views.select([2])):
        scene = [
            torch.tensor([[size - 9.0, 0, size - 7.0]], device="cuda"),
            torch.full((1, 3), 2.0, device="cuda"),
            torch.tensor([[1.0, 0, 0, 0]], device="cuda"),
            torch.ones((1, 1), device="cuda"),
        ]
        scene = [t.requires_grad_() for t in scene]
        image, _ = project(*scene, some, 3.0)
        last = image[:, -1]
        corner = last[:, -20:, -20:].detach().cpu()
        (last[:, -20:, -20:] * torch.arange(20.0, device="cuda")).sum().backward()
        results.append([corner, *(t.grad.cpu() for t in scene)])
        del image, last
    assert results[0][0].max() > 0.4
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
