"""Linked slices of volumes in one window, drawn for whoever moves the sliders."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_shape
from tomo_polysplat.report.figures import png_bytes
from tomo_polysplat.report.slices import Plane
from tomo_polysplat.report.style import INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["LinkedSlices", "bar_length"]

_PLANES = (("axial", 0), ("coronal", 1), ("sagittal", 2))
_CROSS = "#e69f00"
# Inches of a panel, and how much of its width a scale bar may take.
_PANEL, _BAR = 2.5, 0.3


class LinkedSlices:
    """A figure of three planes through one point, a row a volume, all with one window.

    Parameters
    ----------
    volumes : mapping of name to array (z, y, x)
        Of one shape.
    voxel_size : (3,) sequence
        Along x, y and z, in `unit`.
    unit : str
        Of length.
    difference : bool
        A row more: the first volume less the second.
    """

    def __init__(
        self,
        volumes: Mapping[str, np.ndarray],
        voxel_size: Sequence[float] | np.ndarray,
        unit: str,
        *,
        difference: bool = False,
    ) -> None:
        self.volumes = {name: require_array(name, values, 3) for name, values in volumes.items()}
        self.shape = next(iter(self.volumes.values())).shape
        for name, values in self.volumes.items():
            require_shape(name, values, self.shape, "(z, y, x) of the first volume")
        if difference and len(self.volumes) < 2:
            raise fail("difference", "two volumes", "one", "pass the other as well")
        self.voxel_size, self.unit, self.difference = voxel_size, unit, difference
        self.planes = _PLANES[:1] if self.shape[0] == 1 else _PLANES
        self._build()

    def draw(self, point: Sequence[int], window: tuple[float, float], dpi: int = 80) -> bytes:
        """The figure as PNG.

        Parameters
        ----------
        point : (z, y, x)
            Voxel that the planes go through.
        window : pair of float
            Attenuation that is black, and white; the difference is shown to half of its width either way.
        dpi : int
            Pixels an inch.
        """
        low, high = window
        half = 0.5 * max(high - low, 1e-12)
        for row, values in zip(self._images, self._shown()):
            for image, (name, axis) in zip(row, self.planes):
                image.set_data(Plane(name, axis, int(point[axis])).of(values))
                is_difference = self.difference and row is self._images[-1]
                # Old releases of matplotlib (3.8) shift the one limit while the other is still that of before.
                for _ in range(2):
                    image.set_clim(*((-half, half) if is_difference else window))
        for (name, axis), title, lines in zip(self.planes, self._titles, self._crosses):
            title.set_text(f"{name} {int(point[axis])}")
            up, across = (k for k in range(3) if k != axis)
            for horizontal, vertical in lines:
                horizontal.set_ydata([point[up]] * 2)
                vertical.set_xdata([point[across]] * 2)
        png = png_bytes(self.figure, dpi)
        # Where everything goes takes most of the time, and stays.
        self.figure.set_layout_engine("none")
        return png

    def _shown(self) -> list[Any]:
        shown: list[Any] = list(self.volumes.values())
        return [*shown, _Difference(shown[0], shown[1])] if self.difference else shown

    def _build(self) -> None:
        from matplotlib.figure import Figure

        names = [*self.volumes, *(["difference"] if self.difference else [])]
        size = np.asarray(self.voxel_size, float)[::-1] * self.shape
        heights = max(size[up] / size[across] for up, across in map(self._axes_of, self.planes))
        across = (_PANEL * len(self.planes) + 0.9, (_PANEL * min(heights, 2.0) + 0.25) * len(names) + 0.2)
        self.figure = Figure(figsize=across, layout="constrained")
        axes = self.figure.subplots(len(names), len(self.planes), squeeze=False)
        self._images: list[list[Any]] = []
        self._crosses: list[list[Any]] = [[] for _ in self.planes]
        for row, name in zip(axes, names):
            self._images.append([self._panel(axis, k, name) for k, axis in enumerate(row)])
            row[0].set_ylabel(name, fontsize=9, color=INK)
            self.figure.colorbar(self._images[-1][0], ax=list(row), pad=0.01, label=f"1/{self.unit}")
        self._titles = [axis.set_title("", fontsize=9, color=INK) for axis in axes[0]]

    def _panel(self, axis: Axes, k: int, name: str) -> Any:
        up, across = self._axes_of(self.planes[k])
        spacing = np.asarray(self.voxel_size, float)[::-1]
        blank = np.zeros((self.shape[up], self.shape[across]), np.float32)
        grey = "PuOr" if name == "difference" else "gray"
        image = axis.imshow(
            blank, origin="lower", cmap=grey, aspect=spacing[up] / spacing[across], interpolation="nearest"
        )
        axis.set(xticks=[], yticks=[])
        cross: dict[str, Any] = {"color": _CROSS, "linewidth": 0.6, "alpha": 0.7}
        self._crosses[k].append((axis.axhline(0, **cross), axis.axvline(0, **cross)))
        length = bar_length(_BAR * spacing[across] * self.shape[across])
        voxels = length / spacing[across]
        left, low = 0.04 * self.shape[across], 0.05 * self.shape[up]
        colour = "black" if name == "difference" else "white"
        axis.plot([left, left + voxels], [low, low], color=colour, linewidth=2.5, solid_capstyle="butt")
        axis.text(left, low + 0.02 * self.shape[up], f"{length:g} {self.unit}", color=colour, fontsize=7)
        return image

    @staticmethod
    def _axes_of(plane: tuple[str, int]) -> tuple[int, int]:
        """Axis of the volume upwards, and across."""
        up, across = (k for k in range(3) if k != plane[1])
        return up, across


class _Difference:
    """One volume less another, slice by slice, for a whole one may be large."""

    def __init__(self, one: np.ndarray, other: np.ndarray) -> None:
        self.one, self.other = one, other

    def take(self, index: int, axis: int) -> np.ndarray:
        return self.one.take(index, axis) - self.other.take(index, axis)


def bar_length(most: float) -> float:
    """The longest of 1, 2 and 5 times a power of ten that is at most `most`."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(times * power for times in (1, 2, 5) if times * power <= most * (1 + 1e-9))
