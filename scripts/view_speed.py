"""How soon the page of ``tomo-polysplat view`` shows another slice of two volumes, in headless Chromium.

    python scripts/view_speed.py [VOXELS] [SCREENSHOT]

Needs ``pip install playwright`` and Chromium (``playwright install chromium``, or the system's). Prints the
milliseconds from a slider's event to the picture, and fails where the page has asked for anything from outside.
"""

from __future__ import annotations

import shutil
import sys
import threading

import numpy as np
from playwright.sync_api import sync_playwright

from tomo_polysplat.viewer.server import Server
from tomo_polysplat.viewer.volumes import Shown

MOVES = 100
MOVE = """async ({slider, value}) => {
  const begun = performance.now(), control = document.querySelector(slider);
  control.value = value;
  control.dispatchEvent(new Event("input"));
  while (busy) await new Promise((ready) => setTimeout(ready, 1));
  await new Promise((ready) => requestAnimationFrame(ready));
  return performance.now() - begun;
}"""


def volumes(voxels: int) -> dict[str, np.ndarray]:
    """A cylinder of cubes, and the same upside down."""
    place = np.arange(voxels)
    inside = np.hypot(*np.meshgrid(place - voxels / 2, place - voxels / 2)) < 0.4 * voxels
    cubes = place // 16
    first = np.empty((voxels,) * 3, np.float16)
    for z in range(voxels):
        first[z] = inside * (200 + 100 * ((cubes[z] + cubes[:, None] + cubes) % 2))
    return {"tomo-polysplat": first, "FDK": first[::-1].copy()}


def main() -> None:
    """Measure every slider."""
    voxels = int(sys.argv[1]) if len(sys.argv) > 1 else 512
    middle = [voxels // 2] * 3
    shown = Shown(volumes(voxels), 1000.0, np.full(3, 0.01), "cm", (0.0, 0.6), middle, "speed")
    rng = np.random.default_rng(0)
    sliders = {f'input[data-axis="{axis}"]': rng.permutation(voxels)[:MOVES] for axis in range(3)}
    sliders |= {"#high": rng.permutation(1000)[:MOVES], "#swipe": rng.random(MOVES)}
    with Server(shown) as server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto(server.url)
        page.wait_for_selector("canvas[data-shown]")
        for slider, places in sliders.items():
            times = [page.evaluate(MOVE, {"slider": slider, "value": float(at)}) for at in places]
            print(f"{slider:24} median {np.median(times):5.1f} ms, longest {max(times):5.1f} ms")
        if len(sys.argv) > 2:
            page.screenshot(path=sys.argv[2])
        browser.close()
        server.shutdown()
    outside = [url for url in asked if not url.startswith((server.url, "data:"))]
    sys.exit(f"asked for from outside: {outside}" if outside else 0)


if __name__ == "__main__":
    main()
