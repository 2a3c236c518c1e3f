"""Rotation of a measured field against non-rotating axes, from the gyro."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from magfusion.model.once import once_a_site
from magfusion.model.quaternion import inverse, matrices, unit
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.strapdown import turn_at, turn_from_gyro
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Turn:
    """Rotation of the axes of a magnetometer against non-rotating axes."""

    # at times (m,), unit quaternions of shape (4, m), scalar first
    still_from_body: Callable[[Array], Array]
    from_body: Array  # (3, 3), from `measured_from_body`; not necessarily a rotation

    def __call__(self, time: Array) -> Array:
        """Return ``measured_from_still`` at times (m,), shape (m, 3, 3)."""
        return self.from_body @ matrices(inverse(self.still_from_body(time)))

    def back(self, time: Array) -> Array:
        """Return ``still_from_measured`` at times (m,), shape (m, 3, 3)."""
        return matrices(self.still_from_body(time)) @ self._to_body

    def both(self, time: Array) -> tuple[Array, Array]:
        """Return ``measured_from_still`` and its inverse, at times (m,)."""
        still_from_body = matrices(self.still_from_body(time))
        return (
            self.from_body @ np.swapaxes(still_from_body, 1, 2),
            still_from_body @ self._to_body,
        )

    @cached_property
    def _to_body(self) -> Array:
        return np.asarray(np.linalg.inv(self.from_body))


class BodyTurn(NamedTuple):
    """The ``still_from_body`` of an inertial stream: at samples (4, m), at windows' centres (4, n).

    Unit quaternions, scalar first.
    """

    at_samples: Array
    at_centres: Array


def on_clock(
    imu: ImuSamples, time_offset: float, gyro_bias_body: Array | None = None
) -> ImuSamples:
    """Return an inertial stream on the clock of the waveform, corrected for the gyro bias.

    `time_offset`: IMU time offset (s). `gyro_bias_body` (3,) (rad/s).
    """
    gyro = imu.gyro_body if gyro_bias_body is None else imu.gyro_body - gyro_bias_body
    return replace(imu, time=imu.time + time_offset, gyro_body=gyro)


def zero_rate_filler(imu: ImuSamples, silence: tuple[Array, Array]) -> ImuSamples:
    """Return a stream of angular rates that are zero in its gaps.

    `imu`: as from `on_clock`. `silence`: where the gaps begin and end (s), as from
    `magfusion.receiver.admission.silences`.
    """
    begin, end = silence
    inner = np.stack([0.99 * begin[:-1] + 0.01 * end[:-1], 0.01 * begin[:-1] + 0.99 * end[:-1]])
    # After the last sample its rate continues for as long as that is no gap.
    last = begin[-1] + np.array([0.0, max(begin[-1] - imu.time[-1], 1e-3)])
    time = np.append(inner.T.ravel(), last)
    at = np.searchsorted(imu.time, time)
    rates = np.zeros((len(time), 3))
    rates[-2] = imu.gyro_body[-1]
    gyro = np.insert(imu.gyro_body, at, rates, axis=0)
    force = np.broadcast_to(np.zeros(3), gyro.shape)  # not used for the rotation
    return ImuSamples(np.insert(imu.time, at, time), gyro, force)


def turn_of(imu: ImuSamples, site: Site) -> Turn:
    """Return the rotation of a field.

    The non-rotating axes are those of the body at the first inertial sample. `imu`: as from
    `on_clock`.
    """
    return Turn(body_turn_of(imu), measured_from_body(site))


def slot_turn_of(imu: ImuSamples, site: Site) -> Turn:
    """Return the rotation of a slot's field; none where a receiver lacks axes.

    The field along the missing axes is not measured, so that no field can be rotated.
    """
    if not site.platform.magnetometer.lacking:
        return turn_of(imu, site)
    return Turn(lambda time: np.tile([[1.0], [0.0], [0.0], [0.0]], (1, len(time))), np.eye(3))


def body_turn_of(imu: ImuSamples) -> Callable[[Array], Array]:
    """Return the function from times (m,) to ``still_from_body`` of `turn_of`, shape (4, m).

    Quaternions, scalar first.
    """
    turn = turn_from_gyro(imu.time, imu.gyro_body)
    return lambda time: unit(turn_at(turn, imu.time, imu.gyro_body, time))


@once_a_site
def measured_from_body(site: Site) -> Array:
    """Return the matrix from the body's to the magnetometer's axes, (3, 3)."""
    sensor = site.platform.magnetometer
    return np.asarray(sensor.matrix @ sensor.body_from_sensor.T)


@once_a_site
def body_from_measured(site: Site) -> Array:
    """Return the inverse of `measured_from_body`."""
    return np.asarray(np.linalg.inv(measured_from_body(site)))
