"""The light estimator: an error-state Kalman filter, with filterpy as its arithmetic."""

from dataclasses import replace

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from magfusion.errors import EstimationError
from magfusion.fusion.epoch import Rows, field_rows, joined, rest_rows
from magfusion.fusion.factors import FieldFactors
from magfusion.fusion.propagation import Propagated
from magfusion.fusion.state import State, between, considered, moved
from magfusion.parameters import Block
from magfusion.units import Array


def _step(cov: Array, rows: Rows) -> tuple[Array, Array]:
    size = len(cov)
    kalman = ExtendedKalmanFilter(dim_x=size, dim_z=len(rows.error))
    kalman.x = np.zeros(size)  # filterpy's own (n, 1) would broadcast to a matrix
    kalman.P = cov
    kalman.update(
        -rows.error,
        HJacobian=lambda _: rows.jacobian,
        Hx=lambda step: rows.jacobian @ step,
        R=np.eye(len(rows.error)),
    )
    return np.asarray(kalman.x), np.asarray(0.5 * (kalman.P + kalman.P.T))


def _step_from_far(cov: Array, rows: Rows) -> tuple[Array, Array]:
    """Return step and covariance by QR: the innovation's covariance spans too many digits."""
    prior = np.linalg.inv(np.linalg.cholesky(cov))
    right = np.concatenate([np.zeros(len(cov)), -rows.error])
    orthogonal, root = np.linalg.qr(np.vstack([prior, rows.jacobian]))
    inverse = np.linalg.inv(root)
    return np.asarray(inverse @ (orthogonal.T @ right)), np.asarray(inverse @ inverse.T)


class ErrorStateFilter:
    """State of now, updated epoch by epoch.

    Parameters
    ----------
    state : State
        The start.
    blocks : tuple of Block
        Calibration parameters in its tangent.
    held : int
        Parameters at the tangent's end that are considered, not estimated.
    """

    def __init__(self, state: State, blocks: tuple[Block, ...], held: int = 0) -> None:
        self.blocks, self.state, self.held = blocks, state, held
        self.lagged = state

    def absorb(
        self,
        predicted: Propagated,
        fields: FieldFactors | None,
        rest_sigma: float | None,
        about: State | None = None,
    ) -> None:
        """Take in what was measured at the end of an interval.

        Parameters
        ----------
        predicted : Propagated
            From ``state``.
        fields : FieldFactors, optional
            Of the epoch.
        rest_sigma : float, optional
            Standard deviation of the velocity, where the platform stands (m/s).
        about : State, optional
            Where to linearise, if the prediction is too wide for it; then three times.

        Raises
        ------
        EstimationError
            Where the arithmetic fails; the state is then as it was.
        """
        prior = predicted.state
        state = prior if about is None else replace(about, cov=prior.cov)
        for _ in range(1 if about is None else 3):
            parts = [] if fields is None else [field_rows(fields, state)]
            parts += [] if rest_sigma is None else [rest_rows(state, rest_sigma)]
            if not parts:
                break
            rows = joined(parts)
            # Told about the prediction, which holds the prior.
            back = between(prior, state, self.blocks)
            told = Rows(rows.error - rows.jacobian @ back, rows.jacobian)
            try:
                found = (_step if about is None else _step_from_far)(prior.cov, told)
            except np.linalg.LinAlgError as error:
                raise EstimationError(f"the filter's update failed ({error})") from error
            step, cov = considered(*found, prior.cov, self.held)
            if not np.all(np.isfinite(step)):
                raise EstimationError("the filter's step is not finite")
            state = moved(replace(prior, cov=cov), self.blocks, step)
        self.state = self.lagged = state

    def replace_state(self, state: State) -> None:
        """Go on from another state."""
        self.state = self.lagged = state
