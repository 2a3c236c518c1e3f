"""How far the gains of beacons scatter from epoch to epoch, as the epochs themselves say.

A field that is stronger here and weaker there than the model has it is a gain of a beacon in each
epoch.  Free gains cost the range that an amplitude tells of; gains that are held where they err
cost more.  The evidence weighs the two.
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
from magfusion.units import Array, BoolArray, IntArray

LEAST, MOST = 0.003, 1.0  # of a log-gain; less is no spread, and more no beacon
ENOUGH = 200  # epochs, spread over a log, that are asked
TOLERANCE = 0.1  # of the logarithm of a spread
FEWEST = 10  # epochs, below which nothing is told of a spread


def gain_spread(
    samples: FieldSamples,
    calibration: Calibration,
    fixes: Fixes,
    *,
    gravity: Gravity | None = None,
    survey_error: bool = True,
    free: tuple[str, ...] = (),
) -> float:
    """Return the standard deviation of the log-gains that makes the epochs most likely.

    The evidence of an epoch is its likelihood with pose and gains integrated out by Laplace's
    method, the prior of a pose flat.  A spread is told where it beats none by more than Schwarz's
    criterion asks for one more parameter.

    Parameters
    ----------
    samples : FieldSamples
        Channels in the site's order.
    fixes : Fixes
        Of these epochs, gains held.
    gravity, survey_error
        As in `magfusion.estimation.snapshot.likelihood.fix_epochs`.
    free : tuple of str
        What else is found beside the pose.

    Returns
    -------
    float
        Zero where no spread is told; `GAIN_SIGMA` where too few epochs could tell of one.
    """
    rows = np.flatnonzero(fixes.determined[:, 0])
    if len(rows) < FEWEST:
        return GAIN_SIGMA
    rows = rows[:: max(1, -(-len(rows) // ENOUGH))]
    asked = _Asked(samples.rows(rows), calibration, _poses(fixes, rows), survey_error, free)
    own = None if gravity is None else gravity.rows(rows)
    widest, determined = asked.evidence(MOST, own)
    if np.sum(determined) < FEWEST:
        return GAIN_SIGMA

    def cost(log_spread: float) -> float:
        return float(np.sum(asked.evidence(float(np.exp(log_spread)), own)[0][determined]))

    held = float(np.sum(asked.evidence(0.0, own)[0][determined]))
    log_spread, told = minimise_between(cost, np.log(LEAST), np.log(MOST), TOLERANCE)
    at_most = float(np.sum(widest[determined]))
    if held - min(told, at_most) <= np.log(np.sum(determined)):
        return 0.0
    return MOST if at_most < told else float(np.exp(log_spread))


class _Asked:
    """Epochs, and what each beacon's gain is known by where the pose is."""

    def __init__(
        self,
        samples: FieldSamples,
        calibration: Calibration,
        poses: Trajectory,
        survey_error: bool,
        free: tuple[str, ...],
    ) -> None:
        self.samples, self.calibration, self.poses = samples, calibration, poses
        self.survey_error, self.free = survey_error, free
        site = calibration.site
        cov = measurement_cov(site, samples, survey_error=survey_error)
        white = whitening(cov, samples.there) @ np.nan_to_num(samples.phasor_sensor)[..., None]
        by_channel = np.sum(np.abs(white) ** 2, axis=(-1, -2))
        first = np.flatnonzero(np.diff(site.owner, prepend=-1))
        each = np.add.reduceat(by_channel, first, axis=1)
        self.known = np.sum(each.reshape(len(each), -1, len(site.beacons)), axis=1)

    def evidence(self, spread: float, gravity: Gravity | None) -> tuple[Array, BoolArray]:
        """Return minus twice the log evidence of each epoch, and which are determined."""
        found = refine(
            self.samples,
            self.calibration,
            self.poses,
            gravity=gravity,
            survey_error=self.survey_error,
            free=(*self.free, "gain") if spread > 0.0 else self.free,
            gain_sigma=spread if spread > 0.0 else MOST,
        )
        volume = np.linalg.slogdet(found.pose_cov[:, 0])[1]
        gains = np.sum(np.log1p(spread**2 * self.known), axis=1)
        return found.cost[:, 0] - volume + gains, found.determined[:, 0]


def _poses(fixes: Fixes, rows: IntArray) -> Trajectory:
    return Trajectory(
        fixes.time[rows], fixes.world_from_body[rows, 0], fixes.position_world[rows, 0]
    )
