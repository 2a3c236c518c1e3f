"""The Earth field in an online estimator: how much it counts."""

from dataclasses import replace

import numpy as np

from magfusion.fusion.earth import (
    AMBIENT_TIME,
    DISTURBED,
    EARTH_LOSS,
    earth_cov,
    speed_sigma,
    with_earth,
)
from magfusion.fusion.epoch import field_rows, single
from magfusion.fusion.factors import FieldMeasurements, robust_weight
from magfusion.fusion.state import State
from magfusion.parameters import Block
from magfusion.records.samples import SteadyFields
from magfusion.units import Array

GATE = 16.3  # chi square of three components, one in a thousand


class EarthWatch:
    """What an online estimator keeps to measure the Earth field.

    Parameters
    ----------
    blocks : tuple of Block
        Calibration parameters in the state's tangent.
    """

    def __init__(self, blocks: tuple[Block, ...]) -> None:
        self.blocks = blocks
        self._refused_at = -np.inf  # s

    def weighed(
        self, measurements: FieldMeasurements, steady: SteadyFields, state: State, step: float
    ) -> tuple[FieldMeasurements, bool]:
        """Return an epoch's measurements with the Earth field, and whether that is disturbed.

        Parameters
        ----------
        measurements : FieldMeasurements
        steady : SteadyFields
        state : State
            As predicted: the farther from it, the less the field counts, and at last nothing; nor
            for a while after, since what lets go for an epoch would be followed where it leads.
        step : float
            Since the epoch before (s).
        """
        cov = earth_cov(state.calibration.site, steady)
        measured = with_earth(measurements, steady, cov, step)
        assert measured.earth_repeats is not None
        rows = field_rows(single(measured, self.blocks), state)
        distance = _distance(rows.error[-6:-3], rows.jacobian[-6:-3], state.cov, measured)
        weight = float(robust_weight(distance, EARTH_LOSS, components=3)[0])
        if distance > GATE:
            self._refused_at = state.time
        if state.time - self._refused_at < AMBIENT_TIME:
            weight = 0.0
        root = measured.root.copy()
        root[:, -1] *= np.sqrt(weight)
        return replace(measured, root=root), bool(weight < DISTURBED)

    def speed_sigma(self, measurements: FieldMeasurements, step: float) -> float | None:
        """Return the sigma of no velocity, where no beacon holds the platform (m/s)."""
        return None if np.any(measurements.root[:, :-1]) else speed_sigma(step)


def _distance(error: Array, jacobian: Array, cov: Array, measured: FieldMeasurements) -> Array:
    """Return the squared Mahalanobis distance of an epoch that counts in full."""
    assert measured.earth_repeats is not None
    spread = measured.earth_repeats * (jacobian @ cov @ jacobian.T) + np.eye(3)
    return np.asarray(measured.earth_repeats * error @ np.linalg.solve(spread, error))
