"""What fixes that enter the graph as poses have in common: the error of the survey."""

import numpy as np

from magfusion.fixes.problem import nuisance_blocks
from magfusion.fixes.survey import survey_jacobians
from magfusion.parameters import Calibration
from magfusion.records.samples import FieldSamples
from magfusion.trajectory import Trajectory
from magfusion.units import Array
from magfusion.weights import measurement_cov, sensor_positions, whitening


def survey_cov(declared: Calibration, samples: FieldSamples, states: Trajectory) -> Array:
    """Return what the survey's error does to every fix alike, shape (n, 6, 6).

    The graph takes the fixes' errors for independent, but no number of fixes averages it out.
    """
    cov = measurement_cov(
        declared.site,
        samples,
        survey_error=True,
        sensor_world=sensor_positions(declared.site, states),
    )
    by_found, by_survey = survey_jacobians(
        declared,
        nuisance_blocks(declared.site),
        samples.time,
        states.world_from_body,
        states.position_world,
        whitening(cov, samples.valid),
    )
    moved = (np.linalg.pinv(by_found) @ by_survey)[:, :6]
    return np.asarray(moved @ np.swapaxes(moved, 1, 2))
