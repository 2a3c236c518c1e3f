"""Simulated logs of a site: a true calibration is drawn, a body moves, instruments record."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.model.arguments import check_arguments
from magfusion.model.marks import Marks
from magfusion.model.samples import FieldSamples, ImuSamples, Log, RotorAngles, Waveform
from magfusion.model.short_repr import short_repr
from magfusion.model.site import MarkedSlots, Site
from magfusion.model.trajectory import Trajectory, interpolated
from magfusion.simulation.aiding import simulate_aiding
from magfusion.simulation.config import Reference as Reference
from magfusion.simulation.config import SimulationConfig as SimulationConfig
from magfusion.simulation.disturbance import Ambient, Bending, Spheres, draw_bending, draw_spheres
from magfusion.simulation.field import Drives, phasors_world, synchronised_drives
from magfusion.simulation.inertial import SimulatedImu, simulate_imu
from magfusion.simulation.layers import Layers
from magfusion.simulation.magnetometers import answered, names_by_channel
from magfusion.simulation.motion import (
    ATTITUDE_KNOT,
    SimulatedMotion,
    driving_motion,
    random_walk_motion,
    static_motion,
    turning_motion,
)
from magfusion.simulation.perturbed import perturb_site as perturb_site
from magfusion.simulation.perturbed import with_earth_field
from magfusion.simulation.rotor_beacons import MagnetRotation, recorded_angles, turn_rotors
from magfusion.simulation.slots import draw_marks
from magfusion.simulation.waveform import beacons_world, simulate_waveform
from magfusion.units import Array

EPOCH_NS = 1_700_000_000_000_000_000

TURN_STEP = 0.6  # rad rms between two knots of a turn, at most: more than pi is shortened


@dataclass(frozen=True, eq=False)
class SimulatedLog:
    """A log and its true values.

    Parameters
    ----------
    log : Log
        Its ``truth`` is stamped on the log's clock at the IMU's rate.
    true_site : Site
        True calibration, noise and time offset of the IMU.
    drives : Drives
        True phases (rad) and relative drifts.
    motion : SimulatedMotion
        Exact truth at any time.
    ambient : Ambient, optional
        With the drawn iron.
    """

    __repr__ = short_repr

    log: Log
    true_site: Site
    drives: Drives
    motion: SimulatedMotion
    ambient: Ambient | None = None

    @property
    def time_offset(self) -> float:
        """True time offset of the IMU (s)."""
        return self.true_site.platform.imu.time_offset


def simulate_log(site: Site, config: SimulationConfig, rng: np.random.Generator) -> SimulatedLog:
    """Return a simulated log of a body moving among the beacons of a site.

    Calibration, motion, IMU, magnetometer, iron and random field have separate generators, spawned
    from ``rng``: a change to one does not affect the draws of the others.

    Parameters
    ----------
    site : Site
        As declared; the true one is drawn by its sigmas, unless ``config.perturb`` is False.
    config : SimulationConfig
        Motion, duration (s), rates (Hz) and disturbances.
    rng : numpy.random.Generator
        Equal seeds give equal logs.

    Raises
    ------
    TypeError
        Where the arguments are not a site, a configuration and a generator, in this order.
    InputError
        If the configuration or the site cannot be simulated.
    """
    check_arguments(
        "simulate_log",
        site=(site, Site),
        config=(config, SimulationConfig),
        rng=(rng, np.random.Generator),
    )
    calibration_rng, motion_rng, imu_rng, magnetometer_rng, iron_rng, field_rng = rng.spawn(6)
    declared = with_earth_field(site)
    true_site = perturb_site(declared, calibration_rng) if config.perturb else declared
    true_site = _with_instruments(true_site, config)
    shaft_rng, among = calibration_rng, true_site
    turning: dict[str, MagnetRotation] = {}
    if any(beacon.rotor is not None for beacon in site.beacons):
        shaft_rng = rng.spawn(1)[0]
        among, turning = turn_rotors(true_site, config.shafts, config.duration, shaft_rng)
    drives = replace(draw_drives(among, calibration_rng), turning=turning)
    motion = _motion(config, motion_rng)
    ambient = _with_bending(true_site, config, field_rng, _with_iron(true_site, config, iron_rng))
    imu = _imu(motion, true_site, config, imu_rng)
    marks = None
    if any(isinstance(beacon.slots, MarkedSlots) for beacon in site.beacons):
        marks = draw_marks(site, config.multiplexer, config.duration, rng.spawn(1)[0])

    def recorded(site: Site, rng: np.random.Generator, own: np.random.Generator | None) -> Waveform:
        rate_hz, duration = config.magnetometer_rate_hz, config.duration
        parts = config.mains, config.quantisation, ambient, marks, own
        return simulate_waveform(motion, site, drives, rate_hz, duration, rng, *parts)

    several = bool(true_site.platform.further)
    waveform = None if several else recorded(among, magnetometer_rng, None)
    waveforms = _of_each(among, recorded, magnetometer_rng) if several else {}
    rotation = None
    if turning and config.shafts.encoder:
        rotation = _encoder(waveform, true_site, turning, shaft_rng)
    reference = None
    if config.reference is not None:
        # Spawned last, so that earlier draws do not change.
        reference = simulate_reference(
            config.reference, among, drives, config, rng.spawn(1)[0], ambient, marks
        )
    log = Log(
        name=f"simulated_{config.motion}",
        epoch_ns=EPOCH_NS,
        source="simulation",
        imu=imu.samples if np.isfinite(site.platform.imu.gyro_noise) else ImuSamples.empty(),
        waveform=waveform,
        truth=_truth(motion, imu, true_site),
        reference=reference,
        waveforms=waveforms,
        rotation=rotation,
        # Spawned last, as the reference.
        aiding=simulate_aiding(motion, true_site, config.duration, rng.spawn(1)[0])
        if site.aiding
        else {},
    )
    return SimulatedLog(log, true_site, drives, motion, ambient)


def _encoder(
    waveform: Waveform | None,
    site: Site,
    turning: dict[str, MagnetRotation],
    rng: np.random.Generator,
) -> RotorAngles:
    """Return the angles of the rotors at the samples of the only magnetometer."""
    if waveform is None:
        raise InputError(
            "encoder: the angle of a rotor cannot be recorded with several magnetometers; simulate"
            " without an encoder, or with one magnetometer"
        )
    sampled_at = waveform.time + site.platform.magnetometer.clock_offset
    return replace(recorded_angles(turning, sampled_at, rng), time=waveform.time)


def _imu(
    motion: SimulatedMotion, site: Site, config: SimulationConfig, rng: np.random.Generator
) -> SimulatedImu:
    model = site.platform.imu
    return simulate_imu(
        motion,
        model,
        site.gravity,
        config.imu_rate_hz,
        config.duration,
        rng,
        model.time_offset,
        config.instability,
        model.clock_rate,
    )


def _truth(motion: SimulatedMotion, imu: SimulatedImu, site: Site) -> Trajectory:
    """Return the true states at the stamps of the inertial samples."""
    stamp, clock = imu.samples.time, site.platform.imu
    selected = (1.0 + clock.clock_rate) * stamp + clock.time_offset
    return replace(
        motion.trajectory(stamp),
        gyro_bias_body=interpolated(stamp, selected, imu.gyro_bias_body),
        accel_bias_body=interpolated(stamp, selected, imu.accel_bias_body),
    )


def _of_each(
    site: Site,
    recorded: Callable[[Site, np.random.Generator, np.random.Generator | None], Waveform],
    rng: np.random.Generator,
) -> dict[str, Waveform]:
    """Return the record of each magnetometer: common ambient field, separate noise."""
    surroundings = int(rng.integers(1 << 62))
    sensors = site.platform.magnetometers
    return {
        sensor.name: recorded(
            replace(site, platform=site.platform.with_magnetometers((sensor,))),
            np.random.default_rng(surroundings),
            own,
        )
        for sensor, own in zip(sensors, rng.spawn(len(sensors)), strict=True)
    }


def simulate_reference(
    reference: Reference,
    site: Site,
    drives: Drives,
    config: SimulationConfig,
    rng: np.random.Generator,
    ambient: Ambient | None,
    marks: Marks | None = None,
) -> Waveform:
    """Return the record of a reference, with its stamps.

    It contains no mains and no local noise.
    """
    count = int(config.duration * config.magnetometer_rate_hz)
    stamps: Array = np.arange(count) / config.magnetometer_rate_hz
    time: Array = (1.0 + reference.rate) * stamps + reference.late
    sensor = site.platform.magnetometer
    common = None if ambient is None else Ambient(atmosphere=ambient.atmosphere)
    there = np.tile(reference.position_world, (len(time), 1))
    field_world = beacons_world(site, drives, time, there, ambient or Ambient(), marks)
    if site.earth_field_world is not None:
        field_world += site.earth_field_world
    if common is not None:
        field_world += common.background_world(time, config.magnetometer_rate_hz, rng)
    measured = field_world @ reference.world_from_sensor
    sigma = sensor.noise_density * np.sqrt(config.magnetometer_rate_hz / 2.0)
    return Waveform(stamps, measured + rng.normal(0.0, sigma, measured.shape))


def simulate_fields(
    site: Site,
    trajectory: Trajectory,
    sigma: float,
    rng: np.random.Generator,
    drives: Drives | None = None,
    window: float = 0.4,
    spheres: Spheres | None = None,
    layers: Layers | None = None,
    bending: Bending | None = None,
) -> FieldSamples:
    """Return phasors with white noise directly, without a waveform and its receiver.

    Parameters
    ----------
    site : Site
        The true site.
    trajectory : Trajectory
        One epoch each (time and pose).
    sigma : float
        Standard deviation of each component's real, and imaginary, part (T).
    drives : Drives, optional
        By default as the site declares.
    window : float
        Window length of the samples (s); the field is instantaneous.
    spheres : Spheres, optional
        Iron in the room.
    layers : Layers, optional
        Of the ground, instead of the full space of the site.
    bending : Bending, optional
        Of each beacon's field.
    """
    drives = drives or synchronised_drives(site)
    time = trajectory.time
    drifts = np.repeat(drives.drift, [len(b.tones) for b in site.beacons])
    frequencies_hz = site.tone_frequencies_hz
    phase = drives.phase + 2.0 * np.pi * drifts * frequencies_hz * time[:, None]
    parts = []
    for magnetometer in site.platform.magnetometers:
        lever_world = trajectory.world_from_body @ magnetometer.position_body
        point_world = trajectory.position_world + lever_world
        world_from_sensor = trajectory.world_from_body @ magnetometer.body_from_sensor
        fields_world = [phasors_world(b, point_world, spheres, layers) for b in site.beacons]
        if bending is not None:
            straight = enumerate(fields_world)
            fields_world = [bending.bent_world(i, own, point_world) for i, own in straight]
        world = np.concatenate(fields_world, axis=1)
        rotated = world * np.exp(1j * phase)[..., None]
        seen = rotated @ world_from_sensor @ magnetometer.matrix.T
        seen = answered(seen, magnetometer.response, frequencies_hz)
        seen[..., magnetometer.lacking] = np.nan
        parts.append(seen)
    phasor = np.concatenate(parts, axis=1)
    noise = rng.normal(0.0, sigma, (2, *phasor.shape))
    return FieldSamples(
        time=time,
        window=np.full(len(time), window),
        channels=site.channels,
        phasor_sensor=phasor + noise[0] + 1j * noise[1],
        phasor_cov=np.broadcast_to(sigma**2 * np.eye(3), (*phasor.shape, 3)).copy(),
        axes=site.platform.magnetometer.axes,
        magnetometers=names_by_channel(site),
    )


def draw_drives(site: Site, rng: np.random.Generator) -> Drives:
    """Return a random phase per tone and drift for every beacon that is not synchronised."""
    free_parameters = np.array([not beacon.synchronised for beacon in site.beacons], dtype=bool)
    tones = [len(beacon.tones) for beacon in site.beacons]
    phase = rng.uniform(-np.pi, np.pi, sum(tones)) * np.repeat(free_parameters, tones)
    return Drives(
        phase, rng.normal(0.0, site.clock.drift_sigma, len(free_parameters)) * free_parameters
    )


def _with_instruments(site: Site, config: SimulationConfig) -> Site:
    imu = site.platform.imu
    declared, scale = imu.time_offset, config.noise_scale
    imu = replace(
        imu,
        gyro_noise=scale * imu.gyro_noise,
        accel_noise=scale * imu.accel_noise,
        time_offset=declared if config.time_offset is None else config.time_offset,
        clock_rate=imu.clock_rate if config.clock_rate is None else config.clock_rate,
    )
    sensors = tuple(
        replace(m, noise_density=scale * m.noise_density) for m in site.platform.magnetometers
    )
    return replace(site, platform=replace(site.platform, imu=imu).with_magnetometers(sensors))


def _with_iron(site: Site, config: SimulationConfig, rng: np.random.Generator) -> Ambient | None:
    if config.iron < 0:
        raise InputError(f"iron: found {config.iron} spheres; give zero or more")
    if config.iron == 0:
        return config.ambient
    beacons_world = np.array([beacon.position_world for beacon in site.beacons]).reshape(-1, 3)
    spheres = draw_spheres(rng, config.iron, config.box_world, beacons_world)
    return replace(config.ambient or Ambient(), spheres=spheres)


def _with_bending(
    site: Site, config: SimulationConfig, rng: np.random.Generator, ambient: Ambient | None
) -> Ambient | None:
    if config.random_field == 0.0:
        return ambient
    length = site.model_error_length
    if length == 0.0:
        raise InputError(
            "model_error_correlation_m: found 0; declare a correlation length of the random field"
            " in the site"
        )
    bending = draw_bending(rng, config.random_field, length, len(site.beacons))
    return replace(ambient or Ambient(), bending=bending)


def _motion(config: SimulationConfig, rng: np.random.Generator) -> SimulatedMotion:
    if config.motion == "static":
        position = rng.uniform(config.box_world[0], config.box_world[1])
        heading = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        return static_motion(position, heading * Rotation.from_rotvec(rng.normal(0.0, 0.1, 3)))
    path = (rng, config.duration, config.box_world, config.speed)
    if config.motion == "walk":
        return random_walk_motion(*path, rests=config.rests)
    if config.motion == "turn":
        interval = min(ATTITUDE_KNOT, TURN_STEP / config.turn_rate)
        return turning_motion(*path, config.turn_rate, config.rests, interval)
    if config.motion == "drive":
        return driving_motion(*path, rests=config.rests)
    raise InputError(f"motion: found {config.motion!r}; give walk, turn, static or drive")
