"""Whether a result is to be believed: findings, the verdict that they make, and what is unverified.

`trustworthy` means that the covariance is right; `doubtful` that it has been inflated until it is,
with the reason; `failed` that there is no result.  No truth has a part in any of it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from magfusion.model.short_repr import one_line
from magfusion.units import Array, IntArray

# What a finding is about, by its code: the documentation of ``reasons`` in report.json.
CODES = {
    "accel_scale": "the mean specific force is not gravity's, by a scale or a bias",
    "accel_units": "the specific force is in another unit",
    "ambiguous": "another pose, or place of a beacon, explains the measurements nearly as well",
    "angle_convention": "the attitudes of beacons follow another convention",
    "angle_units": "the attitudes of beacons are in another unit",
    "assumed": "something that nobody said was assumed",
    "beacon_clock": "a beacon's clock is not as declared",
    "beacon_excluded": "a beacon contradicts the others and was left out, where it does",
    "beacon_fault": "the field of a beacon is false, for a while or altogether",
    "beacon_pose": "a beacon is not where, or not turned as, it was surveyed",
    "beacons_swapped": "beacons are taken for each other",
    "beacons_unheard": "of many beacons a log hears some; the others stay as declared",
    "body_iron": "iron or a magnet on the body changes the field",
    "changed": "a gain, a clock, a mount or a beacon is another from some time of the log on",
    "coil_reversed": "a coil of a beacon is wired in reverse, or exchanged for another",
    "coils_swapped": "the coils of every beacon are exchanged",
    "demodulated_apart": "several magnetometers were demodulated each by itself",
    "diverged": "the estimator neither converged nor explains what was measured",
    "drive_current": "the current recorded of a coil is not the one declared, or noisy",
    "earth_field": "the steady field is not the Earth's as declared",
    "epoch_shift": "the stamps are shifted against the epoch of the drive phases",
    "false_samples": "single samples of the magnetometer are false",
    "few_data": "what was measured is too little for a part of what was asked",
    "field_innovations": "fields of a beacon deviate from their prediction by more than is claimed",
    "field_residuals": "fields of a beacon deviate from the model by more than was declared",
    "field_scale": "all fields are larger or smaller than declared, by one factor",
    "field_units": "the field is in another unit",
    "fitted_line": "something undeclared transmits, and is fitted beside the tones",
    "fix_disagrees": "a fix of one epoch alone finds the platform elsewhere",
    "found_again": "the platform was lost, and found again by a fix",
    "frozen_imu": "gyroscope or accelerometer stands still for a while",
    "frozen_magnetometer": "the magnetometer stands still for a while",
    "gain_spread": "the fields are larger or smaller than the site's, from place to place",
    "gap": "a stream has no samples for a while",
    "geometry": "the beacons leave a direction of the pose open",
    "gravity": "gravity, as the accelerometer has it, is not of the declared size",
    "gravity_direction": "the mean specific force contradicts gravity at the estimated attitude",
    "gravity_missing": "gravity has been removed from the specific force",
    "gravity_sign": "the accelerometer's vertical points the other way",
    "ground": "the conductivity of ground or water is not as declared",
    "gyro_field": "the steady field does not turn as the gyroscope says",
    "gyro_scale": "the gyroscope's scale is wrong",
    "gyro_sign": "the sign of the gyroscope, or of one axis, is reversed",
    "gyro_units": "the rates are in another unit",
    "imu_axes": "axes of the inertial sensor are exchanged",
    "imu_bias": "a bias of the inertial sensor is larger than declared",
    "imu_clock": "the IMU's clock runs at another rate than the magnetometer's",
    "imu_noise": "the inertial samples scatter by more than is declared of their sensor",
    "imu_spikes": "single samples of the inertial sensor are false",
    "inertial_residuals": "the inertial data contradict the motion by more than was declared",
    "iron": "the fields deviate from the beacons' model from place to place",
    "jitter": "stamps are uneven",
    "length_units": "the positions of beacons are in another unit",
    "lever_arm": "the lever arm of the magnetometer is not as declared",
    "log_left_out": "one of several logs has no part in what they refine, as it failed alone",
    "logs_disagree": "a log contradicts the others about the site that they share",
    "long_windows": "tones are told apart in long windows where short ones could not be used",
    "lost": "nothing explains the fields where the platform is thought to be",
    "low_signal": "beacons are not told from noise",
    "magnetometer_axes": "the magnetometer's axes are left-handed",
    "magnetometer_clock": "the clock of one of several magnetometers is not as declared",
    "magnetometer_excluded": "one of several magnetometers contradicts the others",
    "magnetometer_matrix": "the magnetometer's matrix, with the iron about it, is not as declared",
    "magnetometer_offset": "the magnetometer's offset is not as declared",
    "magnetometer_silent": "one of several magnetometers hears nothing",
    "magnetometers_contradict": "magnetometers contradict each other, and none can be named",
    "mains": "mains in the field",
    "metal_near": "metal or iron came near a lone beacon or the sensor, and changes its field",
    "missing_samples": "samples hold no number",
    "moment_units": "the moments of all beacons are off by the factor of a unit or a convention",
    "moments": "the moments of beacons are not as declared",
    "mounting": "magnetometer and inertial sensor are not mounted as declared",
    "no_covariance": "the algorithm of a paper tells no covariance of what it finds",
    "no_redundancy": "without some beacon the pose is not determined: no protection level",
    "no_solution": "the estimator found no trajectory that explains the log",
    "no_start": "the data led to no first state",
    "no_window": "no part of the waveform can be demodulated",
    "noise_shape": "the noise is not white with a walking bias, as it is described",
    "noise_tuned": "noise or model error are other than declared",
    "not_at_rest": "what should have been at rest moved",
    "not_converged": "the last pass still moved the result by more than its sigmas allow",
    "other_site": "the fields contradict the site's file as a whole",
    "outside_region": "a pose is outside of the declared region or hemisphere",
    "phase": "the drive phase of a beacon is not as declared",
    "phase_sign": "the drive phases of all beacons have the wrong sign",
    "phase_units": "the drive phases are in another unit",
    "prior": "a calibration changed by more than the site's sigmas allow",
    "quantised": "the steps of an instrument are larger than its noise",
    "reference_hears": "the reference sensor hears a beacon, or may",
    "reference_unused": "the reference sensor tells nothing of the noise, or is not used",
    "region_edge": "a pose is so near the edge of its region that this tells no mirror from it",
    "repeated_samples": "an instrument is read faster than it measures",
    "repeated_stamps": "samples have the stamp of another",
    "restarts": "fields and inertial data lead apart again and again",
    "roll_open": "a receiver of one axis tells nothing of the roll about it",
    "sample_rate": "the clock of a stream runs at another rate than declared",
    "samples_lost": "samples are missing, one or a few at a time",
    "saturated": "samples stop at a limit of the instrument's range",
    "separation": "leaving a beacon out moves the pose by more than noise and survey explain",
    "sign_open": "amplitudes near zero, whose sign nothing tells, were left out",
    "silent_beacon": "a beacon is not heard, at all or for a while",
    "streams_apart": "inertial sensor and magnetometer were not recorded at the same time",
    "stuck_axis": "an axis stands still",
    "survey_axes": "the survey's axes are not those declared",
    "survey_overconfident": "the survey of the beacons is worse than its sigmas",
    "temperature_missing": "what is declared to change with temperature has none recorded",
    "time_offset": "the IMU's time offset is not as declared",
    "transfer": "a calibration does not hold where it was not made",
    "undeclared_line": "something transmits that the site does not declare",
    "unstable": "an estimator drifts over hours, or errs by other than it claims",
    "update_failed": "an update of the estimator failed; the state is a prediction",
}


class Verdict(StrEnum):
    """Of a result or of a state, from best to worst."""

    TRUSTWORTHY = "trustworthy"
    DOUBTFUL = "doubtful"
    FAILED = "failed"

    @property
    def rank(self) -> int:
        """How bad it is, from zero."""
        return list(Verdict).index(self)


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the worst of some verdicts; of none, trustworthy."""
    return max(verdicts, key=lambda verdict: verdict.rank, default=Verdict.TRUSTWORTHY)


