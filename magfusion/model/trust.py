"""Trust in a result: findings, the verdict they imply, and unverified parameters.

`trustworthy` means that the covariance is correct; `doubtful` that it has been inflated to be so,
with the reason; `failed` that there is no result.  No ground truth is used.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from magfusion.model.short_repr import one_line
from magfusion.units import Array, IntArray

LISTED = 3  # items of a kind in a sentence; more are counted, or left out
CORRECTED = "The result is corrected for it."  # the end of a finding

# Meaning of findings by code: the documentation of ``reasons`` in report.json.
CODES = {
    "accel_scale": "the mean specific force is not gravity's, by a scale or a bias",
    "accel_units": "the specific force is in another unit",
    "aiding_clock": "the clock of an aiding sensor is not as declared",
    "aiding_disagrees": "an aiding sensor contradicts the estimate, and is not used",
    "aiding_lever_arm": "the lever arm of an aiding sensor is not as declared",
    "aiding_mounting": "an aiding sensor is not mounted as declared",
    "aiding_noise": "an aiding sensor scatters by more than declared",
    "aiding_offset": "the offset of an aiding sensor is not as declared",
    "aiding_point": "the known point of a range sensor is not as declared",
    "aiding_scale": "the scale of an aiding sensor is not as declared",
    "aiding_silent": "an aiding sensor has no samples in the log or a part of it",
    "aiding_units": "an aiding sensor is in another unit, or of the opposite sign",
    "ambiguous": "another pose, or position of a beacon, explains the measurements nearly as well",
    "angle_convention": "the attitudes of beacons follow another convention",
    "angle_units": "the attitudes of beacons are in another unit",
    "assumed": "an undeclared property was assumed",
    "attitude_refused": "the attitude of a paper's algorithm cannot be valid, and is omitted",
    "bag_damaged": "messages of a bag that its index counts cannot be read",
    "bag_unfinished": "the recorder did not finish a bag, of which the whole part was read",
    "beacon_clock": "a beacon's clock is not as declared",
    "beacon_excluded": "a beacon is inconsistent with the others and was excluded meanwhile",
    "beacon_fault": "the field of a beacon is faulty, temporarily or throughout",
    "beacon_pose": "a beacon is not at its surveyed position or attitude",
    "beacons_swapped": "beacons are interchanged",
    "beacons_unheard": "a log receives some of many beacons; the others remain as declared",
    "body_iron": "iron or a magnet on the body changes the field",
    "changed": "a gain, clock, mounting or beacon changes during the log",
    "coil_reversed": "a coil of a beacon is reversed, or interchanged with another",
    "coils_swapped": "the coils of every beacon are interchanged",
    "demodulated_apart": "several magnetometers were demodulated separately",
    "diverged": "the estimator neither converged nor explains the measurements",
    "drive_current": "the recorded current of a coil is noisy or not as declared",
    "earth_field": "the static field is not the Earth's as declared",
    "epoch_shift": "the stamps are shifted against the epoch of the drive phases",
    "false_samples": "single samples of the magnetometer are outliers",
    "few_data": "the measurements are too few for a part of the request",
    "field_innovations": "fields of a beacon deviate from their prediction beyond their covariance",
    "field_residuals": "fields of a beacon deviate from the model by more than declared",
    "field_scale": "all fields differ from the declared ones by one factor",
    "field_units": "the field is in another unit",
    "fitted_line": "an undeclared line is transmitted, and fitted with the tones",
    "fix_disagrees": "a fix of a single epoch gives another position",
    "found_again": "tracking was lost, and recovered by a fix",
    "frozen_imu": "gyroscope or accelerometer is frozen for a while",
    "frozen_magnetometer": "the magnetometer is frozen for a while",
    "gain_spread": "the fields differ from the site's by a factor that varies with position",
    "gap": "a stream has no samples for a while",
    "geometry": "the beacons do not determine a direction of the pose",
    "gravity": "the gravity measured by the accelerometer differs from the declared value",
    "gravity_direction": "the mean specific force contradicts gravity at the estimated attitude",
    "gravity_missing": "gravity has been removed from the specific force",
    "gravity_sign": "the vertical of the accelerometer has the wrong sign",
    "ground": "the conductivity of ground or water is not as declared",
    "gyro_field": "the rotation of the static field is inconsistent with the gyroscope",
    "gyro_g_sensitivity": "the gyroscope reacts to specific force",
    "gyro_scale": "the scale of the gyroscope is wrong",
    "gyro_sign": "the sign of the gyroscope, or of one axis, is reversed",
    "gyro_units": "the rates are in another unit",
    "imu_axes": "axes of the inertial sensor are interchanged",
    "imu_bias": "a bias of the inertial sensor is larger than declared",
    "imu_clock": "the IMU's clock runs at another rate than the magnetometer's",
    "imu_noise": "the inertial samples scatter by more than declared",
    "imu_spikes": "single samples of the inertial sensor are outliers",
    "inertial_residuals": "the IMU data are inconsistent with the magnetic-field solution",
    "iron": "the fields deviate from the beacons' model, depending on position",
    "jitter": "stamps are uneven",
    "length_units": "the positions of beacons are in another unit",
    "lever_arm": "the lever arm of the magnetometer is not as declared",
    "log_left_out": "one of several logs failed alone and is not used for the refinement",
    "logs_disagree": "a log is inconsistent with the others about the shared site",
    "long_windows": "tones are separated in long windows where short ones could not be used",
    "lost": "no solution near the estimated position explains the fields",
    "low_pass": "the magnetometer has a low-pass filter that is not declared",
    "low_signal": "beacons are below the noise",
    "magnetometer_axes": "the magnetometer's axes are left-handed",
    "magnetometer_clock": "the clock of one of several magnetometers is not as declared",
    "magnetometer_excluded": "one of several magnetometers is inconsistent with the others",
    "magnetometer_matrix": "the magnetometer's matrix, with nearby iron, is not as declared",
    "magnetometer_offset": "the magnetometer's offset is not as declared",
    "magnetometer_response": "the response of the magnetometer's axes is not as declared",
    "magnetometer_silent": "one of several magnetometers receives no beacon",
    "magnetometers_contradict": "magnetometers are inconsistent, and none can be identified",
    "mains": "mains in the field",
    "metal_near": "metal or iron came near a single beacon or the sensor, and changes its field",
    "missing_samples": "samples are NaN, or larger than any instrument measures",
    "moment_units": "the moments of all beacons are off by the factor of a unit or a convention",
    "moments": "the moments of beacons are not as declared",
    "mounting": "magnetometer and inertial sensor are not mounted as declared",
    "no_covariance": "the algorithm of a paper gives no covariance of its result",
    "no_redundancy": "without some beacon the pose is not determined: no protection level",
    "no_solution": "the estimator found no trajectory that explains the log",
    "no_start": "no initial state could be estimated",
    "no_window": "no part of the waveform can be demodulated",
    "noise_shape": "the noise is not the declared white noise with bias random walk",
    "noise_tuned": "noise or model error differ from the declared values",
    "not_at_rest": "a platform or sensor that should be at rest moved",
    "not_converged": "the last iteration still changed the result by more than its sigmas allow",
    "not_proven": "the measurements are too few to prove a beacon's place",
    "other_site": "the fields contradict the site's file as a whole",
    "outside_region": "a pose is outside of the declared region or hemisphere",
    "phase": "the drive phase of a beacon is not as declared",
    "phase_sign": "the drive phases of all beacons have the wrong sign",
    "phase_units": "the drive phases are in another unit",
    "prior": "a calibration changed by more than the site's sigmas allow",
    "quantised": "the steps of an instrument are larger than its noise",
    "range_switched": "the range or gain of the magnetometer changes during the log",
    "reference_hears": "the reference sensor receives a beacon, or may",
    "reference_unused": "the reference sensor does not reduce the noise, or is not used",
    "region_edge": "a pose is too near the edge of its region to exclude its mirror image",
    "repeated_samples": "an instrument repeats samples: it is read too fast, or pauses",
    "repeated_stamps": "samples have duplicate stamps",
    "restarts": "fields and inertial data diverge repeatedly",
    "roll_open": "a receiver of one axis does not determine the roll about it",
    "sample_rate": "the clock of a stream runs at another rate than declared",
    "samples_lost": "samples are missing, one or a few at a time",
    "saturated": "samples are at a limit of the instrument's range",
    "separation": "excluding a beacon moves the pose by more than noise and survey explain",
    "settlement": "a beacon moves steadily against the others, seen from a platform at rest",
    "sign_open": "amplitudes near zero, whose sign is not determined, were left out",
    "silent_beacon": "a beacon is not detected, at all or for a while",
    "site_changed": "a beacon was moved or exchanged between logs, or a platform changed",
    "stamp_resolution": "the stamps of a stream are coarser than nanoseconds",
    "steel": "steel near the path distorts the fields of all beacons",
    "steel_moved": "the map of steel in the site is not that of the log",
    "stray_stamps": "samples have stamps far from all others",
    "streams_apart": "inertial sensor and magnetometer were not recorded at the same time",
    "stuck_axis": "an axis is constant",
    "survey_axes": "the survey's axes are not those declared",
    "survey_overconfident": "the survey of the beacons is worse than its sigmas",
    "survey_scale": "all distances of the survey are off by one factor",
    "survey_tilt": "the vertical of the survey differs from gravity",
    "temperature_missing": "a declared temperature dependence has no recorded temperature",
    "time_offset": "the IMU's time offset is not as declared",
    "transfer": "a calibration is not valid outside its own data",
    "truth_inconsistent": "a truth contradicts the gyroscope or gravity",
    "undeclared_line": "a line that the site does not declare is transmitted",
    "unstable": "an estimator drifts over hours, or its errors do not match its covariance",
    "update_failed": "an update of the estimator failed; the state is a prediction",
}


class Verdict(StrEnum):
    """Verdict of a result or a state, from best to worst."""

    TRUSTWORTHY = "trustworthy"
    DOUBTFUL = "doubtful"
    FAILED = "failed"

    @property
    def rank(self) -> int:
        """Severity, from zero."""
        return list(Verdict).index(self)


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the worst of some verdicts; trustworthy if there is none."""
    return max(verdicts, key=lambda verdict: verdict.rank, default=Verdict.TRUSTWORTHY)


