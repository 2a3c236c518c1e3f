"""Maximum-likelihood spread of the beacon gains over the epochs.

A field-model error that varies with position is a gain of a beacon in each epoch.  Estimated gains
lose the range information of the amplitudes; fixed gains that are wrong cause a larger error.  The
evidence decides between the two.
"""

import numpy as np

from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.problem import GAIN_SIGMA
from magfusion.estimation.snapshot.refine import refine
from magfusion.estimation.solve.bounded import minimise_between
from magfusion.model.noise import measurement_cov, whitening
from magfusion.model.parameters import Calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray

MIN_LOG_GAIN, MAX_LOG_GAIN = 0.003, 1.0  # of a log-gain; less is no spread, and more no beacon
ENOUGH = 200  # epochs used, spread over a log
TOLERANCE = 0.1  # of the logarithm of a spread
MIN_EPOCHS = 10  # epochs needed to estimate a spread


def gain_spread(
    samples: FieldSamples,
    calibration: Calibration,
    fixes: Fixes,
    *,
    gravity: Gravity | None = None,
    survey_error: bool = True,
    free_parameters: tuple[str, ...] = (),
) -> float:
    """Return the standard deviation of the log-gains that maximises the evidence.

    The evidence of an epoch is its likelihood with pose and gains integrated out by Laplace's
    method, with a flat prior of the pose.  A spread is accepted if it improves the evidence by
    more than Schwarz's criterion requires for one more parameter.

    Parameters
    ----------
    samples : FieldSamples
        Channels in the site's order.
    fixes : Fixes
        Of these epochs, with fixed gains.
    gravity, survey_error
        As in `magfusion.estimation.snapshot.likelihood.fix_epochs`.
    free_parameters : tuple of str
        Other parameters estimated with the pose.

    Returns
    -------
    float
        Zero if no spread is accepted; `GAIN_SIGMA` if there are too few epochs.
    """
    rows = np.flatnonzero(fixes.determined[:, 0])
    if len(rows) < MIN_EPOCHS:
        return GAIN_SIGMA
    rows = rows[:: max(1, -(-len(rows) // ENOUGH))]
    requested = _GainLikelihood(
        samples.rows(rows), calibration, fixes.best().rows(rows), survey_error, free_parameters
    )
    own = None if gravity is None else gravity.rows(rows)
    widest, determined = requested.evidence(MAX_LOG_GAIN, own)
    if np.sum(determined) < MIN_EPOCHS:
        return GAIN_SIGMA

    def cost(log_spread: float) -> float:
        return float(np.sum(requested.evidence(float(np.exp(log_spread)), own)[0][determined]))

    fixed = float(np.sum(requested.evidence(0.0, own)[0][determined]))
    log_spread, reported = minimise_between(
        cost, np.log(MIN_LOG_GAIN), np.log(MAX_LOG_GAIN), TOLERANCE
    )
    at_most = float(np.sum(widest[determined]))
    if fixed - min(reported, at_most) <= np.log(np.sum(determined)):
        return 0.0
    return MAX_LOG_GAIN if at_most < reported else float(np.exp(log_spread))


class _GainLikelihood:
    """Epochs, and the information on each beacon's gain at the poses."""

    def __init__(
        self,
        samples: FieldSamples,
        calibration: Calibration,
        poses: Trajectory,
        survey_error: bool,
        free_parameters: tuple[str, ...],
    ) -> None:
        self.samples, self.calibration, self.poses = samples, calibration, poses
        self.survey_error, self.free_parameters = survey_error, free_parameters
        site = calibration.site
        cov = measurement_cov(site, samples, survey_error=survey_error)
        white = whitening(cov, samples.there) @ np.nan_to_num(samples.phasor_sensor)[..., None]
        by_channel = np.sum(np.abs(white) ** 2, axis=(-1, -2))
        first = np.flatnonzero(np.diff(site.owner, prepend=-1))
        each = np.add.reduceat(by_channel, first, axis=1)
        self.known = np.sum(each.reshape(len(each), -1, len(site.beacons)), axis=1)

    def evidence(self, spread: float, gravity: Gravity | None) -> tuple[Array, BoolArray]:
        """Return minus twice the log evidence of each epoch, and which are determined."""
        result = refine(
            self.samples,
            self.calibration,
            self.poses,
            gravity=gravity,
            survey_error=self.survey_error,
            free_parameters=(*self.free_parameters, "gain")
            if spread > 0.0
            else self.free_parameters,
            gain_sigma=spread if spread > 0.0 else MAX_LOG_GAIN,
        )
        volume = np.linalg.slogdet(result.pose_cov[:, 0])[1]
        gains = np.sum(np.log1p(spread**2 * self.known), axis=1)
        return result.cost[:, 0] - volume + gains, result.determined[:, 0]
