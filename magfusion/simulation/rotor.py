"""Log of a sensor at rest in one well while a magnet rotates on a shaft in another.

The moment itself is rotated, sample by sample, with its stack's length, its tilt and the whirl of
the shaft; two coils in quadrature are not used.  The contribution of the ground's layers and of
steel is added as a phasor that rotates with the shaft.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from magfusion.model.physics.dipole import dipole_field
from magfusion.model.samples import Depths, ImuSamples, Log, RotorAngles, Waveform
from magfusion.model.site import Rotor, Site
from magfusion.simulation.ground import dipole_in_ground
from magfusion.simulation.layers import Layers, layered_effect_at
from magfusion.simulation.pipe import Steel
from magfusion.simulation.shaft import Shaft, moment_orders, shaft_angle, turned_moment
from magfusion.units import Array, ComplexArray

PAUSE = 30.0  # s; unrecorded, between two passes
NODES_APART = 0.08  # of the distance, between places where steel and layers are calculated


@dataclass(frozen=True, eq=False)
class Pass:
    """A pass of the magnet at a sensor at rest."""

    sensor_depth: float  # along its own hole (m)
    sensor_world: Array  # (3,) (m)
    world_from_body: Array  # (3, 3), of the sensor; its first axis is down the hole
    start_world: Array  # (3,), of the magnet (m)
    world_from_rotor: Array  # (3, 3), its attitude, constant; it moves along its axis
    depth: tuple[float, float]  # of the magnet along its hole when the pass begins and ends (m)
    speed: float  # speed of the magnet along the hole (m/s)

    @property
    def duration(self) -> float:
        """Duration of the pass (s)."""
        return abs(self.depth[1] - self.depth[0]) / self.speed


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Surroundings of the wells."""

    layers: Layers | None = None
    steel: Steel | None = None
    depth_scale: float = 0.0  # relative error of the magnet's depths
    depth_sigma: float = 0.0  # m, of each reading of them
    conductivity: float = 0.0  # S/m, without end, where there are no layers


def simulate_transits(
    site: Site,
    shaft: Shaft,
    transits: tuple[Pass, ...],
    around: Surroundings,
    rate_hz: float,
    rng: np.random.Generator,
    encoder: bool = True,
) -> Log:
    """Return a log of consecutive passes.

    `site`: the true site: its only beacon is a rotor, whose position and attitude are those of the
    passes. `encoder`: whether the angle of the shaft is recorded.
    """
    beacon, begin = site.beacons[0], 0.0
    waves, angles, forces, depths, places = [], [], [], [], []
    for own in transits:
        time = begin + np.arange(int(own.duration * rate_hz)) / rate_hz
        angle = shaft_angle(shaft, beacon.frequency_hz, time, rng)
        forward = 1.0 if own.depth[1] > own.depth[0] else -1.0
        at = own.depth[0] + forward * own.speed * (time - begin)
        waves.append(Waveform(time, _measured(site, shaft, own, around, angle, at, rate_hz, rng)))
        angles.append(angle + shaft.encoder_sigma * rng.standard_normal(len(angle)))
        affected = time[:: max(int(rate_hz / 10.0), 1)]
        forces.append((affected, own.world_from_body.T @ np.array([0.0, 0.0, site.gravity])))
        reported = np.linspace(time[0], time[-1], max(int(own.duration), 2))
        true = np.interp(reported, time, at)
        error = around.depth_sigma * rng.standard_normal(len(reported))
        depths.append(np.stack([reported, (1.0 + around.depth_scale) * true + error]))
        places.append(np.array([[time[0], time[-1]], [own.sensor_depth] * 2]))
        begin = float(time[-1]) + PAUSE
    wave = Waveform(
        np.concatenate([w.time for w in waves]), np.concatenate([w.measured_sensor for w in waves])
    )
    imu = site.platform.imu
    affected = np.concatenate([t for t, _ in forces])
    force = np.concatenate([np.broadcast_to(f, (len(t), 3)) for t, f in forces])
    rest = ImuSamples(
        affected,
        imu.gyro_noise * np.sqrt(5.0) * rng.standard_normal(force.shape),
        force + imu.accel_noise * np.sqrt(5.0) * rng.standard_normal(force.shape),
    )
    rotated = RotorAngles(wave.time, {beacon.name: np.mod(np.concatenate(angles), 2.0 * np.pi)})
    return Log(
        name="passes",
        epoch_ns=1_700_000_000_000_000_000,
        source="simulation",
        imu=rest,
        waveform=wave,
        rotation=rotated if encoder else None,
        depths=Depths(
            {beacon.name: np.concatenate(depths, 1), "magnetometer": np.concatenate(places, 1)}
        ),
    )


