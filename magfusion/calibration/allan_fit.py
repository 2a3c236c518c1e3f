"""White noise, bias instability and random walk from an Allan variance, with their intervals.

``variance(tau) = 3 q^2 / tau^2 + n^2 / tau + 2 ln 2 / pi b^2 + k^2 tau / 3``, each square at least
zero (IEEE Std 952-1997, annex C): quantization, white noise, flicker noise, random walk.  An
Allan variance is distributed as a chi square with at least as many degrees of freedom as it has
clusters, which sets its weight.  Estimates at cluster times a factor of two apart are correlated by
0.5 for white noise and by 0.88 for random walk (2^14 samples, 600 channels, simulated); the
intervals account for it.

Where a drift or a tone makes another shape, white noise is read where the slope of the deviation is
-1/2, whatever the longer cluster times show.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from magfusion.calibration.allan import AllanVariance
from magfusion.units import Array

FLICKER = 2.0 * np.log(2.0) / np.pi
MIN_CLUSTERS = 2.0  # side by side, that a cluster time has
MIN_POINTS = 6  # cluster times that a fit needs
SHAPE = 0.05  # relative: what an instrument may deviate from these four at any cluster time
MIN_WHITE = 5  # cluster times that separate white noise from a drift
CLEAN = 1.0  # chi square a degree of freedom of cluster times with white noise and a drift
WHITE_SHARE = 0.5  # of an Allan variance, where its slope is that of white noise
FILTERED = 6  # octaves at the beginning that an instrument's own filter may spoil
GOOD = 0.6  # of the chi square a degree of freedom, from which another beginning is tried
MISFIT = 2.5  # of the same, from which the noise is of another kind
MAX_ITERATIONS, CONVERGED_STEP = 30, 1e-5
TWO_SIDED, ONE_SIDED = 1.96, 1.645  # of 95 %
# Correlation of cluster times that are 0, 1, 2 ... octaves apart.
_WHITE_CORRELATION = np.array([1.0, 0.52, 0.2, 0.05])
_WALK_CORRELATION = np.array([1.0, 0.88, 0.65, 0.46, 0.31, 0.2, 0.12, 0.06])


@dataclass(frozen=True)
class Fitted:
    """An estimate with its 95 % interval; ``low`` is zero where it may be absent."""

    value: float
    low: float
    high: float

    @property
    def is_significant(self) -> bool:
        """Whether it differs significantly from zero."""
        return self.low > 0.0


@dataclass(frozen=True, eq=False)
class AllanFit:
    """Noise components of the Allan deviation of one axis."""

    white: Fitted  # ``n``, in the stream's unit times sqrt(s)
    # ``b``, in the stream's unit: the minimum Allan deviation is 0.664 of it where it is flat
    instability: Fitted
    walk: Fitted  # ``k``, in the stream's unit per sqrt(s)
    steps: float  # ``q``, in the stream's unit times s
    # least, least_tau: the minimum Allan deviation of the fit within the cluster times, and where
    # (s)
    least: float
    least_tau: float
    turns: bool  # whether it rises again after the minimum
    misfit: float  # reduced chi square
    # worst_tau, worst: where the fit deviates most (s), and by which factor of the deviation
    worst_tau: float
    worst: float
    first_tau: float  # where the fit begins (s)

    def deviation(self, tau: Array) -> Array:
        """Return the Allan deviation of the fit at cluster times (s)."""
        squares = np.array([self.steps, self.white.value, self.instability.value, self.walk.value])
        return np.sqrt(_design(tau) @ squares**2)

    @property
    def covering_walk(self) -> float:
        """The random walk that, with white noise alone, covers the minimum and the rise after it.

        An estimator models white noise and a random walk, but no flicker: with ``sqrt(3) v / (2
        n)`` their minimum Allan variance is the estimated ``v``.
        """
        walk = self.walk.value if self.walk.is_significant else self.walk.high
        if self.white.value == 0.0:
            return walk
        return max(float(np.sqrt(3.0) * self.least**2 / (2.0 * self.white.value)), walk)


def fit_allan(result: AllanVariance, axis: int) -> AllanFit | None:
    """Return the noise components of an axis' Allan variance; None for too few cluster times.

    An instrument's own filter makes short clusters smoother than white noise.  Where the fit does
    not match them, it begins at longer cluster times.
    """
    enough = np.asarray(result.clusters >= MIN_CLUSTERS)
    usable = np.logical_and.reduce([result.octave, enough, result.variance[:, axis] > 0.0])
    tau, variance = result.tau[usable], result.variance[usable, axis]
    clusters = result.clusters[usable]
    best: AllanFit | None = None
    for first in range(FILTERED + 1):
        if len(tau) - first < MIN_POINTS:
            break
        part = slice(first, None)
        fit = _fit(tau[part], variance[part], clusters[part])
        if best is None or fit.misfit < 0.5 * best.misfit:
            best = fit
        if best.misfit < GOOD:
            break
    if best is None or best.misfit < GOOD:
        return best
    return replace(best, white=_white_slope(tau, variance, clusters) or best.white)


def _white_slope(tau: Array, variance: Array, clusters: Array) -> Fitted | None:
    """Return the white noise of the longest cluster times where only a drift adds to it.

    There the deviation has the slopes of quantization, white noise, walk and ramp; the fifth
    component of IEEE Std 952, the ramp, is also what a slow tone is at first.
    """
    for count in range(len(tau), MIN_WHITE - 1, -1):
        for first in range(min(FILTERED + 1, len(tau) - count + 1)):
            part = slice(first, first + count)
            fitted = _white_with_drift(tau[part], variance[part], 2.0 / clusters[part] + SHAPE**2)
            if fitted is not None:
                return fitted
    return None


def _white_with_drift(tau: Array, variance: Array, relative: Array) -> Fitted | None:
    """Return white noise where quantization, walk and ramp explain the rest; otherwise None."""
    design = np.stack([1.0 / tau, 3.0 / tau**2, tau / 3.0, 0.5 * tau**2], axis=-1)
    square, model = _reweighted(design, variance, relative)
    there = square > 0.0
    freedom = max(len(tau) - int(np.sum(there)), 1)
    misfit = float(np.sum((variance / model - 1.0) ** 2 / relative)) / freedom
    share = square[0] / tau / model
    if misfit > CLEAN or np.max(share) < WHITE_SHARE:
        return None
    weighed = design[:, there] / (np.sqrt(relative) * model)[:, None]
    scale = np.linalg.norm(weighed, axis=0)
    cov = np.linalg.pinv((weighed / scale).T @ (weighed / scale), hermitian=True)
    # Neighbours share half of their errors, and all of them the instrument's shape.
    sigma = float(np.sqrt(2.0 * cov[0, 0])) / scale[0] + SHAPE * square[0]
    return _fitted(float(square[0]), float(sigma))


def _design(tau: Array) -> Array:
    return np.stack([3.0 / tau**2, 1.0 / tau, np.full_like(tau, FLICKER), tau / 3.0], axis=-1)


def _fit(tau: Array, variance: Array, clusters: Array) -> AllanFit:
    design = _design(tau)
    relative = 2.0 / clusters + SHAPE**2
    square, model = _reweighted(design, variance, relative)
    cov = _covariance(design, model, relative, clusters, square)
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    off = variance / model
    freedom = max(len(tau) - int(np.sum(square > 0.0)), 1)
    misfit = float(np.sum((off - 1.0) ** 2 / relative)) / freedom
    worst = int(np.argmax(np.abs(np.log(off)) / np.sqrt(relative)))
    fine = np.geomspace(tau[0], tau[-1], 400)
    curve = np.sqrt(_design(fine) @ square)
    least = int(np.argmin(curve))
    return AllanFit(
        white=_fitted(square[1], sigma[1] * max(1.0, float(np.sqrt(misfit)))),
        instability=_fitted(square[2], sigma[2]),
        walk=_fitted(square[3], sigma[3]),
        steps=float(np.sqrt(square[0])),
        least=float(curve[least]),
        least_tau=float(fine[least]),
        turns=bool(curve[-1] > 1.1 * curve[least]),
        misfit=misfit,
        worst_tau=float(tau[worst]),
        worst=float(np.sqrt(off[worst])),
        first_tau=float(tau[0]),
    )


def _reweighted(design: Array, variance: Array, relative: Array) -> tuple[Array, Array]:
    """Return squared components, and the variance they make, weighted by that variance itself."""
    model = variance
    for _ in range(MAX_ITERATIONS):
        weight = 1.0 / (np.sqrt(relative) * model)
        square = _not_negative(design * weight[:, None], variance * weight)
        before, model = model, np.maximum(design @ square, 1e-6 * variance)
        if np.all(np.abs(model - before) < CONVERGED_STEP * model):
            break
    return square, model


def _not_negative(design: Array, value: Array) -> Array:
    """Return the non-negative least-squares solution, the best over all sets of zero unknowns."""
    scale = np.linalg.norm(design, axis=0)
    best, cost = np.zeros(design.shape[1]), float(value @ value)
    for count in range(1, design.shape[1] + 1):
        for chosen in combinations(range(design.shape[1]), count):
            columns = list(chosen)
            part = np.linalg.lstsq(design[:, columns] / scale[columns], value, rcond=None)[0]
            residual = value - design[:, columns] @ (part / scale[columns])
            if np.all(part >= 0.0) and float(residual @ residual) < cost:
                best = np.zeros(design.shape[1])
                best[columns] = part / scale[columns]
                cost = float(residual @ residual)
    return best


def _covariance(
    design: Array, model: Array, relative: Array, clusters: Array, square: Array
) -> Array:
    """Return the covariance of the squares, with neighbouring cluster times correlated.

    Flicker and walk are estimated even where their squares are zero; quantization only where its
    square is not.
    """
    free_parameters = [k for k in range(4) if k > 0 or square[0] > 0.0]
    weighed = design[:, free_parameters] / model[:, None] / relative[:, None]
    normal = (design[:, free_parameters] / model[:, None]).T @ weighed
    scale = np.sqrt(np.diag(normal))
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), hermitian=True)
    inverse = inverse / np.outer(scale, scale)
    white = np.minimum(design[:, :2] @ square[:2] / model, 1.0)
    separate = np.abs(np.arange(len(model))[:, None] - np.arange(len(model)))
    of_white = np.append(_WHITE_CORRELATION, 0.0)[np.minimum(separate, len(_WHITE_CORRELATION))]
    of_walk = np.append(_WALK_CORRELATION, 0.0)[np.minimum(separate, len(_WALK_CORRELATION))]
    both = np.outer(white, 1.0 - white)
    shared = np.outer(white, white) * of_white + np.outer(1.0 - white, 1.0 - white) * of_walk
    shared += (both + both.T) * np.sqrt(of_white * of_walk)
    spread = np.sqrt(2.0 / clusters)
    errors = shared * np.outer(spread, spread) + SHAPE**2 * of_walk
    gain = inverse @ weighed.T
    out = np.zeros((4, 4))
    out[np.ix_(free_parameters, free_parameters)] = gain @ errors @ gain.T
    return out


def _fitted(square: float, sigma: float) -> Fitted:
    """Return the square root of an estimated square, with its interval."""
    if square <= ONE_SIDED * sigma:
        return Fitted(float(np.sqrt(square)), 0.0, float(np.sqrt(square + ONE_SIDED * sigma)))
    # For a square well above zero, the logarithm is more symmetric.
    width = float(np.exp(TWO_SIDED * sigma / (2.0 * square)))
    root = float(np.sqrt(square))
    return Fitted(root, root / width, root * width)
