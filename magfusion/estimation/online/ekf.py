"""The light estimator: an error-state Kalman filter on filterpy's equations."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.graph.kalman import PartialUpdateFilter, considered_share
from magfusion.estimation.graph.measurement import Measurement, measured_rows
from magfusion.estimation.graph.propagation import Propagated
from magfusion.estimation.graph.state import State, between, moved
from magfusion.estimation.measurements.phasors import leaves_out
from magfusion.model.parameters import Block
from magfusion.units import Array

FAR_ITERATIONS = 3  # where the prediction is too uncertain to linearise at


def informative_rows(
    measurements: Sequence[Measurement], state: State, blocks: tuple[Block, ...]
) -> tuple[Array, Array]:
    """Return `measured_rows` without the rows of undetected ones of many beacons."""
    error, jacobian = measured_rows(measurements, state, blocks)
    if not leaves_out(measurements):
        return error, jacobian
    kept = np.any(jacobian, axis=1)
    return error[kept], jacobian[kept]


class ErrorStateFilter(PartialUpdateFilter):
    """Current state, updated epoch by epoch.

    A filterpy filter whose nominal state is ``state``: `absorb` predicts, updates, moves the
    nominal state by ``x`` and sets ``x`` to zero.  Its attributes are filterpy's:

    - ``F`` and ``Q`` are transition and noise of the last interval, in the tangent of the states;
      the nominal state is propagated by preintegration, not by ``F``.
    - ``P`` is the covariance of ``state``.
    - Rows are whitened, so ``R`` is one; ``y`` is the innovation in units of its noise, and ``z``
      is measured minus predicted.  ``H``, ``K``, ``S``, ``log_likelihood`` and ``mahalanobis`` are
      of the last update, ``x_post`` is the correction of the predicted state.
    - A robust loss has already weighted the rows.

    `state`: initial state. `blocks`: calibration parameters in its tangent. `considered`:
    parameters at the tangent's end that are considered, not estimated.
    """

    state: State
    lagged: State

    def __init__(self, state: State, blocks: tuple[Block, ...], considered: int = 0) -> None:
        size = len(state.cov)
        super().__init__(size, considered_share(size, considered))
        self.blocks = blocks
        self.replace_state(state)

    def absorb(
        self,
        predicted: Propagated,
        measurements: Sequence[Measurement],
        linearization_point: State | None = None,
    ) -> None:
        """Update with the measurements at the end of an interval.

        `predicted`: from ``state``. `measurements`: of this epoch. `linearization_point`: where to
        linearise if the prediction is too uncertain; then three iterations. Raises EstimationError
        if the arithmetic fails; the state is then unchanged.
        """
        self.F, self.Q = predicted.transition, predicted.noise
        self.predict()
        try:
            state = self._update_nominal(predicted.state, measurements, linearization_point)
        except EstimationError:
            self.replace_state(self.state)
            raise
        self.replace_state(replace(state, cov=0.5 * (self.P + self.P.T)))

    def _update_nominal(
        self, prior: State, measurements: Sequence[Measurement], point: State | None
    ) -> State:
        """Return the state moved by the update, with its covariance unchanged."""
        state, cov = prior if point is None else replace(point, cov=prior.cov), self.P
        for _ in range((1 if point is None else FAR_ITERATIONS) if measurements else 0):
            self.x, self.P = np.zeros(len(cov)), cov
            error, jacobian = informative_rows(measurements, state, self.blocks)
            if state is not prior:  # from the prediction, which contains the prior
                error = error - jacobian @ between(prior, state, self.blocks)
            update = self.update_linear if point is None else self.update_from_far
            try:
                update(-error, jacobian)
            except ValueError as failure:  # SciPy's for non-finite values, and LinAlgError
                raise EstimationError(f"the filter's update failed ({failure})") from failure
            if not np.all(np.isfinite(self.x)):
                raise EstimationError("the filter's step is not finite")
            state = moved(prior, self.blocks, self.x)
        return state

    def replace_state(self, state: State) -> None:
        """Continue from another state."""
        self.state = self.lagged = state
        self.x, self.P = np.zeros(len(state.cov)), state.cov
