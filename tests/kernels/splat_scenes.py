"""Small scanners and scenes, and the comparison of an implementation with the float64 reference."""

import numpy as np
import torch

from tomo_polysplat.kernels.project.autograd import project
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise.autograd import voxelise
from tomo_polysplat.kernels.voxelise.box import VoxelBox

NAMES = ("image", "position", "scale", "rotation", "weight")


def cone_views(count=3, rows=23, columns=37, distance=5.0, tilt=0.15, pixel=(0.11, 0.13)):
    """A circular orbit round the origin whose detector is tilted, shifted and has oblong pixels."""
    origins, matrices = [], []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False) + 0.3:
        across, ahead = _axes(angle)
        up = np.array([0.0, 0.0, 1.0]) + tilt * ahead
        source = -distance * ahead
        u, v = pixel[0] * (across - 0.5 * tilt * ahead), pixel[1] * up
        corner = 2.0 * ahead - u * ((columns - 1) / 2 + 1.3) - v * ((rows - 1) / 2 - 0.7)
        origins.append(source)
        matrices.append(np.stack([u, v, corner - source], axis=1))
    return DetectorViews(True, np.array(origins), np.array(matrices), rows, columns)


def parallel_views(count=3, rows=23, columns=37, pixel=(0.08, 0.09)):
    """Parallel rays oblique to a skewed detector."""
    origins, matrices = [], []
    for angle in np.linspace(0, np.pi, count, endpoint=False) + 0.3:
        across, ahead = _axes(angle)
        u, v = pixel[0] * across, pixel[1] * np.array([0.1, -0.05, 1.0])
        origins.append(-u * (columns - 1) / 2 - v * (rows - 1) / 2)
        matrices.append(np.stack([u, v, 1.7 * ahead + [0.0, 0.0, 0.2]], axis=1))
    return DetectorViews(False, np.array(origins), np.array(matrices), rows, columns)


def planar_views(cone, count=3, columns=41):
    """A two-dimensional scan: one row, everything at z = 0; the row step is a dummy along z."""
    origins, matrices = [], []
    for angle in np.linspace(0, np.pi, count, endpoint=False) + 0.3:
        across, ahead = _axes(angle)
        u = (0.11 if cone else 0.07) * across
        corner = 2.0 * ahead - u * ((columns - 1) / 2 - 0.4)
        origins.append(-5.0 * ahead if cone else corner)
        matrices.append(np.stack([u, [0.0, 0.0, 0.1], corner + 5.0 * ahead if cone else ahead], axis=1))
    return DetectorViews(cone, np.array(origins), np.array(matrices), 1, columns, planar=True)


def _axes(angle):
    return np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])


def gaussians(count, *, seed=0, size=0.1, channels=3, planar=False):
    """Float64 position, scale, rotation and weight of random Gaussians in the middle of the scanner."""
    generator = torch.Generator().manual_seed(seed)
    like = {"generator": generator, "dtype": torch.float64}
    position = (torch.rand(count, 3, **like) * 2 - 1) * 0.9
    scale = size * (0.4 + torch.rand(count, 3, **like))
    rotation = torch.randn(count, 4, **like)
    if planar:
        position[:, 2], scale[:, 2] = 0.0, float("inf")
        rotation[:, 1:3] = 0.0
    return [position, scale, rotation, torch.rand(channels, count, **like)]


def as_float32(scene):
    """The scene rounded to float32, in float64: what a float32 implementation is given, exactly."""
    return [t.float().double() for t in scene]


def run_project(scene, views, kernel="reference", device="cpu", cutoff=3.0, cotangent=None):
    """The image, the gradients of ``sum(cotangent * image)``, and the skipped pairs."""
    dtype = torch.float64 if kernel == "reference" else torch.float32
    leaves = [t.detach().to(device, dtype, copy=True).requires_grad_() for t in scene]
    image, skipped = project(*leaves, views, kernel=kernel, cutoff=cutoff)
    if cotangent is None:
        cotangent = random_like(image)
    (image * cotangent.to(image)).sum().backward()
    return [image.detach().cpu(), *(leaf.grad.cpu() for leaf in leaves)], int(skipped)


def vector_gradient(scene, views, kernel="reference", device="cpu", cutoff=3.0):
    """(views, 4, 3) gradient of the image's product with random numbers by the vectors of the views."""
    dtype = torch.float64 if kernel == "reference" else torch.float32
    vectors = torch.from_numpy(views.vectors).requires_grad_()
    leaves = [t.detach().to(device, dtype, copy=True).requires_grad_() for t in scene]
    image, _ = project(*leaves, views, kernel=kernel, cutoff=cutoff, vectors=vectors)
    (image * random_like(image).to(image)).sum().backward()
    return vectors.grad


def run_voxelise(scene, box, kernel="reference", device="cpu", cutoff=3.0):
    """The volume and the gradients of its product with random numbers."""
    dtype = torch.float64 if kernel == "reference" else torch.float32
    leaves = [t.detach().to(device, dtype, copy=True).requires_grad_() for t in scene]
    volume = voxelise(*leaves, box, kernel=kernel, cutoff=cutoff)
    (volume * random_like(volume).to(volume)).sum().backward()
    return [volume.detach().cpu(), *(leaf.grad.cpu() for leaf in leaves)]


def random_like(tensor):
    """Standard normal numbers of the tensor's shape, the same ones for every type and device."""
    return torch.randn(tensor.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)


def voxel_box(shape=(11, 14, 17), spacing=(0.15, 0.17, 0.21), centre=(0.05, -0.1, 0.0)):
    """Oblong voxels round a point that is off the origin."""
    spacing = np.array(spacing)
    first = np.array(centre) - spacing * (np.array(shape[::-1]) - 1) / 2
    return VoxelBox(first, spacing, shape)


def assert_close(got, expected, image=1e-5, gradient=1e-4):
    """Relative L2 distance of the image and of every gradient, and no shared sign in the differences."""
    for name, one, truth in zip(NAMES, got, expected, strict=True):
        one = one.double()
        assert one.shape == truth.shape, name
        assert torch.isfinite(one).all(), name
        norm = truth.norm()
        assert norm > 0, f"{name}: the reference is zero, so the comparison would say nothing"
        error = float((one - truth).norm() / norm)
        assert error < (image if name == "image" else gradient), f"{name}: relative error {error:.2e}"


# Cones, parallel beams and single planes, of odd sizes too.
VIEWS = {
    "cone": cone_views(),
    "cone_odd": cone_views(2, 63, 5, pixel=(0.5, 0.05)),
    "cone_one_row": cone_views(2, 1, 123, pixel=(0.03, 0.5)),
    "parallel": parallel_views(),
    "parallel_odd": parallel_views(1, 7, 123, pixel=(0.02, 0.3)),
    "fan": planar_views(cone=True),
    "parallel_2d": planar_views(cone=False),
}
