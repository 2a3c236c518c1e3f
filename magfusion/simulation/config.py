"""What is simulated: motion, instruments, and the room around them."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from magfusion.model.short_repr import short_repr
from magfusion.simulation.disturbance import Ambient
from magfusion.simulation.inertial import BiasInstability
from magfusion.simulation.motion import Rests
from magfusion.simulation.shaft import ShaftErrors
from magfusion.simulation.slots import Multiplexer
from magfusion.simulation.waveform import Mains
from magfusion.units import Array

MotionKind = Literal["walk", "turn", "static", "drive"]


@dataclass(frozen=True, eq=False)
class Reference:
    """A second, stationary magnetometer that receives the same ambient noise."""

    position_world: Array  # (3,) (m)
    world_from_sensor: Array = field(default_factory=lambda: np.eye(3))  # (3, 3)
    # late, rate: a sample stamped t was taken at t + late + rate t (s)
    late: float = 0.0
    rate: float = 0.0


@dataclass(frozen=True, eq=False)
class SimulationConfig:
    """Configuration of a simulated log.

    Parameters
    ----------
    box_world : ndarray, shape (2, 3)
        Lower and upper corner (m) of the body's range.
    duration : float
        (s)
    motion : {"walk", "turn", "static", "drive"}
    speed : float
        Approximate mean speed while moving (m/s).
    turn_rate : float
        Angular rate of a turn, rms (rad/s).
    imu_rate_hz, magnetometer_rate_hz : float
        The latter more than 2.5 times the highest tone.
    time_offset : float, optional
        True time offset of the IMU (s); by default as declared.
    clock_rate : float, optional
        True rate of the IMU's clock, by which its time offset grows; by default as declared.
    perturb : bool
        Whether the true calibration is drawn from the site's prior, or is as declared.
    noise_scale : float
        True white noise of all instruments, relative to the declared.
    quantisation : float, optional
        Step of the magnetometer (T).
    instability : BiasInstability, optional
        Of the IMU, in addition to its bias walk.
    ambient : Ambient, optional
        Iron, noise and drift of the room.
    reference : Reference, optional
        Of the same noise density and rate as the magnetometer.
    iron : int
        Steel spheres drawn around the box, by `magfusion.simulation.disturbance.draw_spheres`; they
        replace those of the ambient.
    random_field : float
        Smooth random error of each beacon's field, relative to it, correlated over the site's
        ``model_error_length``; it replaces the ambient's bending.
    multiplexer : Multiplexer
        Drives the coils whose slots the site declares as marked.
    shafts : ShaftErrors
        Rotation errors of beacons that are magnets on shafts.
    """

    __repr__ = short_repr

    box_world: Array
    duration: float = 60.0
    motion: MotionKind = "walk"
    speed: float = 0.5
    turn_rate: float = 0.6
    rests: Rests = field(default_factory=Rests)
    imu_rate_hz: float = 200.0
    magnetometer_rate_hz: float = 400.0
    time_offset: float | None = None
    clock_rate: float | None = None
    perturb: bool = True
    noise_scale: float = 1.0
    mains: Mains | None = None
    quantisation: float | None = None
    instability: BiasInstability | None = None
    ambient: Ambient | None = None
    reference: Reference | None = None
    iron: int = 0
    random_field: float = 0.0
    multiplexer: Multiplexer = field(default_factory=Multiplexer)
    shafts: ShaftErrors = field(default_factory=ShaftErrors)
