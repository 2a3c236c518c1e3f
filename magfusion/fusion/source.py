"""Where a smoother's phasors and first fixes come from: a waveform, or a table of phasors."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.fixes.fix import Fixes, Gravity
from magfusion.fixes.likelihood import fix_epochs
from magfusion.fusion.wave import WaveFields, demodulate_about
from magfusion.parameters import Calibration, initial_calibration
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.lockin import (
    WindowOperator,
    demodulate,
    demodulate_with_steady,
    window_operator,
)
from magfusion.receiver.slots import (
    SlotSettings,
    demodulate_slots,
    has_schedule,
    slot_settings_of,
)
from magfusion.receiver.windows import (
    LockinSettings,
    Windows,
    choose_windows,
    default_settings,
)
from magfusion.records.samples import FieldSamples, ImuSamples, Log, SteadyFields
from magfusion.site import Site
from magfusion.strapdown import resting
from magfusion.trajectory import Trajectory
from magfusion.units import Array

REST_EPOCH = 0.5  # s; over which the specific force at rest is averaged


@dataclass(frozen=True, eq=False)
class Source:
    """Where the phasors come from: a waveform that can be demodulated anew, or a table."""

    log: Log
    settings: LockinSettings | None
    windows: Windows | None

    def operator(self, calibration: Calibration, states: Trajectory | None) -> WindowOperator:
        """Return the lock-in's map at the present knowledge of bias and time offset."""
        assert self.log.waveform is not None
        assert self.settings is not None
        assert self.windows is not None
        bias = None if states is None else _bias_at(self.log.imu, calibration.time_offset, states)
        return window_operator(
            self.log.waveform,
            self.log.imu,
            calibration.site,
            self.settings,
            self.windows,
            gyro_bias_body=bias,
            time_offset=calibration.time_offset,
        )

    def first(self, calibration: Calibration) -> FieldSamples:
        """Return the phasors before anything is known of the motion."""
        if self.log.waveform is not None:
            return demodulate(self.operator(calibration, None), self.log.waveform.measured_sensor)
        if self.log.fields is None:
            raise EstimationError(f"log {self.log.name} has neither waveform nor phasors")
        return self.log.fields

    def steady(self, calibration: Calibration) -> SteadyFields:
        """Return the Earth field and the offset before anything is known of the motion.

        Raises
        ------
        InputError
            Where the log holds only phasors.
        """
        if self.log.waveform is not None:
            offset = calibration.site.platform.magnetometer.offset
            operator = self.operator(calibration, None)
            centred = self.log.waveform.measured_sensor - offset
            _, steady = demodulate_with_steady(operator, centred)
            return replace(steady, measured_sensor=steady.measured_sensor + offset)
        if self.log.steady is None:
            raise InputError(
                "the log holds only phasors, which know nothing of the Earth field; give the log"
                " with magnetometer.parquet, or leave --earth out"
            )
        return self.log.steady

    def about(self, calibration: Calibration, states: Trajectory) -> WaveFields:
        """Return the phasors with the motion inside the windows taken off."""
        assert self.log.waveform is not None
        return demodulate_about(
            self.operator(calibration, states),
            self.log.waveform.measured_sensor,
            states,
            self.log.imu,
            calibration,
        )

    @property
    def dropped(self) -> Mapping[str, int]:
        """Reason to number of windows."""
        return {} if self.windows is None else self.windows.dropped


