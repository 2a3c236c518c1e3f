"""Phasors and first fixes of a log that has a waveform, or a table of phasors."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.detection import masked_phasors, without_silence
from magfusion.estimation.data_checks.disturbing_lines import with_disturbing_lines
from magfusion.estimation.demodulation.burial_depth import refuse_too_deep
from magfusion.estimation.demodulation.close_log import CloseLog
from magfusion.estimation.demodulation.motion_compensation import (
    KnownMotion,
    MotionCompensated,
    demodulate_about,
    noisier,
)
from magfusion.estimation.demodulation.motion_shape import MotionShape
from magfusion.estimation.demodulation.motion_stretches import STRETCH
from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.detection_range import tones_of
from magfusion.model.parameters import Calibration
from magfusion.model.quaternion import unit
from magfusion.model.samples import FieldSamples, ImuSamples, Log, StaticFields, Waveform
from magfusion.model.site import Site
from magfusion.model.strapdown import resting
from magfusion.model.trajectory import Trajectory, interpolated
from magfusion.receiver.admission import Windows
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.receiver import Receiver
from magfusion.receiver.receivers import receiver_of, windowed
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.turn import BodyTurn, on_clock
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray

REST_EPOCH = 0.5  # s; over which the specific force at rest is averaged


@dataclass(frozen=True, eq=False)
class Demodulation:
    """Phasors of a log: a table, or of a waveform that can be demodulated again."""

    log: Log
    fields: FieldSamples  # the phasors before the motion is known
    dropped: Mapping[str, int]  # reason to number of windows
    receiver: Receiver | None = None  # of the waveform; None where the log has only phasors
    windows: Windows | None = None  # windows of the receiver
    # (n, channels), phasors omitted from ``fields`` in which the motion may mask a beacon; None
    # where the log has only phasors
    masked: BoolArray | None = None
    # (n,), windows in which the motion from the fields replaces inertial samples
    blind: BoolArray | None = None
    # those dropped only for missing inertial samples
    without_turn: Windows = field(default_factory=Windows.none)
    close: CloseLog | None = None  # its short windows, where the tones are close

    @property
    def can_repeat(self) -> bool:
        """Whether samples are available to demodulate again, once the motion is known."""
        return self.log.waveform is not None

    def static(self, calibration: Calibration) -> StaticFields:
        """Return the Earth field and the offset before the motion is known.

        Raises InputError where the log has only phasors, or time slots.
        """
        waveform = self.log.waveform
        if self.receiver is None or waveform is None:
            if self.log.static is None:
                raise InputError(
                    "the log has only phasors, which do not contain the Earth field; give the"
                    " log with magnetometer.parquet, or omit --earth"
                )
            return self.log.static
        assert self.windows is not None
        site, receiver = calibration.site, windowed(self.receiver)
        imu = on_clock(calibration.on_log_rate(self.log.imu), calibration.time_offset)
        operator = receiver.operator(waveform, imu, self.windows, site)
        offset = site.platform.magnetometer.offset
        _, static = operator.demodulate(waveform.measured_sensor - offset)
        return replace(static, measured_sensor=static.measured_sensor + offset)

    def compensated(
        self, calibration: Calibration, states: Trajectory, path: Trajectory | None = None
    ) -> MotionCompensated:
        """Return the phasors, compensated for the motion inside the windows.

        A slot is so short that only the gyro's bias matters. `states`: at the centres of the
        windows. `path`: all states, where these are not those of the windows.
        """
        waveform, imu, offset = self.log.waveform, self.log.imu, calibration.time_offset
        assert waveform is not None
        assert self.receiver is not None
        assert self.windows is not None
        known = on_clock(imu, offset, _bias_at(imu.time + offset, states))
        site, windows = calibration.site, self.windows
        if not isinstance(self.receiver, LockinReceiver):
            result, _ = self.receiver.phasors(waveform, known, windows, site)
            return MotionCompensated.of_slots(result)
        length = self.receiver.settings.window
        motion, turn = _integrated_once(
            waveform, imu, offset, states if path is None else path, windows, site
        )
        operator = self.receiver.operator(waveform, known, windows, site, turn)
        del known  # as large as the log
        if self.blind is not None:
            operator = replace(operator, is_separable=self.blind)
        wave = demodulate_about(
            operator,
            waveform.measured_sensor,
            states,
            imu,
            calibration,
            path,
            wanted=None if self.close is None else self.close.nodes,
            motion=motion,
        )
        if self.blind is None:
            return wave
        fields = noisier(wave.fields, self.blind, states, calibration, length)
        return replace(wave, fields=fields)


def _integrated_once(
    waveform: Waveform,
    imu: ImuSamples,
    offset: float,
    path: Trajectory,
    windows: Windows,
    site: Site,
) -> tuple[KnownMotion | None, BodyTurn | None]:
    """Return the motion and rotation along the samples; None where it is processed in segments."""
    if len(waveform) > STRETCH:
        return None, None
    shape = MotionShape.of(path, imu, offset, site.gravity)
    rotated = shape.turned_at(waveform.time)
    turn = BodyTurn(unit(rotated), unit(shape.turned_at(windows.centre)))
    return KnownMotion(shape, rotated), turn


def _bias_at(time: Array, states: Trajectory) -> Array:
    """Return the bias of the gyro at some times, shape (n, 3) (rad/s)."""
    assert states.gyro_bias_body is not None
    return interpolated(time, states.time, states.gyro_bias_body)


OFF_GRAVITY = 0.5  # of gravity; a specific force that deviates by more is not its opposite


def demodulated(log: Log, site: Site, settings: LockinSettings | None = None) -> Demodulation:
    """Return the phasors of a log, demodulated where it has a waveform.

    Raises InputError where no window, or no slot, is usable, or a beacon is too many skin depths
    away.
    """
    if log.waveform is None:
        if log.fields is None:
            raise EstimationError(f"log {log.name} has neither waveform nor phasors")
        refuse_too_deep(log.fields, site)
        return Demodulation(log, without_silence(log.fields), {})
    if site.platform.further:
        raise InputError("samples of several magnetometers are not demodulated; give their phasors")
    receiver = receiver_of(site, with_disturbing_lines(log, site, settings))
    windows, fields = receiver.whole(log.waveform, log.imu)
    refuse_too_deep(fields, site)
    detected, hidden = without_silence(fields), masked_phasors(fields)
    if tones_of(site).reused:  # the states will assign phasors to beacons better
        hidden |= ~fields.valid
    without = receiver.without_turn if isinstance(receiver, LockinReceiver) else Windows.none()
    dropped = receiver.dropped
    close = CloseLog.of(log, site, settings)
    return Demodulation(
        log, detected, dropped, receiver, windows, hidden, without_turn=without, close=close
    )


def phasors(
    log: Log, site: Site, settings: LockinSettings | None = None
) -> tuple[FieldSamples, Mapping[str, int]]:
    """Return the phasors of a log and the number of dropped windows, as `demodulated`."""
    result = demodulated(log, site, settings)
    return result.fields, result.dropped


def gravity_at_rest(imu: ImuSamples, site: Site, time: Array) -> Gravity | None:
    """Return the direction of gravity where the platform rests; None if it never does.

    `site`: its accelerometer bias limits the accuracy of the direction. `time` (n,): epochs (s).
    """
    stamps = imu.time + site.platform.imu.time_offset
    still = resting(stamps, imu.gyro_body, imu.accel_body, motion=site.platform.motion)
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
    weight = np.abs(size[:, 0] / site.gravity - 1.0) < OFF_GRAVITY
    known = still[nearest] & near & weight
    if not np.any(known):
        return None
    up = np.divide(mean, size, out=np.tile([0.0, 0.0, 1.0], (len(mean), 1)), where=size > 0.0)
    return Gravity(up, np.where(known, sigma, np.inf))


def first_fixes(samples: FieldSamples, log: Log, calibration: Calibration) -> Fixes:
    """Return the fix of every epoch, with gravity where the platform rests.

    With time-multiplexed coils a whole cycle is one epoch.
    """
    epochs, gravity = fix_inputs(samples, log, calibration.site)
    return fix_epochs(epochs, calibration, gravity=gravity)


def fix_inputs(samples: FieldSamples, log: Log, site: Site) -> tuple[FieldSamples, Gravity | None]:
    """Return the epochs of a fix, and gravity where the platform rests."""
    epochs = whole_cycles(samples, log.imu, site) if has_schedule(site) else samples
    return epochs, gravity_at_rest(log.imu, site, epochs.time)
