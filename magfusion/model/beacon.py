"""A beacon: coils on a common rigid frame, with the uncertainty of their calibration."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from magfusion.model.field_map import FieldMap
from magfusion.model.rotor import Rotor
from magfusion.model.short_repr import short_repr
from magfusion.model.steel_field import SteelField
from magfusion.model.temperature import MomentTemperatureModel
from magfusion.model.time_division import MarkedSlots, Slots
from magfusion.units import Array, ComplexArray

Unknown = Literal["pose", "position", "attitude"]


@dataclass(frozen=True, eq=False)
class Coil:
    """One coil of a beacon, driven by ``cos(2 pi f t + phase)``."""

    moment_beacon: Array  # (3,), peak moment (A m^2)
    phase: float = 0.0  # drive phase relative to the log clock (rad)
    # (3,), magnetic centre relative to the beacon's origin (m)
    centre_beacon: Array = field(default_factory=lambda: np.zeros(3))
    # radius, length: finite size (m), see `magfusion.model.coil_field`; None for a dipole
    radius: float | None = None
    length: float | None = None
    # drive frequency where it differs from the beacon's (frequency division)
    frequency_hz: float | None = None
    # time slot, counted from 0, where coils are driven in turn (time division)
    slot: int | None = None
    current: float | None = None  # peak current of the declared moment (A)


def rotor_coils(rotor: Rotor, frequency_hz: float) -> tuple[Coil, ...]:
    """Return the coils equivalent to a magnet on a shaft rotating at a frequency.

    Their current is one; a measured angle is recorded as its cosine.
    """
    cosine, sine = rotor.turning_moments
    turning = (Coil(cosine, current=1.0), Coil(sine, -np.pi / 2.0, current=1.0))
    return turning + tuple(
        Coil(one.moment_beacon, one.phase, frequency_hz=one.order * frequency_hz, current=1.0)
        for one in rotor.harmonics
    )


@dataclass(frozen=True, eq=False)
class BeaconSigma:
    """Prior standard deviations of a beacon's calibration; zero means known."""

    position_world: Array  # (3,), of the centre, world axes (m)
    rotation_beacon: Array  # (3,), of the attitude, beacon axes (rad)
    log_moment: Array  # (coils,), of the natural logarithm of each coil's moment


@dataclass(frozen=True, eq=False)
class Beacon:
    """A magnetic source: one or more coils on a common rigid frame."""

    __repr__ = short_repr

    name: str
    position_world: Array  # (3,), surveyed centre (m)
    world_from_beacon: Array  # (3, 3), rotation of the coil axes
    frequency_hz: float
    coils: tuple[Coil, ...]
    # False where the drive phase relative to the log clock is unknown and drifts
    synchronised: bool
    sigma: BeaconSigma
    field_map: FieldMap | None = None  # deviation of its field from the model where it was surveyed
    steel: SteelField | None = None  # what the steel of the room adds to its field
    # time slots of its coils, if driven in turn on a known schedule; a frequency of zero then means
    # pulses of direct current
    slots: Slots | MarkedSlots | None = None
    # unsurveyed part, to be estimated from a log; its values are NaN
    unknown: Unknown | None = None
    model_error: float | None = None  # of its own field; the site's if None
    noise_factor: float = 1.0  # noise of its phasors relative to that measured near its tones
    # (3,), direction, of any length, of the half space that contains the magnetometer
    hemisphere_beacon: Array | None = None
    temperature_model: MomentTemperatureModel | None = None  # temperature dependence of its moments
    # of the surrounding ground or water (S/m), uniform, isotropic and unbounded; equal for all
    # beacons of a site
    conductivity: float = 0.0
    rotor: Rotor | None = None  # magnet on a shaft from which its coils are derived
    # whether its frequency is not chosen yet, so that it is shared with no other beacon
    planned: bool = False

    @cached_property
    def tones(self) -> tuple[tuple[float, int | None], ...]:
        """Distinct (frequency in Hz, slot) pairs in the order of the coils."""
        return tuple(
            dict.fromkeys((c.frequency_hz or self.frequency_hz, c.slot) for c in self.coils)
        )

    @cached_property
    def tone_frequencies_hz(self) -> Array:
        """Frequency of each tone (Hz), shape (tones,)."""
        return np.array([frequency for frequency, _ in self.tones])

    @cached_property
    def excitation(self) -> ComplexArray:
        """Complex drive of each coil in each tone, shape (coils, tones)."""
        drive = np.zeros((len(self.coils), len(self.tones)), dtype=np.complex128)
        for j, coil in enumerate(self.coils):
            k = self.tones.index((coil.frequency_hz or self.frequency_hz, coil.slot))
            drive[j, k] = np.exp(1j * coil.phase)
        return drive

    @cached_property
    def tone_moments(self) -> Array:
        """Magnitude of the complex moment of each tone (A m^2), shape (tones,)."""
        return np.asarray(np.linalg.norm(self.moments_beacon.T @ self.excitation, axis=0))

    @cached_property
    def moments_beacon(self) -> Array:
        """Peak moments (A m^2), shape (coils, 3)."""
        return np.array([c.moment_beacon for c in self.coils])

    @cached_property
    def centres_beacon(self) -> Array:
        """Magnetic centres of the coils (m), shape (coils, 3)."""
        return np.array([c.centre_beacon for c in self.coils])

    @cached_property
    def concentric(self) -> bool:
        """Whether all coils are at one place."""
        return bool(np.all(self.centres_beacon == self.centres_beacon[0]))