@dataclass(frozen=True, eq=False)
class SlotSource(Source):
    """A waveform of coils driven in turn, each slot a row at its own time."""

    slots: SlotSettings
    opened: FieldSamples
    lost: Mapping[str, int]

    def first(self, calibration: Calibration) -> FieldSamples:  # noqa: ARG002 - as its base
        """Return the phasors before anything is known of the motion."""
        return self.opened

    def steady(self, calibration: Calibration) -> SteadyFields:  # noqa: ARG002 - as its base
        """Refuse: between slots there is no steady field.

        Raises
        ------
        InputError
        """
        raise InputError(
            "of coils in time slots the Earth field is taken off with the silent slots; leave"
            " --earth out"
        )

    def about(self, calibration: Calibration, states: Trajectory) -> WaveFields:
        """Return the phasors as turned by the gyro without its bias."""
        assert self.log.waveform is not None
        fields, _ = demodulate_slots(
            self.log.waveform,
            self.log.imu,
            calibration.site,
            self.slots,
            gyro_bias_body=_bias_at(self.log.imu, calibration.time_offset, states),
            time_offset=calibration.time_offset,
        )
        n = len(fields)
        return WaveFields(
            fields=fields,
            by_time_offset=np.zeros_like(fields.phasor_sensor),
            steady=SteadyFields(fields.time, np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)),
        )

    @property
    def dropped(self) -> Mapping[str, int]:
        """Reason to number of slots."""
        return self.lost


def _bias_at(imu: ImuSamples, time_offset: float, states: Trajectory) -> Array:
    assert states.gyro_bias_body is not None
    time = imu.time + time_offset
    return np.stack([np.interp(time, states.time, b) for b in states.gyro_bias_body.T], axis=1)


def open_source(log: Log, site: Site, settings: LockinSettings | None) -> Source:
    """Return the source of a log's phasors, with its windows laid.

    Raises
    ------
    InputError
        Where no window, or no slot, is usable.
    """
    if log.waveform is None:
        return Source(log, None, None)
    if has_schedule(site):
        slots = slot_settings_of(site, settings)
        opened, lost = demodulate_slots(log.waveform, log.imu, site, slots)
        return SlotSource(log, settings, None, slots, opened, lost)
    chosen = default_settings(site) if settings is None else settings
    return Source(log, chosen, choose_windows(log.waveform, log.imu, site, chosen))


def phasors(
    log: Log, site: Site, settings: LockinSettings | None = None
) -> tuple[FieldSamples, Mapping[str, int]]:
    """Return the phasors of a log, demodulated where it has a waveform, and the windows dropped.

    Raises
    ------
    InputError
        Where no window is usable.
    """
    source = open_source(log, site, settings)
    return source.first(initial_calibration(site, 0.0)), source.dropped


def gravity_at_rest(imu: ImuSamples, site: Site, time: Array) -> Gravity | None:
    """Return the direction of gravity where the platform rests; None if it never does.

    Parameters
    ----------
    imu : ImuSamples
    site : Site
        Its accelerometer bias limits how well the direction is known.
    time : ndarray, shape (n,)
        Epochs (s).
    """
    stamps = imu.time + site.platform.imu.time_offset
    still = resting(stamps, imu.gyro_body, imu.accel_body)
    if not np.any(still):
        return None
    nearest = np.clip(np.searchsorted(stamps, time), 0, len(stamps) - 1)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.accel_body, axis=0)])
    lo = np.searchsorted(stamps, time - REST_EPOCH / 2)
    hi = np.minimum(np.searchsorted(stamps, time + REST_EPOCH / 2) + 1, len(stamps))
    lo = np.minimum(lo, hi - 1)
    mean = (total[hi] - total[lo]) / (hi - lo)[:, None]
    size = np.linalg.norm(mean, axis=1, keepdims=True)
    noise = site.platform.imu.accel_noise / np.sqrt(REST_EPOCH)
    sigma = np.hypot(site.platform.imu.accel_bias_sigma, noise) / site.gravity
    near = np.abs(stamps[nearest] - time) < REST_EPOCH
    return Gravity(mean / size, np.where(still[nearest] & near, sigma, np.inf))


def first_fixes(
    samples: FieldSamples, log: Log, calibration: Calibration, free: tuple[str, ...] = ()
) -> Fixes:
    """Return the fix of every epoch, with gravity where the platform rests.

    Of coils driven in turn a whole cycle is one epoch.
    """
    if has_schedule(calibration.site):
        samples = whole_cycles(samples, log.imu, calibration.site)
    gravity = gravity_at_rest(log.imu, calibration.site, samples.time)
    return fix_epochs(samples, calibration, gravity=gravity, free=free)
