"""Aiding sensors of a platform, besides IMU and magnetometers, and their samples."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from magfusion.errors import InputError
from magfusion.model.short_repr import short_repr
from magfusion.units import Array, BoolArray

Quantity = Literal[
    "velocity", "range", "position", "mark", "height", "pressure", "heading", "relative_pose"
]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
OF_MOTION: tuple[Quantity, ...] = ("velocity", "position", "relative_pose")  # of three axes
AIDING_RATE = 10.0  # Hz; what a vehicle does between is measured by the IMU
MAX_INTERVAL = 2.0  # s of a relative pose, in which the noise of an IMU is still small
_COMPONENTS: dict[Quantity, int] = {"velocity": 3, "position": 3, "mark": 0, "relative_pose": 7}


def _zero() -> Array:
    return np.zeros(())


@dataclass(frozen=True, eq=False)
class AidingSigma:
    """Prior standard deviations of the parameters of an aiding sensor."""

    position_body: Array = field(default_factory=lambda: np.zeros(3))  # (3,) (m)
    rotation_sensor: Array = field(default_factory=lambda: np.zeros(3))  # (3,) (rad)
    # scale, offset, time_offset: (), of a scale factor, in the unit of the measurement, and (s)
    scale: Array = field(default_factory=_zero)
    offset: Array = field(default_factory=_zero)
    time_offset: Array = field(default_factory=_zero)
    point_world: Array = field(default_factory=lambda: np.zeros(3))  # (3,) (m)


@dataclass(frozen=True, eq=False)
class AidingSensor:
    """One aiding sensor, which measures in the SI unit of its quantity."""

    __repr__ = short_repr

    name: str
    # ``velocity`` of the sensor in its own axes (m/s); ``range`` to ``point_world`` (m);
    # ``position`` (m), or that of a named ``mark`` on which the sensor is; ``height`` above the
    # world's zero (m), or as a ``pressure`` (Pa); ``heading`` of the body's x axis, clockwise from
    # the world's y axis (rad); ``relative_pose`` of the sensor since an earlier time (m)
    quantity: Quantity
    sigma: float  # of white noise
    relative_sigma: float = 0.0  # noise of a velocity or translation as a share of its size
    # standard deviation about zero of the axes of a velocity that are not measured, as of wheels
    # that do not slide (nonholonomic constraint, m/s)
    constraint_sigma: float | None = None
    position_body: Array = field(default_factory=lambda: np.zeros(3))  # (3,), lever arm (m)
    body_from_sensor: Array = field(default_factory=lambda: np.eye(3))  # (3, 3)
    point_world: Array | None = None  # (3,) (m)
    # positions of the marks by their names, shape (3,) (m)
    marks_world: Mapping[str, Array] = field(default_factory=dict)
    # scale, offset: (), ``measured = scale * true + offset``; of a pressure, the true value is a
    # height
    scale: Array = field(default_factory=lambda: np.ones(()))
    offset: Array = field(default_factory=_zero)
    offset_walk: float = 0.0  # standard deviation that the offset gains in an hour
    # (), a sample stamped t was measured at t + time_offset (s)
    time_offset: Array = field(default_factory=_zero)
    rate_hz: float = AIDING_RATE  # greatest rate of the samples that are used; others are left out
    sigmas: AidingSigma = field(default_factory=AidingSigma)
    # latitude, longitude (degrees) and ellipsoidal height (m) of the world's origin, for positions
    # of GNSS; the world's axes are east, north and up there
    origin: tuple[float, float, float] | None = None
    rotation_sigma: float = 0.0  # of the rotation of a relative pose (rad)
    # SI value of a recorded one: of a velocity in km/h 1 / 3.6, of a depth as a height -1; of a
    # mark that of ``marks_world``
    unit: float = 1.0
    # (3, 3), axes of the positions, as of a total station's frame
    world_from_sensor: Array = field(default_factory=lambda: np.eye(3))

    def in_si(self, recorded: Array) -> Array:
        """Return recorded vectors or numbers (n, k) in SI units and world axes."""
        own = self.quantity == "position"
        return self.unit * (recorded @ self.world_from_sensor.T if own else recorded)


@dataclass(frozen=True, eq=False)
class AidingSamples:
    """Samples of one aiding sensor.

    Parameters
    ----------
    quantity : str
        As of `AidingSensor`.
    time : ndarray, shape (n,)
        Seconds since the log's epoch.
    value : ndarray, shape (n, components)
        ``velocity`` (n, 3) in sensor axes (m/s), NaN for an axis that is not measured; ``range``
        (n, 1) (m); ``position`` (n, 3) in world axes (m); ``mark`` (n, 0); ``height`` (n, 1) (m);
        ``pressure`` (n, 1) (Pa); ``heading`` (n, 1) (rad); ``relative_pose`` (n, 7), of an interval
        that ends at ``time``: its length (s), the translation in the sensor's axes at its beginning
        (m) and the rotation vector from there to the axes at its end (rad).
    marks : tuple of str
        Name of each sample's mark, if they are marks.

    Raises
    ------
    InputError
        Where shapes do not fit, or a sample has no finite value.
    """

    __repr__ = short_repr

    quantity: Quantity
    time: Array
    value: Array
    marks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        columns = components(self.quantity)
        if self.value.shape != (len(self.time), columns):
            raise InputError(
                f"{self.quantity}: the values have the shape {self.value.shape}; give {columns} for"
                f" each of {len(self.time)} times"
            )
        missing = np.isnan(self.value)
        whole = ~missing.all(axis=1) if self.quantity == "velocity" else ~missing.any(axis=1)
        if columns and not (np.all(whole) and np.all(missing | np.isfinite(self.value))):
            raise InputError(f"{self.quantity}: a sample has no finite value; leave it out")
        if self.quantity == "mark" and len(self.marks) != len(self.time):
            raise InputError("mark: give the name of a mark for each time")
        if self.quantity == "relative_pose" and np.any(self.value[:, 0] <= 0.0):
            raise InputError("relative_pose: an interval is not positive; give its length in s")

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, kept: BoolArray | slice) -> "AidingSamples":
        """Return some of the samples."""
        marks = tuple(np.array(self.marks, dtype=object)[kept]) if self.marks else ()
        return AidingSamples(self.quantity, self.time[kept], self.value[kept], marks)


def components(quantity: Quantity) -> int:
    """Return how many numbers a sample of a quantity has."""
    return _COMPONENTS.get(quantity, 1)


def sensor_named(
    sensors: tuple[AidingSensor, ...], name: str, quantity: Quantity | None = None
) -> AidingSensor:
    """Return an aiding sensor of a site by its name, and its quantity if that is known.

    Raises InputError if the site has no such sensor.
    """
    known = {sensor.name: sensor for sensor in sensors}
    if name not in known:
        listed = ", ".join(known) or "none"
        raise InputError(
            f"{name} is no aiding sensor of the site (it has {listed}); add it to the site's"
            " aiding, or drop its samples"
        )
    if quantity not in (None, known[name].quantity):
        raise InputError(
            f"{name} has samples of a {quantity}, but the site declares a {known[name].quantity};"
            " correct one of them"
        )
    return known[name]


def check_declared(sensors: tuple[AidingSensor, ...], aiding: Mapping[str, AidingSamples]) -> None:
    """Raise InputError if samples are of a sensor, a quantity or a mark that the site lacks."""
    for name, samples in aiding.items():
        check_marks(sensor_named(sensors, name, samples.quantity), samples)


def check_marks(sensor: AidingSensor, samples: AidingSamples) -> None:
    """Raise InputError if samples are on a mark that the site lacks."""
    unknown = sorted(set(samples.marks) - set(sensor.marks_world))
    if unknown:
        raise InputError(
            f"{sensor.name}: {unknown[0]} is no mark of the site; add it to aiding.marks_m"
        )
