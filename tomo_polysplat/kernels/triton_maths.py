"""Steps shared by the Triton kernels: scale and rotation to the whitening matrix and back.

The set-up of a Gaussian runs in float64 (its differences and cross products cancel), the sums over its
pixels or voxels in float32.
"""

from __future__ import annotations

import contextlib

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.checks import fail
from tomo_polysplat.kernels.triton_lanes import load_four

__all__ = [
    "GROUP",
    "HALF_LOG2E",
    "SIZES",
    "cross",
    "dot",
    "grain",
    "grained",
    "load_shape",
    "load_three",
    "on_device",
    "require_scene",
    "rotation_matrix",
    "whitening_adjoint",
]

# Neighbours in the list that are splatted together, one to a lane of a warp.
GROUP = 32
# exp(-q / 2) = 2^-(HALF_LOG2E q): the kernels carry q scaled so, as the hardware's exponential has base 2.
HALF_LOG2E = 0.7213475204444817
# Arguments of kernels for whose values none is compiled anew. Triton would for 1 and for what sixteen divides, a third
# of a second each, and the Gaussians of every call are another number.
SIZES = (
    "count", "rows", "columns", "area", "room", "beyond", "nz", "ny", "nx", "stride", "many", "nodes", "parts",
    "of_step",
)  # fmt: skip


def on_device(tensor: torch.Tensor):
    """Context in which Triton launches on the device of ``tensor`` rather than on the current one."""
    return torch.cuda.device(tensor.device) if tensor.is_cuda else contextlib.nullcontext()


def require_scene(position, scale, rotation, weight) -> None:
    """Raise ValueError unless all are float32 and ``weight`` has one to four channels."""
    scene = {"position": position, "scale": scale, "rotation": rotation, "weight": weight}
    for name, tensor in scene.items():
        if tensor.dtype != torch.float32:
            raise fail(name, "a float32 tensor for the triton kernel", str(tensor.dtype))
    if not 1 <= len(weight) <= 4:
        raise fail("weight", "1 to 4 channels for the triton kernel", str(len(weight)))


@triton.jit
def grain(largest, GRAINED: tl.constexpr):
    """What `grained` takes, from where the largest sum so far is kept; see there."""
    if GRAINED:
        bits = tl.load(largest).to(tl.int32, bitcast=True)
        return 6.0 * (bits & 0x7F800000).to(tl.float32, bitcast=True)
    return 0.0


@triton.jit
def grained(value, shift):
    """``value`` rounded so that float32 sums of such values are exact, whatever their order.

    ``shift`` is 6 times the power of two at or below the largest sum that is expected. Added to it, a smaller
    value keeps 23 bits behind that of 4 times the power, so that sums up to 8 times the power need no more than
    the 24 bits there are. Beyond that they are rounded as any others.
    """
    return (value + shift) - shift


@triton.jit
def cross(a0, a1, a2, b0, b1, b2):
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@triton.jit
def dot(a0, a1, a2, b0, b1, b2):
    return a0 * b0 + a1 * b1 + a2 * b2


@triton.jit
def load_three(values, n):
    """The three numbers of each of the Gaussians ``n``."""
    at = values + n * 3
    return tl.load(at), tl.load(at + 1), tl.load(at + 2)


@triton.jit
def load_shape(scale, rotation, n):
    """Scales and quaternions (w, x, y, z) of the Gaussians ``n``, seven numbers as they are stored.

    Kernels load all that they need before they compute: what memory takes is then waited for once, and it is more
    than what the arithmetic takes.
    """
    s0, s1, s2 = load_three(scale, n)
    w, x, y, z = load_four(rotation + n * 4)
    return s0, s1, s2, w, x, y, z


@triton.jit
def _unit_quaternion(w, x, y, z):
    w, x, y, z = w.to(tl.float64), x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)
    inverse = tl.math.rsqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def rotation_matrix(w, x, y, z):
    """R^T, row by row, of quaternions, in float64."""
    w, x, y, z, _ = _unit_quaternion(w, x, y, z)
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
        2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
        2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def whitening_adjoint(
    s0, s1, s2, qw, qx, qy, qz, n, live, w00, w01, w02, w10, w11, w12, w20, w21, w22,
    g00, g01, g02, g10, g11, g12, g20, g21, g22, grad_scale, grad_rotation,
):  # fmt: skip
    """Store the gradients of scale and quaternion from the whitening matrix ``w`` and ``g`` = dL/dw."""
    a, b, c = 1.0 / s0.to(tl.float64), 1.0 / s1.to(tl.float64), 1.0 / s2.to(tl.float64)
    # W's row k is R's column k over scale_k, so dW/dscale_k = -W_k / scale_k.
    tl.store(grad_scale + n * 3, (-a * dot(g00, g01, g02, w00, w01, w02)).to(tl.float32), mask=live)
    tl.store(grad_scale + n * 3 + 1, (-b * dot(g10, g11, g12, w10, w11, w12)).to(tl.float32), mask=live)
    tl.store(grad_scale + n * 3 + 2, (-c * dot(g20, g21, g22, w20, w21, w22)).to(tl.float32), mask=live)
    g00, g01, g02 = g00 * a, g01 * a, g02 * a
    g10, g11, g12 = g10 * b, g11 * b, g12 * b
    g20, g21, g22 = g20 * c, g21 * c, g22 * c
    w, x, y, z, inverse = _unit_quaternion(qw, qx, qy, qz)
    gw = 2 * (z * (g01 - g10) + y * (g20 - g02) + x * (g12 - g21))
    gx = 2 * (y * (g01 + g10) + z * (g02 + g20) + w * (g12 - g21) - 2 * x * (g11 + g22))
    gy = 2 * (x * (g01 + g10) + z * (g12 + g21) + w * (g20 - g02) - 2 * y * (g00 + g22))
    gz = 2 * (x * (g02 + g20) + y * (g12 + g21) + w * (g01 - g10) - 2 * z * (g00 + g11))
    # Only the part across the quaternion counts: its length is normalised away.
    along = gw * w + gx * x + gy * y + gz * z
    tl.store(grad_rotation + n * 4, ((gw - along * w) * inverse).to(tl.float32), mask=live)
    tl.store(grad_rotation + n * 4 + 1, ((gx - along * x) * inverse).to(tl.float32), mask=live)
    tl.store(grad_rotation + n * 4 + 2, ((gy - along * y) * inverse).to(tl.float32), mask=live)
    tl.store(grad_rotation + n * 4 + 3, ((gz - along * z) * inverse).to(tl.float32), mask=live)
