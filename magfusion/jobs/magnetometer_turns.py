"""Guided rotation of a magnetometer: samples from a pipe until its calibration is certain."""

from collections.abc import Callable, Iterable
from typing import NamedTuple, TextIO

import numpy as np

from magfusion.calibration.magnetometer import field_from_measured
from magfusion.calibration.magnetometer_log import LogCalibration
from magfusion.calibration.turn_coverage import TurnCoverage, TurnStatus
from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.files.records import Record
from magfusion.files.stream import NumberedRecord
from magfusion.jobs.inputs import named
from magfusion.jobs.stream_clocks import StreamClocks
from magfusion.jobs.stream_samples import StreamSamples
from magfusion.model.platform_motion import NO_IMU
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Trust, Verdict
from magfusion.model.without_imu import logged
from magfusion.units import Array

Calibrate = Callable[[Log, Site], tuple[LogCalibration, Trust]]
SOURCE = "standard input"
SHOWN = 0.25  # s; over which directions are averaged and between two displays
FIRST_FIT = 4.0  # s; the estimator needs twenty readings of .2 s
# Of the elapsed time between two estimates: one of 90 s of samples takes 1 to 2 s.
FIT_INTERVAL = 0.125


class GuidedCalibration(NamedTuple):
    """Result of a guided rotation: the samples as a log, its site, and the calibration."""

    log: Log
    site: Site
    calibration: LogCalibration
    trust: Trust


