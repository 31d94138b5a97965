"""The mean of open-beam or dark images, without single pixels of an image that something else than the beam hit."""

from __future__ import annotations

import logging
import math
from statistics import NormalDist

import numpy as np

__all__ = ["FrameMean"]

logger = logging.getLogger(__name__)

# Chance that noise alone looks like a hit anywhere in the images of one scan.
_BY_CHANCE = 1e-3


class FrameMean:
    """Mean of images that are handed over one by one.

    A gamma ray or a muon that hits the detector leaves a bright pixel in a single image, a "zinger". In the mean of ten
    images a tenth of it is left, which makes a ring. So a pixel's brightest image does not count if it stands out
    further than the noise of counts would let any pixel of all images, by Bernstein's inequality (1927), and further
    than the pixel's other images scatter. Images as bright as they differ are compared by their brightness.
    """

    def __init__(self) -> None:
        self._count = 0
        self._light = 0.0
        self._total: np.ndarray | None = None

    def add(self, image: np.ndarray) -> None:
        """One more image, of the same shape (rows, columns) as the others."""
        image = np.asarray(image, np.float64)
        finite = np.isfinite(image)
        light = float(image.mean(where=finite)) if finite.any() else 0.0
        light = light if light > 0 else 1.0
        relative = image / light
        if self._total is None:
            self._total = np.zeros(image.shape)
            self._sum, self._squares = np.zeros((2, *image.shape))
            self._most = np.full(image.shape, -np.inf)
        self._count += 1
        self._light += light
        self._total += image
        self._sum += relative
        self._squares += relative**2
        np.maximum(self._most, relative, out=self._most)

    def mean(self, name: str) -> np.ndarray:
        """(rows, columns) float64, of images that are called `name` in the log; bit for bit theirs where nothing hit.

        Raises
        ------
        ValueError
            If there was no image.
        """
        if self._total is None:
            raise ValueError("no image")
        mean = self._total / self._count
        if self._count > 1:
            with np.errstate(invalid="ignore"):
                hit, others = self._hit()
            if hit.any():
                mean[hit] = others[hit] * (self._light / self._count)
                words = (
                    "%s: %d pixels are brighter in one image than noise lets any be, and go by the others."
                )
                logger.info(words, name, np.count_nonzero(hit))
        return mean

    def _hit(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels whose brightest image stands out, and the mean of their other images, as shares of the brightness."""
        images, others = self._count, self._count - 1
        rest = (self._sum - self._most) / others
        above = self._most - rest
        lit = np.isfinite(above) & (rest > 0)
        if not lit.any():
            return lit, rest
        # By the largest of so many normal values, of which half of the pixels have a larger one.
        largest = NormalDist().inv_cdf(0.5 ** (1 / images)) * images / others
        variance_a_share = (float(np.median(above[lit] / np.sqrt(rest[lit]))) / largest) ** 2
        certain = math.log(images * rest.size / _BY_CHANCE)
        own = (self._squares - self._most**2) / others - rest**2
        skew = variance_a_share * certain / 3
        reach = np.maximum(variance_a_share * rest, own) * (2 * certain * images / others)
        return lit & (variance_a_share > 0) & (above > skew + np.sqrt(skew**2 + reach)), rest
