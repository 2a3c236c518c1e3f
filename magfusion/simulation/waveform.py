"""The raw magnetometer stream along a true motion."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.model.marks import Marks
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.samples import Waveform
from magfusion.model.site import Magnetometer, Site, Slots
from magfusion.simulation.disturbance import Ambient
from magfusion.simulation.field import Drives, phasors_world
from magfusion.simulation.magnetometers import answered
from magfusion.simulation.motion import SimulatedMotion
from magfusion.simulation.rails import magnetised_world
from magfusion.simulation.slots import Multiplexer, check_slots, slot_gates
from magfusion.units import Array, ComplexArray

MIN_SAMPLES_PER_CYCLE = 2.5
USUAL_RATE_HZ, USUAL_SAMPLES_PER_SLOT = 400.0, 16


@dataclass(frozen=True, eq=False)
class Mains:
    """Hum of power lines, uniform over the room."""

    amplitude: float  # of the fundamental (T)
    frequency_hz: float = 50.0
    # amplitude of the second, third, ... harmonic relative to the fundamental
    harmonics: tuple[float, ...] = (0.1, 0.3)
    direction_world: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))  # (3,)


def usual_rate_hz(site: Site, burst: float = Multiplexer.burst) -> float:
    """Return a sampling rate suitable for the fastest tone and the shortest time slot (Hz).

    `burst`: length of an unclocked slot (s).
    """
    least = [MIN_SAMPLES_PER_CYCLE * float(b.tone_frequencies_hz.max()) for b in site.beacons]
    lengths = [
        b.slots.duration if isinstance(b.slots, Slots) else burst
        for b in site.beacons
        if b.slots is not None
    ]
    return max(USUAL_RATE_HZ, *least, *(USUAL_SAMPLES_PER_SLOT / length for length in lengths))


def simulate_waveform(
    motion: SimulatedMotion,
    site: Site,
    drives: Drives,
    rate_hz: float,
    duration: float,
    rng: np.random.Generator,
    mains: Mains | None = None,
    quantisation: float | None = None,
    ambient: Ambient | None = None,
    marks: Marks | None = None,
    own: np.random.Generator | None = None,
    begin: float = 0.0,
) -> Waveform:
    """Return the field of all sources at each sample's own pose, as measured.

    Parameters
    ----------
    site : Site
        The true site.  A missing Earth field is zero.
    rate_hz : float
        More than 2.5 samples in the fastest cycle.
    duration : float
        (s)
    mains : Mains, optional
        Its phases are drawn.  Harmonics beyond half the rate alias, as in an instrument that
        does not filter.
    quantisation : float, optional
        Step of the instrument (T).
    ambient : Ambient, optional
        Iron, bending, noise and drift of the room.
    marks : Marks, optional
        When the coils of unclocked slots are driven.
    own : Generator, optional
        Of the instrument's noise; without it all is drawn from one.
    begin : float
        First stamp (s): days are simulated a minute at a time.

    Raises
    ------
    InputError
        If the rate is too low for the tones or slots, coils are driven in time slots whose schedule
        the site does not declare, or the motion leads through iron.
    """
    _check_tones(site, rate_hz, marks, drives)
    count = int(np.floor(duration * rate_hz * (1.0 + 1e-12)))
    if count < 1:
        raise InputError(
            f"magnetometer_rate_hz: found {rate_hz} Hz for {duration} s; give at least one sample"
        )
    magnetometer = site.platform.magnetometer
    stamps = begin + np.arange(count) / rate_hz
    time = stamps + magnetometer.clock_offset
    world_from_body = motion.world_from_body(time)
    lever_world = world_from_body.apply(magnetometer.position_body)
    point_world = motion.position_world(time) + lever_world
    here = site, drives, time, point_world, ambient or Ambient(), marks
    field_world = np.zeros((count, 3)) if magnetometer.response else beacons_world(*here)
    if site.earth_field_world is not None and not magnetometer.ac_coupled:
        field_world += site.earth_field_world
        if ambient is not None and ambient.rails is not None:
            field_world += magnetised_world(ambient.rails, site.earth_field_world, point_world)
    if mains is not None:
        field_world += _mains_world(mains, time, rng)
    if ambient is not None:
        field_world += ambient.background_world(time, rate_hz, rng)
    field_sensor = world_from_body.inv().apply(field_world) @ magnetometer.body_from_sensor
    measured = field_sensor @ magnetometer.matrix.T + magnetometer.offset
    if magnetometer.response:
        for tone in _answered_tones(magnetometer, world_from_body, _tones_world(*here)):
            measured += tone
    instrument = rng if own is None else own
    measured += instrument.normal(
        0.0, magnetometer.noise_density * np.sqrt(rate_hz / 2.0), (count, 3)
    )
    if quantisation:
        measured = quantisation * np.round(measured / quantisation)
    measured[:, magnetometer.lacking] = 0.0
    return Waveform(stamps, measured, marks, magnetometer.axes)


def _answered_tones(
    magnetometer: Magnetometer,
    world_from_body: Rotation,
    tones: Iterable[tuple[float, ComplexArray]],
) -> Iterator[Array]:
    """Yield the response of a magnetometer to tones, each with its frequency (Hz)."""
    measured_from_world = (
        magnetometer.matrix @ magnetometer.body_from_sensor.T @ world_from_body.inv().as_matrix()
    )
    for frequency_hz, tone_world in tones:
        tone = np.einsum("nij,nj->ni", measured_from_world, tone_world)
        detected = answered(tone[:, None], magnetometer.response, np.array([frequency_hz]))
        yield np.real(detected[:, 0])


def _check_tones(site: Site, rate_hz: float, marks: Marks | None, drives: Drives) -> None:
    for beacon in site.beacons:
        highest = float(beacon.tone_frequencies_hz.max())
        if beacon.name in drives.turning and beacon.rotor is not None:
            # Components of a shaft's slip and whirl beyond half the rate alias, as in an
            # instrument.
            orders = (1, *(one.order for one in beacon.rotor.harmonics))
            highest = beacon.frequency_hz * max(orders)
        if rate_hz < MIN_SAMPLES_PER_CYCLE * highest:
            raise InputError(
                f"magnetometer_rate_hz: found {rate_hz} Hz and a tone of {highest} Hz in beacon "
                f"{beacon.name}; give at least {MIN_SAMPLES_PER_CYCLE * highest} Hz"
            )
        check_slots(beacon, rate_hz, marks)


def beacons_world(
    site: Site,
    drives: Drives,
    time: Array,
    point_world: Array,
    ambient: Ambient,
    marks: Marks | None = None,
) -> Array:
    """Return the field of all beacons at the position (m) of each time (s), shape (n, 3) (T)."""
    field_world = np.zeros((len(time), 3))
    for _, tone_world in _tones_world(site, drives, time, point_world, ambient, marks):
        field_world += np.real(tone_world)
    return field_world


def _tones_world(
    site: Site,
    drives: Drives,
    time: Array,
    point_world: Array,
    ambient: Ambient,
    marks: Marks | None,
) -> Iterator[tuple[float, ComplexArray]]:
    """Yield frequency and field of each tone (n, 3), whose real part is the signal (Hz, T)."""
    first = 0
    for i, (beacon, drift) in enumerate(zip(site.beacons, drives.drift, strict=True)):
        phasors = phasors_world(beacon, point_world, ambient.spheres, ambient.layers, ambient.rails)
        if ambient.bending is not None:
            phasors = ambient.bending.bent_world(i, phasors, point_world)
        own = drives.turning.get(beacon.name)
        if own is not None:
            static_world = beacon.world_from_beacon @ own.steady_beacon
            still = dipole_field(point_world - beacon.position_world, static_world)
            yield 0.0, still.astype(np.complex128)
            angle = own.angle(time)
            for k, frequency_hz in enumerate(beacon.tone_frequencies_hz):
                order = np.rint(frequency_hz / beacon.frequency_hz)
                yield float(frequency_hz), phasors[:, k] * np.exp(1j * order * angle)[:, None]
            first += len(beacon.tones)
            continue
        gates = slot_gates(beacon, time, marks)
        for k, frequency_hz in enumerate(beacon.tone_frequencies_hz):
            turns = 2.0 * np.pi * frequency_hz * (1.0 + drift) * time
            carrier = np.exp(1j * (turns + drives.phase[first + k]))
            yield float(frequency_hz), phasors[:, k] * (gates[:, k] * carrier)[:, None]
        first += len(beacon.tones)


def _mains_world(mains: Mains, time: Array, rng: np.random.Generator) -> Array:
    amplitudes = mains.amplitude * np.array([1.0, *mains.harmonics])
    phases = rng.uniform(-np.pi, np.pi, len(amplitudes))
    orders = 1 + np.arange(len(amplitudes))
    angles = 2.0 * np.pi * mains.frequency_hz * time[:, None] * orders + phases
    direction = mains.direction_world / np.linalg.norm(mains.direction_world)
    return (np.cos(angles) @ amplitudes)[:, None] * direction