class _Samples:
    """Samples of a pipe as they come, of the IMU and the magnetometer."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self.streams = StreamSamples(site)
        self._clocks = StreamClocks(0.0)
        self._rows: dict[str, list[Array]] = {"imu": [], "magnetometer": []}

    def add(self, record: Record) -> dict[str, Array]:
        """Keep the samples of a record; return those of each stream, stamps in the first column."""
        record = self._clocks.unwrapped(record)
        step = self._clocks.step_in(record)
        if step is not None:
            raise InputError(
                f"{step.stream}: its clock stepped by {step.seconds:+.4g} s; start again"
            )
        self._clocks.check(record)
        if record.fields is not None:
            raise InputError("phasors do not contain the Earth's field; send magnetometer samples")
        parts: dict[str, tuple[Array, ...]] = {}
        if record.imu is not None:
            if self.site.platform.imu == NO_IMU:
                raise InputError("imu: the site has no platform.imu; describe it, or omit imu")
            parts["imu"] = (record.imu.time, record.imu.gyro, record.imu.accel)
        if record.magnetometer is not None:
            parts["magnetometer"] = (record.magnetometer.time, record.magnetometer.field)
        result = {}
        for stream, (time, *values) in parts.items():
            time, rows = self.streams.whole(stream, time, *values)
            result[stream] = np.column_stack([time, rows])
            self._keep(stream, *self.streams.tested(stream, time, rows))
        return result

    def _keep(self, stream: str, time: Array, rows: Array) -> None:
        self._rows[stream].append(np.column_stack([time, rows]))

    @property
    def without_imu(self) -> bool:
        """Whether the magnetometer alone has sent, for as long as a first estimate takes."""
        if self._rows["imu"]:
            return False
        stamps = self._table("magnetometer", 4)[:, 0]
        return bool(len(stamps) and np.ptp(stamps) > FIRST_FIT)

    def end(self) -> None:
        """Keep the samples that wait for others."""
        for stream, _, time, rows in self.streams.end():
            self._keep(stream, time, rows)

    def log(self) -> tuple[Log, Site]:
        """Return what has come as a log, corrected and cleaned as that of a file, and its site."""
        imu = self._table("imu", 7)
        field = self._table("magnetometer", 4)
        samples = ImuSamples(imu[:, 0], imu[:, 1:4], imu[:, 4:])
        wave = Waveform(field[:, 0], field[:, 1:])
        log, site = logged(Log(SOURCE, 0, "pipe", samples, wave), self.site)
        return clean_log(log, site), site

    def _table(self, stream: str, width: int) -> Array:
        rows = np.vstack([np.empty((0, width)), *self._rows[stream]])
        return rows[np.unique(rows[:, 0], return_index=True)[1]]


class _Turning:
    """A rotation while it is guided."""

    def __init__(self, site: Site, calibrate: Calibrate, limit: float) -> None:
        self.samples, self._calibrate, self._limit = _Samples(site), calibrate, limit
        self._sensor = site.platform.magnetometer
        self.coverage = TurnCoverage(site.platform.imu != NO_IMU)
        self._waiting: list[Array] = []
        self._first, self._shown, self._fitted = np.nan, -np.inf, 0.0
        self.result: GuidedCalibration | None = None
        self._set(0.0)

    def add(self, record: Record) -> bool:
        """Add a record; return whether the status is a new one."""
        parts = self.samples.add(record)
        if self.coverage.vertical and np.isnan(self._first) and self.samples.without_imu:
            self.coverage = TurnCoverage(vertical=False)
        own = parts.get("imu" if self.coverage.vertical else "magnetometer")
        if own is None or not len(own):
            return False
        if np.isnan(self._first):
            self._first = float(own[0, 0])
        self._waiting.append(self._directions(own[:, 1:]))
        time = float(own[-1, 0]) - self._first
        if time < self._shown + SHOWN:
            return False
        self._shown = time
        mean = np.mean(np.vstack(self._waiting), axis=0, keepdims=True)
        self._waiting.clear()
        if np.all(np.isfinite(mean)) and np.any(mean):
            self.coverage.add(mean)
        old = self.status
        self._set(time, old.offset_sigma, old.matrix_sigma, old.reason)
        just_complete = self.status.complete and not old.complete
        if just_complete or time > self._fitted + max(FIRST_FIT, FIT_INTERVAL * time):
            self.fit(time)
        return True

    def _directions(self, rows: Array) -> Array:
        """Return the vertical, or the field as calibrated so far, in sensor axes."""
        if self.coverage.vertical:
            return np.asarray(rows[:, 3:] @ self._sensor.body_from_sensor)
        return field_from_measured(rows, self._sensor.matrix, self._sensor.offset)

    def fit(self, time: float) -> None:
        """Estimate from all samples so far, as from a log."""
        self._fitted, self.result = time, None
        try:
            log, site = self.samples.log()
            calibration, trust = self._calibrate(log, site)
        except (InputError, EstimationError) as error:
            self._set(time, reason=str(error))
            return
        self.result = GuidedCalibration(log, site, calibration, trust)
        sensor = calibration.magnetometer
        if not self.coverage.vertical:  # with the offset, the directions are others
            self._sensor = sensor
            self.coverage = TurnCoverage(vertical=False)
            self.coverage.add(self._directions(calibration.readings.measured_sensor))
        self._set(
            time,
            float(np.max(sensor.sigma.offset)),
            float(np.linalg.norm(calibration.prior.field_world) * np.max(sensor.sigma.matrix)),
            trust.ordered[0].text if trust.verdict is Verdict.FAILED else "",
        )

    def _set(
        self,
        time: float,
        offset_sigma: float | None = None,
        matrix_sigma: float | None = None,
        reason: str = "",
    ) -> None:
        own = self.coverage
        self.status = TurnStatus(
            *(time, own.now, own.visited.copy(), own.missing, own.target),
            *(offset_sigma, matrix_sigma, reason),
        )

    @property
    def certain(self) -> bool:
        """Whether the estimate is as certain as is required, from all orientations."""
        status = self.status
        return (
            self.result is not None
            and not status.reason
            and status.complete
            and status.offset_sigma is not None
            and status.offset_sigma <= self._limit
        )


def guide(
    site: Site,
    records: Iterable[NumberedRecord],
    calibrate: Calibrate,
    limit: float,
    show: Callable[[TurnStatus], None],
    messages: TextIO,
) -> GuidedCalibration:
    """Read records until the calibration is certain, and show which orientations are missing.

    Raises InputError for an invalid record. Raises EstimationError where the stream ends before;
    with what is missing.

    Parameters
    ----------
    calibrate : callable
        The estimator of a log.
    limit : float
        Offset sigma at which the calibration is certain (T).
    show : callable
        Receives the status every quarter of a second of the stream.
    messages : file
        Receives messages on samples that are left out.
    """
    turning = _Turning(site, calibrate, limit)
    for numbered in records:
        try:
            if numbered.record is None:
                raise InputError(numbered.refusal)
            changed = turning.add(numbered.record)
        except InputError as error:
            raise InputError(numbered.located(error)) from error
        if changed:
            show(turning.status)
            if turning.certain:
                break
    else:
        with named(SOURCE):
            turning.samples.end()
            turning.fit(turning.status.time)
        show(turning.status)
    turning.samples.streams.report(messages)
    if turning.result is None or not turning.certain:
        raise EstimationError(_too_early(turning.status, limit))
    return turning.result


def _too_early(status: TurnStatus, limit: float) -> str:
    reasons = list(status.missing)
    if status.offset_sigma is not None and status.offset_sigma > limit:
        reasons.append(
            f"the offset sigma is {1e6 * status.offset_sigma:.2g} uT ({1e6 * limit:.2g} required)"
        )
    if status.offset_sigma is None or not reasons:
        reasons.append(status.reason.rstrip("."))
    return (
        f"{SOURCE}: ended after {status.time:.0f} s, before the calibration is certain: "
        + "; ".join(reason for reason in dict.fromkeys(reasons) if reason)
        + "; rotate the sensor further, by the guidance"
    )