@dataclass(frozen=True)
class Finding:
    """One reason not to trust a result.

    Parameters
    ----------
    code : str
        Of `CODES`.
    text : str
        A sentence or two: what, where, how much, the probable cause, the remedy.
    verdict : Verdict
        Least severe verdict that it implies; trustworthy for a mere remark.
    weight : float
        Test statistic in units of its limit; the largest comes first.
    remedy : mapping, optional
        Keys of the site's file, with the values that undo the mistake.
    explained : tuple of str
        Codes of the findings that it explains.
    """

    code: str
    text: str
    verdict: Verdict = Verdict.DOUBTFUL
    weight: float = 1.0
    remedy: Mapping[str, object] | None = field(default=None, compare=False)
    explained: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "weight", float(self.weight))
        if self.code not in CODES:
            raise ValueError(f"{self.code} is not among the documented codes of findings")


# Symptoms of another fault, which is listed before them if it is identified.
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
    """A fixed parameter that is not observable in these data."""

    name: str  # as in ``report.json``: owner and kind
    sigma: str  # its declared standard deviation, with unit
    # position_m, rotation_deg: effect of one declared sigma on the pose, root mean square along the
    # log
    position_m: float
    rotation_deg: float


@dataclass(frozen=True)
class Trust:
    """Findings and unverified parameters of a result."""

    findings: tuple[Finding, ...] = ()
    unverified: tuple[Unverified, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Verdict of the whole result."""
        return worst(finding.verdict for finding in self.findings)

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """Findings that cast doubt, the most important first."""
        return tuple(f for f in self.ordered if f.verdict is not Verdict.TRUSTWORTHY)

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings without doubt, which the estimators handle."""
        return tuple(f for f in self.ordered if f.verdict is Verdict.TRUSTWORTHY)

    @property
    def ordered(self) -> tuple[Finding, ...]:
        """Findings, the most important first; symptoms follow causes."""
        return tuple(sorted(self.findings, key=_importance))

    def __repr__(self) -> str:
        names = "reasons", "remarks", "unverified"
        counts = [f"{name}: {len(getattr(self, name))}" for name in names]
        return one_line("Trust", [str(self.verdict), *counts])

    def __or__(self, other: "Trust") -> "Trust":
        return Trust(self.findings + other.findings, self.unverified + other.unverified)


@dataclass(frozen=True, eq=False)
class StateTrust:
    """Trust in each state of a trajectory."""

    verdict: tuple[Verdict, ...]
    # protection_level_m, protection_level_deg: (n,), NaN where there is none
    protection_level_m: Array
    protection_level_deg: Array
    excluded: tuple[tuple[str, ...], ...] = field(default=())  # beacons excluded from each state

    def rows(self, chosen: IntArray) -> "StateTrust":
        """Return a subset of the states, possibly repeated."""
        return StateTrust(
            tuple(self.verdict[i] for i in chosen.tolist()),
            self.protection_level_m[chosen],
            self.protection_level_deg[chosen],
            tuple(self.excluded[i] for i in chosen.tolist()),
        )

    def within(self, whole: Verdict, widened: Array) -> "StateTrust":
        """Combine states with the verdict on the whole result, whose covariance was inflated.

        `widened` (n, 2): deviations of attitude and position, relative to those before.
        """
        factor = np.full(widened.shape, np.nan) if whole is Verdict.FAILED else widened
        return StateTrust(
            tuple(worst((whole, own)) for own in self.verdict),
            self.protection_level_m * factor[:, 1],
            self.protection_level_deg * factor[:, 0],
            self.excluded,
        )


def uniform_trust(count: int, verdict: Verdict) -> StateTrust:
    """Return the same verdict for every state, without protection levels."""
    nothing = np.full(count, np.nan)
    return StateTrust((verdict,) * count, nothing, nothing, ((),) * count)


@dataclass(frozen=True)
class Risk:
    """Integrity and continuity risk."""

    # probability per epoch that position or attitude exceeds its level without an alarm
    total: float = 1e-4
    fault: float = 1e-3  # prior probability of a faulty beacon, per beacon and epoch
    false_alarm: float = 5e-4  # probability of an alarm in an epoch without a fault
    mirrors: float = 0.1  # share of the total allocated to alternative poses
