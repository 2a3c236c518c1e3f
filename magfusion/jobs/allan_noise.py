"""Noise of the instruments of a log at rest, and findings that invalidate it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.calibration.allan import AllanVariance
from magfusion.calibration.allan_fit import MISFIT, AllanFit, fit_allan
from magfusion.calibration.rest import QUANTISED, RestStream
from magfusion.errors import InputError
from magfusion.estimation.data_checks.pauses import repeated_samples
from magfusion.estimation.data_checks.samples import clipped_samples, false_samples, frozen_samples
from magfusion.estimation.data_checks.stamps import uneven_stamps
from magfusion.files.plausible import check_field, check_imu
from magfusion.files.table_stream import STREAMS, SampleBlock, pieces
from magfusion.jobs.inputs import Job
from magfusion.model.progress import Report
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import MotionModel, Site
from magfusion.model.trust import Finding, Trust, Unverified, Verdict
from magfusion.units import DEGREE, STANDARD_GRAVITY, Array

STREAM_TESTS = (uneven_stamps, frozen_samples, repeated_samples, clipped_samples, false_samples)
# Stamps contain little noise if evenly sampled; missing samples are tracked.
TOLERATED_CODES = frozenset({"jitter", "samples_lost", "repeated_stamps", "missing_samples"})
MAX_LOST = 0.05  # share of the samples, from which it matters after all
MOVED = 0.2  # share of the time, from which it was no rest
GRAVITY_UNSURE = 0.03  # m/s^2, of the standard one, without a site
DENSITY = np.sqrt(2.0)  # one-sided density over what an Allan deviation shows
HALF = 0.5
# Signature of steps larger than the noise.
OF_STEPS = frozenset({"false_samples", "imu_spikes", "repeated_samples", "frozen_imu"})
OF_CONSTANTS = frozenset({"stuck_axis", "frozen_imu", "frozen_magnetometer"})
MIN_SAMPLES = 200
AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Instrument:
    """Three axes of one instrument.

    `key`: prefix of the keys of a site: ``gyro``, ``accel``, ``magnetometer``.
    """

    key: str
    name: str
    unit: str
    variance: AllanVariance
    fits: tuple[AllanFit | None, ...]
    mean: Array
    repeated: Array

    @property
    def coarse(self) -> bool:
        """Whether quantization masks its noise."""
        return bool(np.max(self.repeated) > QUANTISED)

    @property
    def constant(self) -> str:
        """The axes without any noise."""
        still = ~np.any(self.variance.variance > 0.0, axis=0)
        return ", ".join(axis for axis, one in zip(AXES, still, strict=True) if one)

    @property
    def known(self) -> list[AllanFit]:
        """The available fits of the axes."""
        return [fit for fit in self.fits if fit is not None]


@dataclass(frozen=True, eq=False)
class MeasuredNoise:
    """Estimated noise.

    `keys`: of a site: the worst axis. `intervals`: 95 % interval, of that axis.
    """

    trust: Trust
    duration: float
    samples: dict[str, int]
    instruments: tuple[Instrument, ...]
    keys: dict[str, float] = field(default_factory=dict)
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)

    def plotted(self) -> list[tuple[str, str, AllanVariance, tuple[AllanFit | None, ...]]]:
        """Return title, unit, variance and fits of each instrument."""
        return [(one.name, one.unit, one.variance, one.fits) for one in self.instruments]


@dataclass
class _StreamFindings:
    """Findings of the blocks of a stream, the worst of each kind."""

    pieces: int = 0
    worst: dict[tuple[str, str], tuple[int, Finding]] = field(default_factory=dict)

    def add(self, findings: Iterable[Finding]) -> None:
        self.pieces += 1
        for finding in findings:
            key = finding.code, finding.text.partition(":")[0]
            count, before = self.worst.get(key, (0, finding))
            worse = finding if finding.weight > before.weight else before
            self.worst[key] = count + 1, worse

    def findings(self, missing_share: float) -> Iterator[Finding]:
        for count, finding in self.worst.values():
            verdict = finding.verdict
            if verdict is Verdict.FAILED and count <= HALF * self.pieces:
                verdict = Verdict.DOUBTFUL
            if finding.code in TOLERATED_CODES and missing_share < MAX_LOST:
                verdict = Verdict.TRUSTWORTHY
            where = ""
            if self.pieces > 1:
                where = f" In {count} of {self.pieces} parts of the log; this is the worst."
            yield replace(finding, text=finding.text + where, verdict=verdict)


def measured(job: Job, site: Site | None, report: Report) -> MeasuredNoise:
    """Estimate the noise of a log at rest."""
    motion = MotionModel() if site is None else site.platform.motion
    findings: list[Finding] = []
    instruments: list[Instrument] = []
    samples: dict[str, int] = {}
    duration = 0.0
    for k, (stream, parts) in enumerate(_STREAMS.items()):
        report(f"reading {stream}", k, len(_STREAMS) + 1)
        rest, messages = _gathered(job, stream, 3 * len(parts))
        if not messages.pieces or not len(rest):
            continue
        samples[stream] = len(rest)
        duration = max(duration, rest.duration)
        own = list(messages.findings(rest.missing_share))
        if stream != "magnetometer":
            own += _moved(rest, _limits(rest, motion, stream))
        result = _instruments(_without_motion(rest, job, stream, motion), parts)
        coarse = tuple(one.name for one in result if one.coarse)
        constant = tuple(one.name for one in result if one.constant)
        findings += [
            f
            for f in own
            if not (f.code in OF_STEPS and f.text.startswith(coarse))
            and not (f.code in OF_CONSTANTS and f.text.startswith(constant))
        ]
        instruments += result
    if not instruments:
        raise InputError(f"{job.log_path}: holds neither inertial nor magnetometer samples")
    if not any(one.known for one in instruments) and any(one.constant for one in instruments):
        axes = "; ".join(f"{one.name} {one.constant}" for one in instruments if one.constant)
        raise InputError(
            f"{job.log_path}: these axes have no noise: {axes}; record instruments, or simulate"
            " noise"
        )
    for one in instruments:
        findings += _deviation_findings(one, duration)
    keys, intervals, units = _keys(instruments, site)
    fixed = tuple(_unverified_bounds(keys)) if "accel_bias_sigma" in keys else ()
    trust = Trust(tuple(findings), fixed)
    return MeasuredNoise(trust, duration, samples, tuple(instruments), keys, intervals, units)


def _gathered(job: Job, stream: str, width: int) -> tuple[RestStream, _StreamFindings]:
    """Return the samples of a stream at rest, and the findings of its blocks.

    Raises InputError where there are too few samples, or they are in another unit.
    """
    rest, findings = RestStream(width), _StreamFindings()
    rows, present = 0, np.zeros(width, dtype=np.int64)
    for piece in _pieces(job, stream):
        if not rows:
            _check_units(stream, piece, str(job.log_path))
        rows, present = rows + len(piece.time), present + np.isfinite(piece.values).sum(axis=0)
        rest.add(piece.time, piece.values)
        findings.add(_of_piece(stream, piece))
    if findings.pieces and len(rest) < MIN_SAMPLES:
        names = [STREAMS[stream].numbers[k] for k in np.flatnonzero(present == 0)]
        if names:
            raise InputError(
                f"{job.log_path}: {', '.join(names)} {'is' if len(names) == 1 else 'are'} NaN in"
                f" all {rows} rows of {stream}; repair the sensor or its recording"
            )
        raise InputError(
            f"{job.log_path}: {stream} has {len(rest)} samples in the selected part; record at rest"
            " for at least some minutes, better for hours"
        )
    return rest, findings


def _check_units(stream: str, piece: SampleBlock, place: str) -> None:
    """Refuse samples in another unit; of a half alone the other one is at rest."""
    known = np.isfinite(piece.values).all(axis=1)
    time, values = piece.time[known], piece.values[known]
    if stream == "magnetometer":
        check_field(np.linalg.norm(values, axis=1), place)
    elif len(time):
        gyro = np.zeros((len(time), 3)) if stream == "accel" else values[:, :3]
        weight = np.tile([0.0, 0.0, STANDARD_GRAVITY], (len(time), 1))
        accel = weight if stream == "gyro" else values[:, -3:]
        check_imu(ImuSamples(time, gyro, accel), place)


def _pieces(job: Job, stream: str) -> Iterator[SampleBlock]:
    return pieces(job.log_path, stream, job.start, job.end, job.topics)


def _limits(rest: RestStream, motion: MotionModel, stream: str) -> Array:
    """Return the allowed deviation of each axis from its median at rest."""
    largest = {"gyro": motion.rest_gyro, "accel": motion.rest_accel, "magnetometer": np.inf}
    limits = np.repeat([largest[key] for key, _, _ in _STREAMS[stream]], 3)
    return limits[: len(rest.mean)]


def _without_motion(rest: RestStream, job: Job, stream: str, motion: MotionModel) -> RestStream:
    """Return a stream without the stretches that were shaken, knocked or frozen."""
    blocks = rest.blocks()
    differing = blocks.outlying() | blocks.exceeding(_limits(rest, motion, stream))
    if not differing.any() or np.mean(differing) > MOVED:
        return rest
    begin, end = blocks.begin[differing], blocks.end[differing]
    quiet = RestStream(len(rest.mean))
    for piece in _pieces(job, stream):
        at = np.searchsorted(begin, piece.time, side="right") - 1
        inside = (at >= 0) & (piece.time < end[np.maximum(at, 0)])
        quiet.add(piece.time, np.where(inside[:, None], np.nan, piece.values))
    return quiet


# Per stream, the instruments of its columns.
_GYRO, _ACCEL = ("gyro", "gyroscope", "rad/s"), ("accel", "accelerometer", "m/s^2")
_STREAMS = {
    "imu": (_GYRO, _ACCEL),
    "gyro": (_GYRO,),
    "accel": (_ACCEL,),
    "magnetometer": (("magnetometer", "magnetometer", "T"),),
}


def _instruments(rest: RestStream, parts: tuple[tuple[str, str, str], ...]) -> list[Instrument]:
    variance = rest.allan_variance()
    out = []
    for k, (key, name, unit) in enumerate(parts):
        axes = slice(3 * k, 3 * k + 3)
        own = replace(variance, variance=variance.variance[:, axes])
        fits = tuple(fit_allan(own, axis) for axis in range(3))
        out.append(Instrument(key, name, unit, own, fits, rest.mean[axes], rest.repeated[axes]))
    return out


def _of_piece(stream: str, piece: SampleBlock) -> list[Finding]:
    there = np.isfinite(piece.values).all(axis=1)
    fresh = np.diff(piece.time, prepend=-np.inf) > 0.0
    time, values = piece.time[there & fresh], piece.values[there & fresh]
    nothing = np.zeros((0, 3))
    imu, wave = ImuSamples(np.zeros(0), nothing, nothing), None
    if stream != "magnetometer":  # of a half alone for both: findings on the other are left out
        imu = ImuSamples(time, values[:, :3], values[:, -3:])
    else:
        wave = Waveform(time, values)
    log = Log("piece", 0, "", imu, wave)
    absent = {"gyro": "accelerometer", "accel": "gyroscope"}.get(stream, "none")
    return [
        finding
        for monitor in STREAM_TESTS
        for finding in monitor(log, None)
        if not finding.text.startswith(absent)
    ]


def _moved(rest: RestStream, limits: Array) -> Iterator[Finding]:
    """Yield the intervals in which an inertial sensor was not at rest."""
    blocks = rest.blocks()
    if len(blocks.begin) == 0:
        return
    away = blocks.exceeding(limits)
    moved = away | blocks.outlying()
    share = float(np.mean(moved))
    if not moved.any():
        return
    edge = np.diff(np.concatenate([[0], moved.astype(np.int8), [0]]))
    first, last = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1) - 1
    longest = np.sort(np.argsort(first - last)[:3])
    places = ", ".join(
        f"{blocks.begin[first[k]]:.0f} to {blocks.end[last[k]]:.0f} s" for k in longest
    )
    more = f" and {len(first) - 3} times more" if len(first) > 3 else ""
    far = float(np.mean(away)) > MOVED
    yield Finding(
        "not_at_rest",
        f"imu: motion or vibration from {places}{more}, {100.0 * share:.2g} % of the"
        f" time{': the log is not at rest' if far else ', which is omitted'}. Record without"
        " motion, or cut it out with --start and --end.",
        Verdict.FAILED if far else Verdict.DOUBTFUL,
        1e3 * share + 10.0,
    )


def _deviation_findings(one: Instrument, duration: float) -> Iterator[Finding]:
    """Yield findings on the Allan deviations of an instrument."""
    if one.constant:
        what = "axes" if "," in one.constant else "axis"
        yield Finding(
            "stuck_axis",
            f"{one.name}: {what} {one.constant} without noise: all samples are equal, as of an"
            " ideal simulator or a dead sensor. Its noise is unknown; record it again with noise.",
            Verdict.DOUBTFUL,
            60.0,
        )
        return
    if len(one.known) < 3:
        yield Finding(
            "few_data",
            f"{one.name}: {duration:.0f} s are too short for its noise; record at rest for at least"
            " some minutes.",
            Verdict.DOUBTFUL,
            50.0,
        )
        return
    worst = max(one.known, key=lambda fit: fit.misfit)
    if worst.misfit > MISFIT:
        tones = ", e.g. of beacons or mains" if one.key == "magnetometer" else ""
        yield Finding(
            "noise_shape",
            f"{one.name}: the Allan deviation of axis {AXES[one.fits.index(worst)]} is"
            f" {worst.worst:.2g} times that of white noise, flicker and random walk at"
            f" {worst.worst_tau:.3g} s, due to vibration, warm-up, or a tone{tones}. See allan.png;"
            " record again without it.",
            Verdict.DOUBTFUL,
            worst.misfit,
        )
    if one.coarse:
        often = float(np.max(one.repeated))
        yield Finding(
            "quantised",
            f"{one.name}: axis {AXES[int(np.argmax(one.repeated))]} repeats its value in"
            f" {100.0 * often:.0f} % of the samples: quantization masks its noise. Choose a"
            " smaller range, or a higher output resolution.",
            Verdict.DOUBTFUL,
            20.0 * often,
        )
    if one.key == "magnetometer":
        return
    open_ = [axis for axis, fit in zip(AXES, one.known, strict=True) if not fit.walk.is_significant]
    if open_:
        high = max(fit.walk.high for fit in one.known if not fit.walk.is_significant)
        yield Finding(
            "few_data",
            f"{one.name}: the log of {_span(duration)} is too short for the bias random walk on"
            f" {'axis' if len(open_) == 1 else 'axes'} {', '.join(open_)}: it is below {high:.2g}"
            f" {one.unit}/sqrt(s) (95 %), and this limit is used. Record at rest for at least ten"
            " times as long.",
            Verdict.DOUBTFUL,
            5.0,
        )


def _span(duration: float) -> str:
    for unit, name in ((3600.0, "h"), (60.0, "min")):
        if duration > 2.0 * unit:
            return f"{duration / unit:.3g} {name}"
    return f"{duration:.3g} s"


def _keys(
    instruments: list[Instrument], site: Site | None
) -> tuple[dict[str, float], dict[str, tuple[float, float]], dict[str, str]]:
    """Return keys of a site with the worst axis, its interval, and units."""
    keys: dict[str, float] = {}
    intervals: dict[str, tuple[float, float]] = {}
    units: dict[str, str] = {}
    for one in instruments:
        if not one.known:
            continue
        strong = max(one.known, key=lambda fit: fit.white.value)
        if one.key == "magnetometer":
            if max(fit.misfit for fit in one.known) < MISFIT:
                key = "noise_density_t_rthz"
                keys[key], units[key] = float(DENSITY * strong.white.value), "T/sqrt(Hz)"
                intervals[key] = DENSITY * strong.white.low, DENSITY * strong.white.high
            continue
        noise, walk, sigma = f"{one.key}_noise", f"{one.key}_bias_walk", f"{one.key}_bias_sigma"
        keys[noise] = strong.white.value if strong.white.is_significant else strong.white.high
        units[noise] = f"{one.unit}/sqrt(Hz)"
        intervals[noise] = strong.white.low, strong.white.high
        keys[walk], units[walk] = max(fit.covering_walk for fit in one.known), f"{one.unit}/sqrt(s)"
        units[sigma] = one.unit
        if one.key == "gyro":
            keys[sigma] = float(np.max(np.abs(one.mean)))
        else:
            unsure = GRAVITY_UNSURE if site is None else 0.0
            gravity = STANDARD_GRAVITY if site is None else site.gravity
            keys[sigma] = float(abs(np.linalg.norm(one.mean) - gravity)) + unsure
    return keys, intervals, units


def _unverified_bounds(keys: dict[str, float]) -> Iterator[Unverified]:
    sigma = keys["accel_bias_sigma"]
    tilt = sigma / STANDARD_GRAVITY / DEGREE
    yield Unverified("imu.accel_bias across gravity", f"{sigma:.3g} m/s^2", 0.0, tilt)
