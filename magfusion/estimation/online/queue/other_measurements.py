"""Measurements of single epochs that are not of fields: aiding sensors, and those of the user."""

from collections import Counter

import numpy as np

from magfusion.estimation.data_checks.stream_buffer import check_clock
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.estimation.measurements.aiding_samples import (
    aiding_measurement,
    measured_time,
    thinned,
)
from magfusion.model.aiding import AidingSamples, AidingSensor


class OtherMeasurements:
    """Measurements that are not processed yet, sorted by time.

    `waiting`: with their times (s).
    """

    waiting: list[tuple[float, Measurement]]
    _aiding_until: dict[str, float]  # time of each sensor's last sample (s)

    def __init__(self) -> None:
        self.waiting, self._aiding_until = [], {}

    @property
    def next(self) -> float:
        """Time of the next one (s)."""
        return self.waiting[0][0] if self.waiting else np.inf

    def add(self, time: float, measurement: Measurement, after: float, newest: float) -> bool:
        """Add a measurement; return whether it is after a time (s).

        `newest`: newest stamp of all streams (s). Raises InputError if the clock jumped.
        """
        check_clock("measurement", np.array([time]), newest)
        in_time = time > after + SAME_TIME
        if in_time:
            self.waiting.append((time, measurement.at(0)))
            self.waiting.sort(key=lambda other: other[0])
        return in_time

    def add_aiding(
        self, sensor: AidingSensor, samples: AidingSamples, after: float, newest: float
    ) -> Counter[str]:
        """Add samples of an aiding sensor; return how many are unused, by reason."""
        used = thinned(sensor, samples, self._aiding_until.get(sensor.name, -np.inf))
        unused: Counter[str] = Counter()
        if len(used) < len(samples):
            unused[f"{sensor.name} sample beyond its rate"] = len(samples) - len(used)
        if len(samples):
            self._aiding_until[sensor.name] = float(samples.time[-1])
        measurement = aiding_measurement(sensor, used)
        for i, time in enumerate(measured_time(sensor, used).tolist()):
            if not self.add(time, measurement.rows(slice(i, i + 1)), after, newest):
                unused["measurement too late"] += 1
        return unused

    def take(self, time: float) -> list[Measurement]:
        """Return the measurements up to a time (s), and remove them."""
        due = [measurement for when, measurement in self.waiting if when <= time + SAME_TIME]
        self.drop_until(time + SAME_TIME)
        return due

    def drop_until(self, time: float) -> None:
        """Drop measurements up to a time (s)."""
        self.waiting = [other for other in self.waiting if other[0] > time]
