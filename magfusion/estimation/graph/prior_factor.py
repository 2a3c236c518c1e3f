"""The prior of a calibration as a linear factor, and shifts of its mean."""

from typing import NamedTuple

import gtsam
import numpy as np

from magfusion.estimation.graph.factors import CALIBRATION_KEY, CONSIDERED_KEY
from magfusion.model.parameters import Block, Calibration, difference
from magfusion.model.prior import prior_sqrt_information
from magfusion.units import Array


class PriorShift(NamedTuple):
    """Shift of the mean of a prior from other logs by uncertainties besides the calibration."""

    by_considered: Array  # (dimension, considered), shift by one sigma of each considered parameter
    # (dimension, k), shift by a unit of each of ``k`` errors that do not affect this log
    separate_errors: Array

    def with_separate_errors(self, spread: Array) -> tuple[Array, Array]:
        """Return a spread with columns for the separate errors, and the shift in these columns.

        `spread` (uncertain, n): considered parameters first.
        """
        between = spread.shape[1] - self.by_considered.shape[1]
        wider = np.pad(spread, ((0, 0), (0, self.separate_errors.shape[1])))
        nothing = np.zeros((len(self.separate_errors), between))
        return wider, np.concatenate([self.by_considered, nothing, self.separate_errors], axis=1)


def prior_factor(
    declared: Calibration,
    calibration: Calibration,
    blocks: tuple[Block, ...],
    shift: Array | None = None,
) -> gtsam.JacobianFactor:
    """Return the prior at a calibration.

    `shift` (dimension, n): shift of its mean by a unit of each fixed parameter.
    """
    sqrt_information = prior_sqrt_information(declared.site, blocks)
    error = -sqrt_information @ difference(declared, calibration, blocks)
    unit = gtsam.noiseModel.Unit.Create(len(sqrt_information))
    if shift is None:
        return gtsam.JacobianFactor(CALIBRATION_KEY, sqrt_information, error, unit)
    by_others = -sqrt_information @ shift
    return gtsam.JacobianFactor(
        CALIBRATION_KEY, sqrt_information, CONSIDERED_KEY, by_others, error, unit
    )
