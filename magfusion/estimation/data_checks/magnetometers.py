"""Subsets of several magnetometers in a log, and removal of those that detect no beacon."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.data_checks.detection import DETECTION_CHI_SQUARE_ONLINE, above_noise
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding

MIN_EPOCHS = 10  # epochs, before one is reported as silent


def without_magnetometer(log: Log, site: Site, which: int) -> tuple[Log, Site]:
    """Return a log and its site without one of several magnetometers."""
    kept = [k for k in range(len(site.platform.magnetometers)) if k != which]
    return _only(log, site, kept)


def first_magnetometer(log: Log, site: Site) -> tuple[Log, Site]:
    """Return what the first of several magnetometers recorded, and its site."""
    return _only(log, site, [0]) if site.platform.further else (log, site)


def _only(log: Log, site: Site, kept: list[int]) -> tuple[Log, Site]:
    every = tuple(enumerate(site.platform.magnetometers))
    sensors = tuple(sensor for k, sensor in every if k in kept)
    elapsed = tuple((k, sensor) for k, sensor in reversed(every) if k not in kept)
    platform = site.platform.with_magnetometers(sensors)
    residual = replace(site, platform=replace(platform, left_out=(*platform.left_out, *elapsed)))
    fields = None if log.fields is None else of_sensors(log.fields, site, kept)
    waves = {s.name: log.waveforms[s.name] for s in sensors if s.name in log.waveforms}
    if waves and len(kept) == 1:  # on the log's clock, as a log of a single magnetometer
        wave = waves[sensors[0].name]
        log = replace(log, fields=None, waveform=wave, waveforms={})
        return replace(log, clock_rate=0.0, clock_offset=0.0), residual
    return replace(log, fields=fields, waveforms=waves), residual


def of_sensors(fields: FieldSamples, site: Site, kept: list[int]) -> FieldSamples:
    """Return the phasors of a subset of magnetometers, at the epochs that contain any of them."""
    columns = np.concatenate([np.arange(len(site.channels))[site.of_sensor(k)] for k in kept])
    named = tuple(fields.magnetometers[c] for c in columns.tolist())
    alone = replace(
        fields,
        channels=tuple(fields.channels[c] for c in columns.tolist()),
        phasor_sensor=fields.phasor_sensor[:, columns],
        phasor_cov=fields.phasor_cov[:, columns],
        ahead=None if fields.ahead is None else fields.ahead[:, columns],
        magnetometers=named if len(kept) > 1 else (),
    )
    return alone.rows(np.any(alone.valid, axis=1))


def without_silent(log: Log, site: Site) -> tuple[Log, Site]:
    """Return a log without magnetometers that detect nothing where another does, and its site.

    The log's ``findings`` lists them.
    """
    if not site.platform.further or log.fields is None:
        return log, site
    sensors = site.platform.magnetometers
    there = _silent_epochs(log.fields, site)
    silent = [k for k, n in there.items() if n == 0 or n >= MIN_EPOCHS]
    if not silent or len(silent) == len(sensors):
        return log, site
    findings = [
        Finding(
            "magnetometer_silent",
            f"Magnetometer {sensors[k].name} detects no beacon in {there[k]} epochs in which others"
            " do, and is not used. Check its supply, its cable and its channel.",
        )
        for k in silent
    ]
    kept = [k for k in range(len(sensors)) if k not in silent]
    log, site = _only(log, site, kept)
    return replace(log, findings=(*log.findings, *findings)), site


def _silent_epochs(fields: FieldSamples, site: Site) -> dict[int, int]:
    """Return the magnetometers that detect nothing, with the number of epochs of each."""
    detected = above_noise(fields, DETECTION_CHI_SQUARE_ONLINE)
    mine = {k: site.of_sensor(k) for k in range(len(site.platform.magnetometers))}
    return {
        k: int(np.sum(np.any(fields.valid[:, own], axis=1)))
        for k, own in mine.items()
        if not np.any(detected[:, own])
    }
