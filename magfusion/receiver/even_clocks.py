"""Replacement of scattered time stamps by the uniform sampling clock of a stream."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from magfusion.model.samples import Log, StreamClock
from magfusion.model.site import Site
from magfusion.receiver.lockin import unexplained
from magfusion.receiver.sampling_clock import SamplingClock, sampling_clock
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import default_settings


def on_even_clocks(log: Log, site: Site) -> Log:
    """Replace stamps that scatter about a uniform clock by that clock.

    The magnetometer decides between ticks and stamps: at the correct times, tones and rotation
    leave a smaller residual.  The IMU follows that decision.
    """
    bundled = not has_schedule(site)
    result = {"imu": sampling_clock(log.imu.time, bundled)}
    if log.waveform is not None:
        result["magnetometer"] = sampling_clock(log.waveform.time, bundled)
    clocks = {name: clock for name, clock in result.items() if clock is not None}
    if not clocks:
        return log
    even = _at(log, clocks)
    replaced = "magnetometer" not in clocks or _evener(log, even, site)
    notes = {
        name: StreamClock(clock.step, clock.scatter, clock.lost_count, replaced, clock.resolution)
        for name, clock in clocks.items()
    }
    return replace(even if replaced else log, clocks=notes)


def _at(log: Log, clocks: Mapping[str, SamplingClock]) -> Log:
    """Replace the stamps of some streams by their clocks."""
    if "imu" in clocks:
        time, recorded = clocks["imu"].time, log.recorded_imu
        recorded = None if recorded is None else replace(recorded, time=time)
        log = replace(log, imu=replace(log.imu, time=time), recorded_imu=recorded)
    if "magnetometer" in clocks:
        assert log.waveform is not None
        time, wave = clocks["magnetometer"].time, log.waveform
        marks = None if wave.marks is None else wave.marks.on_clock(wave.time, time)
        log = replace(log, waveform=replace(wave, time=time, marks=marks))
    return log


def _evener(log: Log, even: Log, site: Site) -> bool:
    """Return whether the demodulation residual is smaller at the ticks than at the stamps."""
    if has_schedule(site) or not site.beacons:
        return True
    settings = default_settings(site)
    ticks, stamps = (unexplained(one, site, settings) for one in (even, log))
    return bool(np.median(ticks) < np.median(stamps))
