"""Few nodes that stand for a whole spectrum.

A ray through areal densities ``a`` of the three base materials measures

    P(a) = -log sum_E eta_E exp(-sum_k a_k b_kE).

A quadrature replaces the spectrum's energies by a few nodes with free weights *and* free attenuation triples:
they need not lie on the physical curves, since only ``P`` is ever made from them. Fitted to ``P`` itself over
the range of the scan, 5 to 7 nodes are better than 63 plain samples, and absorption edges are no obstacle,
because no node has to move across one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomo_polysplat.checks import require_number
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.filtered_rays import Behind, filtered_rays
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.quadrature_fit import fit_nodes
from tomo_polysplat.physics.ray_range import MaxPath, span_rays
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["Behind", "Quadrature", "fit_quadrature"]

MAX_FITTED_NODES = 16
# Of a table of P along the first material.
_STEPS = 2048
_SLOPE_TOLERANCE = 1e-3  # relative, of dP/da at P = 0: thin objects keep their attenuation
# Likewise, behind any areal density of a filter: more nodes than 8 come no nearer than 0.02 behind copper.
_FILTERED_SLOPES = 3e-2
# Steps between pure materials and levels of P, of the rays that a quadrature is fitted to: more levels where
# there are too few rays for its unknowns.
_FIT_STEPS, _FIT_LEVELS = 4, 20
# The rays its errors are taken from: finer, and other mixtures but for the pure materials.
_JUDGE_GRID = (11, np.linspace(0.0, 1.0, 41)[1:] ** 2)

# At how many areal densities of it nodes are fitted and judged, and on which mixtures and levels of P behind each.
_FIT_FILTERS = (6, 3, np.linspace(0.0, 1.0, 13)[1:] ** 2)
_JUDGE_FILTERS = (9, 5, np.linspace(0.0, 1.0, 41)[1:] ** 2)

_Nodes = tuple[np.ndarray, np.ndarray]  # log weights (n,) and attenuation (3, n) or (1, n)


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Nodes of the polychromatic projection, ``P = -logsumexp_n(log_weights_n - sum_k a_k attenuation_kn)``.

    Attributes
    ----------
    log_weights : (n,) float64 array
        Logarithms of weights that add up to 1.
    attenuation : (3, n) or (1, n) float64 array
        Mass attenuation (cm2/g) of the soft, middle and dense material at each node, or of the soft one alone.
    error_bound : float
        Largest ``|error of P|`` found on an independent, dense set of rays over the range ``max_path``.
    rms_error : float
        Root mean square error of ``P`` on the same rays.
    slope_error : float
        Largest relative error of ``dP/da_k`` at ``P = 0``.
    max_path : float or tuple of three floats
        Range for which the errors hold: the largest P, or the largest areal densities (g/cm2).
    filter : (n,) float64 array or None
        Mass attenuation at each node of a filter that pixels see so much of; see `physics.filter_map`.
    """

    log_weights: np.ndarray
    attenuation: np.ndarray
    error_bound: float
    rms_error: float
    slope_error: float
    max_path: float | tuple[float, ...]
    filter: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.log_weights.flags.writeable = self.attenuation.flags.writeable = False

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return self.log_weights.size

    @property
    def weights(self) -> np.ndarray:
        """Weights ``(n,)`` that add up to 1."""
        return np.exp(self.log_weights)

    @property
    def mean_attenuation(self) -> np.ndarray:
        """``dP/da_k`` at ``P = 0``, ``(3,)`` or ``(1,)`` in cm2/g."""
        return self.attenuation @ self.weights

    def describe(self) -> str:
        """One line for reports."""
        nodes = f"{self.nodes} spectral node{'s' if self.nodes > 1 else ''}"
        if isinstance(self.max_path, tuple):
            where = "areal densities up to " + ", ".join(f"{a:.3g}" for a in self.max_path) + " g/cm2"
        else:
            where = f"projection values up to {self.max_path:.3g}"
        return f"{nodes}: error at most {self.error_bound:.1e}, rms {self.rms_error:.1e}, for {where}"

    def straight_line(self, value: float) -> float:
        """What a ray through the first material that measures ``value`` would measure without hardening.

        That is its areal density times ``dP/da`` at 0: rays as thin as can be are not hardened.
        """
        curve, slope = self.attenuation[:1], float(self.mean_attenuation[0])
        # P rises at least as fast as at the node that penetrates best.
        paths = value / float(curve.min()) * np.linspace(0.0, 1.0, _STEPS) ** 3
        return slope * float(np.interp(value, projection(paths[None], self.log_weights, curve), paths))

    def describe_hardening(self, value: float) -> str:
        """One line for reports: what hardening does to the largest projection value of a scan."""
        if self.nodes == 1:
            return f"one energy stands for the spectrum: none above {self.error_bound:.1e} in the data"
        line = self.straight_line(max(value, 0.0))
        return (
            f"soft matter that measures {value:.3g}, the largest, would measure {line:.3g} without hardening"
        )


