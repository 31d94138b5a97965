"""What a Gaussian's parameters stand for."""

import math

import pytest
import torch

from tomo_polysplat.model.gaussians import Gaussians

CURVE = torch.tensor([1.0, 1.4, 6.0])


def gaussians(own, shared=(0.0,), group=None, dims=3):
    n = len(own)
    return Gaussians(
        torch.zeros(n, 3),
        torch.full((n, dims), math.log(0.1)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.linspace(0.5, 2.0, n),
        torch.tensor(own),
        torch.tensor(shared),
        torch.full((n,), -1) if group is None else torch.tensor(group),
        torch.zeros(1),
    )


def test_the_attenuation_at_the_reference_energy_does_not_depend_on_the_material():
    cloud = gaussians([0.0, 0.3, 0.7, 1.0])
    assert torch.allclose(CURVE @ cloud.weights(CURVE), cloud.attenuation, rtol=1e-6)


@pytest.mark.parametrize("count", [2, 37])
def test_densities_and_their_slopes_in_lanes_of_float32_are_those_of_float64(count):
    random, found = torch.Generator().manual_seed(3), []
    own, slopes = torch.rand(count, generator=random), torch.randn((3, count), generator=random)
    for kind in (torch.float32, torch.float64):
        cloud = gaussians(own.tolist(), (0.1, 0.6), [k % 3 - 1 for k in range(count)])
        parts = [part.to(kind) for part in (cloud.attenuation, cloud.own_material, cloud.shared_material)]
        cloud.attenuation, cloud.own_material, cloud.shared_material = (
            part.requires_grad_() for part in parts
        )
        weights = cloud.weights(CURVE.to(kind))
        (weights * slopes.to(kind)).sum().backward()
        found.append([weights.detach().double(), *(part.grad.double() for part in parts)])
    for one, other in zip(*found):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("u, share", [(0.0, (1, 0, 0)), (0.5, (0.25, 0.5, 0.25)), (1.0, (0, 0, 1))])
def test_the_material_number_mixes_the_curves_by_bernstein(u, share):
    cloud = gaussians([u])
    weights = cloud.weights(CURVE)[:, 0]
    assert torch.allclose(weights / weights.sum(), torch.tensor(share, dtype=torch.float32), atol=1e-6)
    density = float(cloud.attenuation[0]) / float(CURVE @ torch.tensor(share, dtype=torch.float32))
    assert float(weights.sum()) == pytest.approx(density, rel=1e-6)


def test_a_monochromatic_cloud_has_its_attenuation():
    cloud = gaussians([0.0, 0.4])
    assert torch.equal(cloud.weights(None), cloud.attenuation[None])


def test_a_group_has_one_number_and_the_others_their_own():
    cloud = gaussians([0.1, 0.2, 0.3, 0.4], shared=(0.0, 0.9), group=[0, 1, -1, 1])
    assert torch.allclose(cloud.material(), torch.tensor([0.0, 0.9, 0.3, 0.9]))


def test_gradients_go_to_whoever_owns_the_number():
    cloud = gaussians([0.1, 0.2, 0.3], shared=(0.0, 0.9), group=[1, -1, 1])
    for parameter in (cloud.own_material, cloud.shared_material):
        parameter.requires_grad_()
    cloud.material().sum().backward()
    assert cloud.own_material.grad.tolist() == [0, 1, 0]
    assert cloud.shared_material.grad.tolist() == [0, 2]


def test_planar_gaussians_have_no_end_along_z():
    scale = gaussians([0.0], dims=2).scale()
    assert scale.shape == (1, 3) and torch.isinf(scale[0, 2])
    assert torch.allclose(scale[0, :2], torch.tensor(0.1))
    assert gaussians([0.0], dims=2).planar and not gaussians([0.0]).planar


def test_a_selection_keeps_groups_and_graph():
    cloud = gaussians([0.1, 0.2, 0.3], shared=(0.0, 0.9), group=[1, -1, 1])
    cloud.position.requires_grad_()
    part = cloud.select(torch.tensor([2, 1]))
    assert torch.allclose(part.material(), torch.tensor([0.9, 0.2]))
    part.position.sum().backward()
    assert cloud.position.grad.sum(dim=1).tolist() == [0, 3, 3]


def test_a_copy_is_independent():
    cloud = gaussians([0.1])
    cloud.position.requires_grad_()
    copy = cloud.copy()
    with torch.no_grad():
        cloud.position += 1
        cloud.group[:] = 0
    assert not copy.position.requires_grad and not bool(copy.position.any()) and int(copy.group[0]) == -1


def test_everything_but_the_groups_is_fitted():
    cloud = gaussians([0.1])
    assert set(cloud.parameters()) == {
        *("position", "log_scale", "rotation", "attenuation", "own_material", "shared_material", "blur")
    }


@pytest.mark.gpu
def test_what_is_kept_lies_on_the_host_and_takes_the_place_of_what_was_kept():
    cloud = gaussians(own=(0.2, 0.4)).to(torch.device("cuda"))
    cloud.position.requires_grad_()
    first = cloud.kept(None)
    with torch.no_grad():
        cloud.position += 1.0
    second = cloud.kept(first)
    assert second is first and not first.position.requires_grad and first.position.device.type == "cpu"
    for name in cloud.parameters():
        assert torch.equal(getattr(second, name), getattr(cloud, name).detach().cpu())
    fewer = cloud.select(torch.tensor([0], device="cuda"))
    assert len(fewer.kept(second)) == 1
