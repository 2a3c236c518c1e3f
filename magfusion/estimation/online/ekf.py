"""The light estimator: an error-state Kalman filter, with filterpy as its arithmetic."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from magfusion.errors import EstimationError
from magfusion.estimation.graph.measurement import Measurement, measured_rows
from magfusion.estimation.graph.propagation import Propagated
from magfusion.estimation.graph.state import (
    State,
    between,
    consider_update,
    moved,
)
from magfusion.estimation.measurements.phasors import leaves_out
from magfusion.model.parameters import Block
from magfusion.units import Array


def telling_rows(
    measurements: Sequence[Measurement], state: State, blocks: tuple[Block, ...]
) -> tuple[Array, Array]:
    """Return `measured_rows` without those, of many beacons, of what was not heard."""
    error, jacobian = measured_rows(measurements, state, blocks)
    if not leaves_out(measurements):
        return error, jacobian
    kept = np.any(jacobian, axis=1)
    return error[kept], jacobian[kept]


def _step(kalman: Any, cov: Array, error: Array, jacobian: Array) -> tuple[Array, Array]:
    kalman.x = np.zeros(len(cov))  # filterpy's own (n, 1) would broadcast to a matrix
    kalman.P = cov
    kalman.update(
        -error,
        HJacobian=lambda _: jacobian,
        Hx=lambda step: jacobian @ step,
        R=np.eye(len(error)),
    )
    return np.asarray(kalman.x), np.asarray(0.5 * (kalman.P + kalman.P.T))


def _step_from_far(cov: Array, error: Array, jacobian: Array) -> tuple[Array, Array]:
    """Return step and covariance by QR: the innovation's covariance spans too many digits."""
    prior = np.linalg.inv(np.linalg.cholesky(cov))
    right = np.concatenate([np.zeros(len(cov)), -error])
    orthogonal, root = np.linalg.qr(np.vstack([prior, jacobian]))
    inverse = np.linalg.inv(root)
    return inverse @ (orthogonal.T @ right), inverse @ inverse.T


class ErrorStateFilter:
    """State of now, updated epoch by epoch.

    Parameters
    ----------
    state : State
        The start.
    blocks : tuple of Block
        Calibration parameters in its tangent.
    considered : int
        Parameters at the tangent's end that are considered, not estimated.
    """

    state: State
    lagged: State

    def __init__(self, state: State, blocks: tuple[Block, ...], considered: int = 0) -> None:
        self.blocks, self.state, self.considered = blocks, state, considered
        self.lagged = state
        # How much is measured, each update says; to make another filter costs a third of one.
        self._kalman = ExtendedKalmanFilter(dim_x=len(state.cov), dim_z=1)

    def absorb(
        self,
        predicted: Propagated,
        measurements: Sequence[Measurement],
        linearization_point: State | None = None,
    ) -> None:
        """Take in what was measured at the end of an interval.

        Parameters
        ----------
        predicted : Propagated
            From ``state``.
        measurements : sequence of Measurement
            Of this epoch.
        linearization_point : State, optional
            Where to linearise, if the prediction is too wide for it; then three times.

        Raises
        ------
        EstimationError
            Where the arithmetic fails; the state is then as it was.
        """
        prior, far = predicted.state, linearization_point is not None
        state = (
            prior if linearization_point is None else replace(linearization_point, cov=prior.cov)
        )
        for _ in range((3 if far else 1) if measurements else 0):
            error, jacobian = telling_rows(measurements, state, self.blocks)
            if state is not prior:  # from the prediction, which holds the prior
                error = error - jacobian @ between(prior, state, self.blocks)
            try:
                found = (
                    _step_from_far(prior.cov, error, jacobian)
                    if far
                    else _step(self._kalman, prior.cov, error, jacobian)
                )
            except np.linalg.LinAlgError as failure:
                raise EstimationError(f"the filter's update failed ({failure})") from failure
            step, cov = consider_update(*found, prior.cov, self.considered)
            if not np.all(np.isfinite(step)):
                raise EstimationError("the filter's step is not finite")
            state = moved(replace(prior, cov=cov), self.blocks, step)
        self.state = self.lagged = state

    def replace_state(self, state: State) -> None:
        """Go on from another state."""
        self.state = self.lagged = state
