"""Volumes side by side on a page, one window for all, and a slider through their slices."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.report.page import data_uri, text

__all__ = ["browser"]

# Slices that a page holds at most, and their longest edge; a page is to pass through mail.
_SLICES, _EDGE = 32, 360
_QUALITY = 88

# Without a script, or printed, the slice in the page stays.
_SCRIPT = """
<script>
(function () {
  const box = document.currentScript.parentElement;
  const slices = JSON.parse(box.querySelector("script[type='application/json']").textContent);
  const slider = box.querySelector("input"), says = box.querySelector("output");
  const pictures = box.querySelectorAll("img");
  slider.addEventListener("input", function () {
    const k = Number(slider.value);
    pictures.forEach((picture, n) => { picture.src = slices.pictures[n][k]; });
    says.textContent = slices.names[k];
  });
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((d) => { d.open = true; }));
})();
</script>
"""


def browser(
    volumes: Sequence[tuple[str, np.ndarray]],
    window: tuple[float, float],
    first: int,
    heights: np.ndarray,
    unit: str,
) -> str:
    """Axial slices of volumes side by side.

    Parameters
    ----------
    volumes : sequence of (name, volume)
        Volumes (z, y, x) of one shape.
    window : pair of float
        Attenuation that is black, and white.
    first : int
        The slice that is shown first.
    heights : array, shape (nz,)
        Where the slices are along z, in `unit`.
    unit : str
        Of length.
    """
    count = volumes[0][1].shape[0]
    chosen = np.union1d(evenly_spread(count, _SLICES), first)
    pictures = [[_picture(volume[k], window) for k in chosen] for _, volume in volumes]
    # The middle may be at 1e-17.
    places = np.where(np.abs(heights) < 1e-6 * np.ptp(heights), 0.0, heights)
    names = [f"slice {k} of {count}, z = {places[k]:.3g} {unit}" for k in chosen]
    start = int(np.flatnonzero(chosen == first)[0])
    parts = [
        f'<figure><figcaption>{text(name)}</figcaption><img alt="axial slice of {text(name)}" '
        f'src="{shown[start]}"></figure>'
        for (name, _), shown in zip(volumes, pictures)
    ]
    html = ['<div class="browse">', f'<div class="pair">{"".join(parts)}</div>']
    if count > 1:
        html.append(
            f'<label>slice <input type="range" min="0" max="{len(chosen) - 1}" value="{start}" aria-label="slice">'
            f"<output>{text(names[start])}</output></label>"
        )
        data = json.dumps({"pictures": pictures, "names": names}).replace("<", "\\u003c")
        html += [f'<script type="application/json">{data}</script>', _SCRIPT]
    html.append(
        f'<div class="window">{window[0]:.3g}<span class="bar"></span>{window[1]:.3g} 1/{text(unit)}, '
        "the same in every picture</div></div>"
    )
    return "".join(html)


def _picture(image: np.ndarray, window: tuple[float, float]) -> str:
    """A slice (y, x) with its first row at the bottom, as the address of a JPEG."""
    from PIL import Image

    low, high = window
    grey = np.clip((image[::-1] - low) / (high - low), 0, 1)
    picture = Image.fromarray((255 * np.nan_to_num(grey) + 0.5).astype(np.uint8))
    picture.thumbnail((_EDGE, _EDGE))
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=_QUALITY)
    return data_uri(buffer.getvalue(), "jpeg")
