"""Field of one beacon relative to its model, over the surveyed positions.

``field = exp(g) (model + w x model)``: a Gaussian process of the logarithm g of the gain and of a
small rotation w, functions of the sensor's position.  `magfusion.calibration.fieldmap` estimates
it; `magfusion.model.field.observe` applies it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magfusion.units import Array

COMPONENTS = 4  # log-gain, then the rotation about x, y, z
_ROWS = 8192  # positions evaluated at once


@dataclass(frozen=True, eq=False)
class FieldMap:
    """A Gaussian process with a squared-exponential kernel, conditioned on a survey."""

    points_world: Array  # (m, 3), of the sensor (m)
    weights: Array  # (m, 4), the mean at x is ``sigma^2 sum_j rho(x, x_j) weights_j``
    information: Array  # (m, 4, 4), information of the survey on gain and rotation at each point
    length_scale: float  # (m)
    # gain_sigma, rotation_sigma: of the process, far from surveyed points; the latter in rad
    gain_sigma: float
    rotation_sigma: float
    # relative error of the field not explained by a smooth map, one sigma; it replaces the site's
    # ``model_error``
    residual: float

    @cached_property
    def component_sigma(self) -> Array:
        """Standard deviation of the process in each component, shape (4,)."""
        return np.array([self.gain_sigma, *[self.rotation_sigma] * 3])

    @cached_property
    def _reduction(self) -> Array:
        """``(1 + information K)^-1 information`` within each component, shape (4, m, m)."""
        count = len(self.points_world)
        near = correlation(self.points_world, self.points_world, self.length_scale)
        system = posterior_system(near, self.component_sigma, self.information)
        reduction = np.linalg.solve(system, block_diagonal(self.information))
        reduction = reduction.reshape(count, COMPONENTS, count, COMPONENTS)
        return np.moveaxis(np.diagonal(reduction, axis1=1, axis2=3), -1, 0).copy()

    @cached_property
    def typical_variance(self) -> Array:
        """Median over the survey's points of `variance`, shape (2,)."""
        return np.median(self.variance(self.points_world), axis=0)

    def mean(self, position_world: Array) -> tuple[Array, Array]:
        """Return the map and its gradient.

        `position_world` (..., 3): of the sensor (m). Returns `value` (..., 4): log-gain and
        rotation (rad, world axes); `gradient` (..., 4, 3): with respect to the position, world axes
        (1/m).
        """
        flat = position_world.reshape(-1, 3)
        value, gradient = np.empty((len(flat), 4)), np.empty((len(flat), 4, 3))
        scaled = self.weights * self.component_sigma**2
        moment = scaled[:, :, None] * self.points_world[:, None, :]
        for start in range(0, len(flat), _ROWS):
            rows = slice(start, start + _ROWS)
            near = correlation(flat[rows], self.points_world, self.length_scale)
            value[rows] = near @ scaled
            pulled = (near @ moment.reshape(len(moment), -1)).reshape(-1, 4, 3)
            gradient[rows] = pulled - value[rows, :, None] * flat[rows, None, :]
        gradient /= self.length_scale**2
        shape = position_world.shape[:-1]
        return value.reshape(*shape, 4), gradient.reshape(*shape, 4, 3)

    def variance(self, position_world: Array) -> Array:
        """Return the variance of log-gain and, mean of three axes, of rotation; shape (n, 2)."""
        out = np.empty((len(position_world), 2))
        rows = max(1, _ROWS // max(1, len(self.points_world)))
        prior = self.component_sigma**2
        for start in range(0, len(position_world), rows):
            part = slice(start, start + rows)
            near = correlation(position_world[part], self.points_world, self.length_scale)
            known = prior**2 * np.einsum("ani,ni->na", near @ self._reduction, near)
            remaining = np.maximum(prior - known, 0.0)
            out[part] = np.stack([remaining[:, 0], np.mean(remaining[:, 1:], axis=1)], axis=1)
        return out

    def relative_variance(self, position_world: Array | None = None) -> Array:
        """Return the mean square of the field's error relative to its strength.

        `position_world` (n, 3): of the sensor (m); None for a typical surveyed position. Returns
        (n,) or ().
        """
        known = self.typical_variance if position_world is None else self.variance(position_world)
        # A rotation changes the field by its two components across the field.
        return self.residual**2 + known[..., 0] + 2.0 * known[..., 1]


def correlation(first_world: Array, second_world: Array, length_scale: float) -> Array:
    """Return the correlation of the process between positions, shape (n, m)."""
    square = np.sum((first_world[:, None] - second_world) ** 2, axis=-1)
    return np.exp(-0.5 * square / length_scale**2)


def posterior_system(near: Array, sigma: Array, information: Array) -> Array:
    """Return ``1 + information K``, K the prior covariance at the points, shape (4 m, 4 m).

    Of their correlation (m, m), the sigmas (4,) and the points' information (m, 4, 4).
    """
    product = information[:, :, None, :] * sigma**2 * near[:, None, :, None]
    size = COMPONENTS * len(near)
    return np.asarray(np.eye(size) + product.reshape(size, size))


def block_diagonal(blocks: Array) -> Array:
    """Return block-diagonal matrices of blocks (..., k, m, m), shape (..., k m, k m)."""
    count, size = blocks.shape[-3:-1]
    out = np.zeros((*blocks.shape[:-3], count, size, count, size))
    for i in range(count):
        out[..., i, :, i, :] = blocks[..., i, :, :]
    return out.reshape(*blocks.shape[:-3], count * size, count * size)
