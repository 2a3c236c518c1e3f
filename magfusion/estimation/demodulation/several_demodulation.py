"""Phasors of several magnetometers' samples, each of which can be demodulated again."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.demodulation.demodulation import Demodulation, demodulated
from magfusion.estimation.demodulation.motion_compensation import MotionCompensated
from magfusion.estimation.demodulation.separate_demodulation import each_alone
from magfusion.files.fields import SAME_TIME, side_by_side
from magfusion.model.parameters import Calibration, seen_by
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.receivers import usual_lockin
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.units import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class MagnetometerPart:
    """Data of one of several magnetometers."""

    sensor: int  # index among the platform's
    rows: IntArray  # (n,), epochs of its phasors
    demodulation: Demodulation  # of this magnetometer alone, on the log's clock


@dataclass(frozen=True, eq=False)
class SeveralDemodulation(Demodulation):
    """Phasors of several magnetometers, by windows at the same times."""

    parts: tuple[MagnetometerPart, ...] = ()  # of those that have samples

    @property
    def can_repeat(self) -> bool:
        """Whether samples are available to demodulate again, once the motion is known."""
        return True

    def compensated(
        self,
        calibration: Calibration,
        states: Trajectory,
        path: Trajectory | None = None,  # noqa: ARG002
    ) -> MotionCompensated:
        """Return the phasors, compensated for the motion inside the windows of each."""
        fields = self.fields
        phasor = np.full_like(fields.phasor_sensor, np.nan)
        cov = np.full_like(fields.phasor_cov, np.nan)
        by_offset = np.zeros_like(phasor)
        for part in self.parts:
            log = replace(part.demodulation.log, imu=self.log.imu)
            known = replace(part.demodulation, log=log)
            result = known.compensated(seen_by(calibration, part.sensor), states.rows(part.rows))
            own = part.rows, calibration.site.of_sensor(part.sensor)
            phasor[own], cov[own] = result.fields.phasor_sensor, result.fields.phasor_cov
            by_offset[own] = result.by_time_offset
        wave = MotionCompensated.of_slots(replace(fields, phasor_sensor=phasor, phasor_cov=cov))
        return replace(wave, by_time_offset=by_offset)


def same_windows(site: Site, settings: LockinSettings | None) -> LockinSettings | None:
    """Return the lock-in settings of each magnetometer, with windows at the same log times."""
    if has_schedule(site):
        return settings
    return replace(usual_lockin(site) if settings is None else settings, origin=0.0)


def demodulated_several(
    log: Log, site: Site, settings: LockinSettings | None = None
) -> SeveralDemodulation:
    """Return the phasors of a log with samples of several magnetometers.

    Raises InputError as `magfusion.estimation.demodulation.demodulation.demodulated`, with the
    name.
    """
    lockin = same_windows(site, settings)
    sensors = [sensor.name for sensor in site.platform.magnetometers]
    result = {sensors.index(name): one for name, one in _each(log, site, lockin)}
    none = FieldSamples.empty(site.channels[: len(site.channels) // len(sensors)])
    every = [result[k].fields if k in result else none for k in range(len(sensors))]
    fields = side_by_side(every, site)
    hidden: BoolArray = np.zeros(fields.valid.shape, dtype=bool)
    parts = []
    for sensor, one in result.items():
        rows = np.searchsorted(fields.time, one.fields.time - SAME_TIME)
        parts.append(MagnetometerPart(sensor, rows, one))
        if one.masked is not None:
            hidden[rows, site.of_sensor(sensor)] = one.masked
    dropped = {
        f"{sensors[sensor]}: {reason}": count
        for sensor, one in result.items()
        for reason, count in one.dropped.items()
    }
    return SeveralDemodulation(log, fields, dropped, masked=hidden, parts=tuple(parts))


def _each(
    log: Log, site: Site, lockin: LockinSettings | None
) -> Iterator[tuple[str, Demodulation]]:
    for name, own, alone in each_alone(log, site):
        try:
            yield name, demodulated(own, alone, lockin)
        except InputError as error:
            raise InputError(f"magnetometer {name}: {error}") from error