@dataclass(frozen=True)
class Finding:
    """One reason not to trust a result.

    Parameters
    ----------
    code : str
        Of `CODES`.
    text : str
        A sentence or two: what, where, how much, the likely cause, the remedy.
    verdict : Verdict
        What it makes of the result, at least; trustworthy where it is only to be said.
    weight : float
        How strongly it speaks, in units of the limit of its test; the largest comes first.
    """

    code: str
    text: str
    verdict: Verdict = Verdict.DOUBTFUL
    weight: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "weight", float(self.weight))
        if self.code not in CODES:
            raise ValueError(f"{self.code} is not among the documented codes of findings")


# What follows of something else, which is named before it where it is found.
SYMPTOMS = frozenset(
    {
        "diverged",
        "field_residuals",
        "gyro_field",
        "no_solution",
        "no_start",
        "no_window",
        "not_converged",
        "restarts",
    }
)


def _importance(finding: Finding) -> tuple[int, float]:
    rank = finding.verdict.rank
    if finding.code in SYMPTOMS:
        rank = min(rank, Verdict.DOUBTFUL.rank)
    return -rank, -finding.weight


@dataclass(frozen=True)
class Unverified:
    """A parameter that was held and that the data cannot check.

    Parameters
    ----------
    name : str
        As in ``report.json``: owner and kind.
    sigma : str
        Its declared standard deviation, with unit.
    position_m, rotation_deg : float
        What one declared sigma of it does to the pose, root mean square along the log.
    """

    name: str
    sigma: str
    position_m: float
    rotation_deg: float