# One parameter for each option that a caller names.
def fit_quadrature(
    spectrum: Spectrum,
    materials: Materials | None = None,
    max_path: MaxPath = 8.0,
    nodes: int | None = None,
    tolerance: float = 5e-4,
    curves: int = 3,
    behind: Behind | None = None,
) -> Quadrature:
    """The fewest nodes that reproduce the measurement over the range of a scan.

    Parameters
    ----------
    spectrum : Spectrum
    materials : Materials, optional
        Base materials; water, aluminium and iron by default.
    max_path : float or three floats
        Range of the scan: its largest projection value, or the largest areal density (g/cm2) of each base
        material.
    nodes : int, optional
        Fix the number of nodes instead. A spectrum with no more energies than that is kept as it is.
    tolerance : float
        Root mean square error of ``P`` to reach. If 16 nodes do not, every energy of the spectrum becomes a
        node.
    curves : 3 or 1
        Rays of mixtures of the three materials, or of the first one alone, which takes fewer nodes.
    behind : (material, least, largest), optional
        A filter of which pixels see so much (g/cm2): P counts from the open beam behind it.

    Returns
    -------
    Quadrature
        With its errors on rays that were not used in the fit.

    Raises
    ------
    ValueError
        For a range or number of nodes that is not positive.
    """
    if nodes is not None:
        nodes = int(require_number("nodes", nodes, at_least=1))
    full = _nodes_of(spectrum, materials or Materials(), curves)
    bins = full[0].size
    require_number("tolerance", tolerance, above=0.0)
    judge: _Judge | _FilteredJudge
    if behind is None:
        judge, rays = _Judge(full, max_path), _rays_for(full, max_path, nodes or MAX_FITTED_NODES)
    else:
        full = _with_filter(full, mass_attenuation(behind[0], spectrum.energies[spectrum.weights > 0]))
        judge = _FilteredJudge(full, max_path, behind)
        rays = filtered_rays(full, max_path, behind, *_FIT_FILTERS).areal
    if nodes is not None:
        return judge(fit_nodes(*full, rays, nodes) if nodes < bins else full)
    for count in range(1, min(bins, MAX_FITTED_NODES + 1)):
        candidate = judge(fit_nodes(*full, rays, count))
        if candidate.rms_error <= tolerance and candidate.slope_error <= judge.slopes:
            return candidate
    return judge(full)


def _nodes_of(spectrum: Spectrum, materials: Materials, curves: int = 3) -> _Nodes:
    """A spectrum's energies as nodes of the first ``curves`` materials, those without weight left out."""
    lit = spectrum.weights > 0
    return np.log(spectrum.weights[lit]), materials.mass_attenuation(spectrum.energies[lit])[:curves]


def _rays_for(full: _Nodes, max_path: MaxPath, nodes: int) -> np.ndarray:
    """Areal densities of rays that so many nodes are fitted to."""
    curves = len(full[1])
    mixtures = 1 if curves == 1 else (_FIT_STEPS + 1) * (_FIT_STEPS + 2) // 2
    # A node has its weight and a number for each curve.
    levels = max(_FIT_LEVELS, -(-2 * (curves + 1) * min(nodes, full[0].size) // mixtures))
    # Dense near 0, where P bends fastest: the softest photons go first.
    return span_rays(*full, max_path, _FIT_STEPS, np.linspace(0.0, 1.0, levels + 1)[1:] ** 2)


class _Judge:
    """Puts the errors against the full spectrum on nodes."""

    slopes = _SLOPE_TOLERANCE

    def __init__(self, full: _Nodes, max_path: MaxPath) -> None:
        self._rays = span_rays(*full, max_path, *_JUDGE_GRID)
        self._target = projection(self._rays, *full)
        self._slope = full[1] @ np.exp(full[0])
        self._range = tuple(map(float, np.ravel(max_path)))

    def __call__(self, nodes: _Nodes) -> Quadrature:
        errors = projection(self._rays, *nodes) - self._target
        slope = nodes[1] @ np.exp(nodes[0])
        return Quadrature(
            nodes[0].copy(),
            nodes[1].copy(),
            error_bound=float(np.abs(errors).max()),
            rms_error=float(np.sqrt(np.mean(errors**2))),
            slope_error=float(np.abs(slope / self._slope - 1.0).max()),
            max_path=self._range if len(self._range) > 1 else self._range[0],
        )


def _with_filter(full: _Nodes, curve: np.ndarray) -> _Nodes:
    """The filter as one curve more, the last."""
    return full[0], np.concatenate([full[1], curve[None]])


class _FilteredJudge:
    """As `_Judge`, behind a filter."""

    slopes = _FILTERED_SLOPES

    def __init__(self, full: _Nodes, max_path: MaxPath, behind: Behind) -> None:
        self._rays = filtered_rays(full, max_path, behind, *_JUDGE_FILTERS)
        self._target, self._slope = self._rays.seen(*full), self._rays.slopes(*full)
        self._range = tuple(map(float, np.ravel(max_path)))

    def __call__(self, nodes: _Nodes) -> Quadrature:
        errors = self._rays.seen(*nodes) - self._target
        return Quadrature(
            nodes[0].copy(),
            nodes[1][:-1].copy(),
            error_bound=float(np.abs(errors).max()),
            rms_error=float(np.sqrt(np.mean(errors**2))),
            slope_error=float(np.abs(self._rays.slopes(*nodes) / self._slope - 1.0).max()),
            max_path=self._range if len(self._range) > 1 else self._range[0],
            filter=nodes[1][-1].copy(),
        )