def passing_phasor(
    site: Site, shaft: Shaft, own: Pass, around: Surroundings, depth: Array
) -> ComplexArray:
    """Return the once-per-turn phasor at the sensor, world axes, shape (n, 3) (T).

    `depth` (n,): of the magnet (m).
    """
    rotor = site.beacons[0].rotor
    assert rotor is not None
    axis_world, share = own.world_from_rotor @ rotor.axis_beacon, moment_orders(rotor, shaft)[1]
    magnet_world = own.start_world + (depth - own.depth[0])[:, None] * axis_world
    moment_world = own.world_from_rotor @ share
    out = np.zeros((len(depth), 3), dtype=np.complex128)
    for along in _stack(shaft):
        offset = own.sensor_world - magnet_world - along * axis_world
        each = [dipole_field(offset, part) for part in (moment_world.real, moment_world.imag)]
        out += (each[0] + 1j * each[1]) / len(_stack(shaft))
    added = _added(site.beacons[0].frequency_hz, share, rotor, own, around, depth, _stack(shaft))
    return out if added is None else out + added


def _stack(shaft: Shaft) -> Array:
    """Return the positions of the stack's parts along the shaft (m)."""
    return np.asarray(shaft.length * (np.arange(4) - 1.5) / 4.0)


def _measured(
    site: Site,
    shaft: Shaft,
    own: Pass,
    around: Surroundings,
    angle: Array,
    depth: Array,
    rate_hz: float,
    rng: np.random.Generator,
) -> Array:
    rotor = site.beacons[0].rotor
    assert rotor is not None
    axis_world = own.world_from_rotor @ rotor.axis_beacon
    magnet_world = own.start_world + (depth - own.depth[0])[:, None] * axis_world
    moment_world = turned_moment(rotor, shaft, angle) @ own.world_from_rotor.T
    field_world = np.zeros_like(magnet_world)
    stack = _stack(shaft)
    for along in stack:
        offset = own.sensor_world - magnet_world - along * axis_world
        field_world += dipole_field(offset, moment_world / len(stack))
    for order, share in moment_orders(rotor, shaft).items():
        tone_hz = site.beacons[0].frequency_hz * order
        added = _added(tone_hz, share, rotor, own, around, depth, stack)
        if added is not None:
            field_world += np.real(added * np.exp(1j * order * angle)[:, None])
    if site.earth_field_world is not None:
        field_world += site.earth_field_world
    sensor = site.platform.magnetometer
    in_body = field_world @ own.world_from_body @ sensor.body_from_sensor
    measured = in_body @ sensor.matrix.T + sensor.offset
    noise = sensor.noise_density * np.sqrt(rate_hz / 2.0)
    return np.asarray(measured + noise * rng.standard_normal(measured.shape))


def _added(
    frequency_hz: float,
    share: ComplexArray,
    rotor: Rotor,
    own: Pass,
    around: Surroundings,
    depth: Array,
    stack: Array,
) -> ComplexArray | None:
    """Return the phasor of layers and steel at each sample, shape (n, 3) (T).

    `share` (3,): moment that alternates at the frequency, rotor axes (A m^2).
    """
    if around.layers is None and around.steel is None and not around.conductivity:
        return None
    axis_world = own.world_from_rotor @ rotor.axis_beacon
    travel = (own.sensor_world - own.start_world) @ axis_world
    nearest = float(np.linalg.norm(own.sensor_world - own.start_world - travel * axis_world))
    low, high = float(np.min(depth) + np.min(stack)), float(np.max(depth) + np.max(stack))
    count = int(np.ceil((high - low) / (NODES_APART * max(nearest, 1.0)))) + 8
    nodes = np.linspace(low, high, count)
    at_world = own.start_world + (nodes - own.depth[0])[:, None] * axis_world
    moments = own.world_from_rotor.T  # of one along each of the rotor's axes
    plain = dipole_field((own.sensor_world - at_world)[:, None], moments)
    seen = plain.astype(np.complex128)
    if around.layers is not None and frequency_hz:
        seen += _ground(frequency_hz, moments, at_world, own, around.layers)
    elif around.conductivity and frequency_hz:
        offset = own.sensor_world - at_world
        for k, moment in enumerate(moments):
            there = dipole_in_ground(offset, moment, frequency_hz, around.conductivity)
            seen[:, k] += there - plain[:, k]
    if around.steel is not None:
        points = around.steel.points_world()
        driven = dipole_field((points[:, None] - at_world)[:, :, None], moments)
        flat = driven.reshape(len(points), -1, 3), seen.reshape(-1, 3)
        seen = around.steel.seen_world(*flat, own.sensor_world, frequency_hz)
        seen = seen.reshape(plain.shape)
    out = np.einsum("k,nka->na", share, seen - plain)
    course = CubicSpline(nodes, out)
    return np.asarray(np.mean([course(depth + along) for along in stack], axis=0))


def _ground(
    frequency_hz: float, moments: Array, at_world: Array, own: Pass, layers: Layers
) -> ComplexArray:
    """Return the contribution of horizontal layers for a magnet at positions, shape (n, 3, 3)."""
    middle = at_world[len(at_world) // 2]
    seen_from = own.sensor_world + middle - at_world
    seen_from[:, 2] = own.sensor_world[2]  # layers are level; how it climbs changes little of it
    return np.stack(
        [layered_effect_at(middle, m, frequency_hz, seen_from, layers) for m in moments], axis=1
    )