@dataclass(frozen=True)
class Trust:
    """What is to be said of a result."""

    findings: tuple[Finding, ...] = ()
    unverified: tuple[Unverified, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Of the whole result."""
        return worst(finding.verdict for finding in self.findings)

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """The findings that cast doubt, the most important first."""
        return tuple(f for f in self.ordered if f.verdict is not Verdict.TRUSTWORTHY)

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """What is said without doubt: the estimators cope with it."""
        return tuple(f for f in self.ordered if f.verdict is Verdict.TRUSTWORTHY)

    @property
    def ordered(self) -> tuple[Finding, ...]:
        """The findings, the most important first; what is only a symptom waits for a cause."""
        return tuple(sorted(self.findings, key=_importance))

    def __repr__(self) -> str:
        names = "reasons", "remarks", "unverified"
        counts = [f"{name}: {len(getattr(self, name))}" for name in names]
        return one_line("Trust", [str(self.verdict), *counts])

    def __or__(self, other: "Trust") -> "Trust":
        return Trust(self.findings + other.findings, self.unverified + other.unverified)


@dataclass(frozen=True, eq=False)
class StateTrust:
    """What is to be said of each state of a trajectory.

    Parameters
    ----------
    verdict : tuple of Verdict
    protection_level_m, protection_level_deg : ndarray, shape (n,)
        NaN where there is none.
    excluded : tuple of tuple of str
        Beacons that were left out of each state.
    """

    verdict: tuple[Verdict, ...]
    protection_level_m: Array
    protection_level_deg: Array
    excluded: tuple[tuple[str, ...], ...] = field(default=())

    def rows(self, chosen: IntArray) -> "StateTrust":
        """Return some states, or states repeated."""
        return StateTrust(
            tuple(self.verdict[i] for i in chosen.tolist()),
            self.protection_level_m[chosen],
            self.protection_level_deg[chosen],
            tuple(self.excluded[i] for i in chosen.tolist()),
        )

    def within(self, whole: Verdict, widened: Array) -> "StateTrust":
        """Return the states of a result with a verdict on the whole, whose covariance was widened.

        Parameters
        ----------
        widened : ndarray, shape (n, 2)
            Deviations of attitude and position, in units of those before.
        """
        factor = np.full(widened.shape, np.nan) if whole is Verdict.FAILED else widened
        return StateTrust(
            tuple(worst((whole, own)) for own in self.verdict),
            self.protection_level_m * factor[:, 1],
            self.protection_level_deg * factor[:, 0],
            self.excluded,
        )


def alike(count: int, verdict: Verdict) -> StateTrust:
    """Return the same verdict for every state, without protection levels."""
    nothing = np.full(count, np.nan)
    return StateTrust((verdict,) * count, nothing, nothing, ((),) * count)


@dataclass(frozen=True)
class Risk:
    """What may happen, and how often.

    Parameters
    ----------
    total : float
        Probability, an epoch, that position or attitude is beyond its level without an alarm.
    fault : float
        Prior probability that a beacon is false, a beacon and epoch.
    false_alarm : float
        Probability of an alarm in an epoch without a fault.
    mirrors : float
        Share of the total that goes to rival poses.
    """

    total: float = 1e-4
    fault: float = 1e-3
    false_alarm: float = 5e-4
    mirrors: float = 0.1
