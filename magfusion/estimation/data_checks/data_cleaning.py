"""Data cleaning: even clocks, and no false samples.

What is corrected is reported and casts no doubt: neighbours bridge a dropped sample like a lost
one, and the magnetic fields bridge a frozen IMU like a gap.
"""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.pauses import pause_rows, repeated_samples
from magfusion.estimation.data_checks.samples import (
    false_rows,
    false_samples,
    frozen_rows,
    frozen_samples,
    streams,
)
from magfusion.files.lost_rows import MAX_MISSING
from magfusion.files.plausible import RANGE_KEYS, declared_range, exceeds
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.even_clocks import on_even_clocks
from magfusion.units import IntArray


def clean_log(log: Log, site: Site) -> Log:
    """Return a log with single wrong stamps and samples corrected.

    Its ``clocks`` and ``findings`` report the corrections. Raises InputError where most samples of
    an instrument are beyond its declared range.
    """
    log = _without_freeze(on_even_clocks(_within_range(log, site), site), site)
    log = _without_pauses(log, site)
    result = {stream.name: false_rows(stream, site) for stream in streams(log)}
    if not any(len(rows) for rows in result.values()):
        return log
    findings = [replace(f, verdict=Verdict.TRUSTWORTHY) for f in false_samples(log, site)]
    findings = [replace(f, text=f"{f.text} They are left out.") for f in findings]
    return replace(_without(log, result), findings=(*log.findings, *findings))


def _within_range(log: Log, site: Site) -> Log:
    """Return a log without samples beyond the declared range of their instrument."""
    result: dict[str, IntArray] = {}
    findings: list[Finding] = []
    for stream in streams(log):
        largest = declared_range(stream.name, site.platform)
        rows = np.flatnonzero(exceeds(stream.value, largest))
        if not len(rows):
            continue
        key = f"platform.{RANGE_KEYS[stream.name]}"
        text = f"{stream.name}: {len(rows)} samples are beyond the range of {largest:g} in {key}"
        if len(rows) > MAX_MISSING * len(stream.value):
            raise InputError(f"{text}, of {len(stream.value)}; correct {key}, or the samples' unit")
        result[stream.name] = rows
        text = f"{text}. They are left out."
        findings.append(Finding("missing_samples", text, Verdict.TRUSTWORTHY))
    if not result:
        return log
    return replace(_without(log, result), findings=(*log.findings, *findings))


def _without(log: Log, result: dict[str, IntArray]) -> Log:
    """Return a log without some samples, by the name of their instrument."""
    wave = log.waveform
    inertial = [rows for name, rows in result.items() if name != "magnetometer"]
    if inertial:
        log = _without_inertial(log, np.unique(np.concatenate(inertial)))
    if wave is not None and "magnetometer" in result:
        wave = wave.rows(np.delete(np.arange(len(wave)), result["magnetometer"]))
    return replace(log, waveform=wave)


def _without_inertial(log: Log, rows: IntArray) -> Log:
    """Return a log without some inertial samples."""
    kept = np.delete(np.arange(len(log.imu)), rows)
    imu, recorded = (
        None
        if samples is None
        else ImuSamples(log.imu.time[kept], samples.gyro_body[kept], samples.accel_body[kept])
        for samples in (log.imu, log.recorded_imu)
    )
    assert imu is not None
    return replace(log, imu=imu, recorded_imu=recorded)


def _without_pauses(log: Log, site: Site) -> Log:
    """Return a log without the samples of a magnetometer that repeat the last one in a pause."""
    rows = [pause_rows(s) for s in streams(log) if s.name == "magnetometer"]
    if not any(map(len, rows)):
        return log
    findings = next(f for f in repeated_samples(log, site) if f.text.startswith("magnetometer"))
    findings = replace(findings, text=f"{findings.text} They are left out.")
    return replace(_without(log, {"magnetometer": rows[0]}), findings=(*log.findings, findings))


def _without_freeze(log: Log, site: Site) -> Log:
    """Return a log without the inertial samples of a frozen IMU."""
    hung = [frozen_rows(s) for s in streams(log) if s.name in ("gyroscope", "accelerometer")]
    rows = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *hung]))
    if len(rows) == 0 or len(rows) >= len(log.imu) - 1:
        return log
    findings = [
        replace(
            f,
            text=f"{f.text} Here it is left out; the magnetic fields bridge the gap.",
            verdict=Verdict.TRUSTWORTHY,
        )
        for f in frozen_samples(log, site)
        if f.code == "frozen_imu"
    ]
    return replace(_without_inertial(log, rows), findings=(*log.findings, *findings))
