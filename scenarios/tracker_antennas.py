"""Trackers' antennas with errors, their bench and their surveys: what `tracker_table1` draws.

Coils have their true size: the couplings are Neumann's double integral over the wires, the bench
reads the field of the wire by Biot and Savart.  The estimators have dipoles, and one further term.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from tracker_bench import bench_points
from tracker_poses import refine_poses

from magfusion.calibration.antenna import AntennaSurvey, prior_sigma
from magfusion.model.antenna import Antenna
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.physics.finite_size import disc_kappa
from magfusion.papers.p000_tracker.equations import eq_09_whitened
from magfusion.papers.p000_tracker.pose import locate_by_svd
from magfusion.units import DEGREE, MU0_OVER_4PI, Array

NODES = 12  # of a wire; the sum converges by a power of size over distance for each


@dataclass(frozen=True)
class Errors:
    """Errors of the coils of both antennas, one sigma."""

    gain: float = 0.0
    tilt_deg: float = 0.0  # about each of two axes
    centre: float = 0.0  # m, each coil and component
    common_centre: float = 0.0  # m, each component
    mount_deg: float = 0.0  # about each axis, the antenna as a whole


@dataclass(frozen=True)
class Config:
    """Which antennas, how measured, and how calibrated."""

    errors: Errors = Errors(gain=0.005, tilt_deg=0.12, centre=0.5e-3)
    snr_db: float = 60.0
    antennas: int = 200
    poses: int = 40
    pose_deg: float = 0.02  # error of the poses of the joint fit
    pose_m: float = 0.1e-3
    bench_distance: float = 0.3  # m
    bench_position: float = 50e-6  # m
    bench_tilt_deg: float = 0.02
    transmitter: float = 0.0  # m, diameter of its coils; both zero for dipoles
    receiver: float = 0.0
    seed: int = 0

    @property
    def is_sized(self) -> bool:
        """Whether the coils have a size."""
        return self.transmitter > 0.0


def nominal(shape: tuple[int, ...] = (), *, sized: bool = False) -> Antenna:
    """Return ideal antennas: unit moments and sensitivities along the axes, one centre.

    Of dipoles, or with the term of a size, which is not known yet.
    """
    eye, zero = np.broadcast_to(np.eye(3), (*shape, 3, 3)), np.zeros((*shape, 3, 3))
    kappas = (np.zeros((*shape, 3)), np.zeros(shape)) if sized else ()
    return Antenna(eye, zero, eye, zero, *kappas)


def with_kappas(antenna: Antenna, config: Config) -> Antenna:
    """Return antennas with the term of the coils' true size."""
    if not config.is_sized:
        return antenna
    shape = antenna.moments_beacon.shape[:-2]
    return replace(
        antenna,
        kappa_beacon=np.full((*shape, 3), disc_kappa(0.5 * config.transmitter)),
        kappa_sensor=np.full(shape, disc_kappa(0.5 * config.receiver)),
    )


def wires(coil: Array, centre: Array, diameter: float) -> tuple[Array, Array]:
    """Return points and line elements (..., nodes, 3) of circular coils, elements of unit area.

    Parameters
    ----------
    coil, centre : ndarray, shape (..., 3)
        Moment or sensitivity along the axis, and where it is (m).
    """
    size = np.linalg.norm(coil, axis=-1, keepdims=True)
    axis = coil / size
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis), axis=-1)])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    angle = (2.0 * np.pi / NODES * np.arange(NODES))[:, None]
    first, second = across[..., None, :], np.cross(axis, across)[..., None, :]
    outward = np.cos(angle) * first + np.sin(angle) * second
    along = np.cos(angle) * second - np.sin(angle) * first
    # Current over area, times the wire's length: 4 |m| / (pi d^2) pi d.
    step = 4.0 * size[..., None, :] / (diameter * NODES)
    return centre[..., None, :] + 0.5 * diameter * outward, step * along


def rotated(angle: Array) -> Array:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3) (rad)."""
    matrix = Rotation.from_rotvec(angle.reshape(-1, 3)).as_matrix()
    return np.asarray(matrix.reshape(*angle.shape, 3))


def draw_antennas(errors: Errors, number: int, rng: np.random.Generator) -> Antenna:
    """Return antennas with errors, leading axis (number,)."""

    def coils() -> tuple[Array, Array]:
        size = 1.0 + errors.gain * rng.standard_normal((number, 3, 1))
        across = errors.tilt_deg * DEGREE * rng.standard_normal((number, 3, 3)) * (1 - np.eye(3))
        axis = np.eye(3) + across
        axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        mount = rotated(errors.mount_deg * DEGREE * rng.standard_normal((number, 3)))
        common = errors.common_centre * rng.standard_normal((number, 1, 3))
        centre = common + errors.centre * rng.standard_normal((number, 3, 3))
        back = np.swapaxes(mount, -1, -2)
        return size * axis @ back, centre @ back

    return Antenna(*coils(), *coils())


def couplings(
    antenna: Antenna, beacon_from_sensor: Array, position_beacon: Array, config: Config
) -> Array:
    """Return what coils of true size sense (T), without the estimators' model."""
    if not config.is_sized:
        return _of_dipoles(antenna, beacon_from_sensor, position_beacon)
    turn = np.swapaxes(beacon_from_sensor, -1, -2)
    place = position_beacon[..., None, :] + antenna.centres_sensor @ turn
    sent = wires(antenna.moments_beacon, antenna.centres_beacon, config.transmitter)
    seen = wires(antenna.sensitivities_sensor @ turn, place, config.receiver)
    lead = np.broadcast_shapes(place.shape[:-2], antenna.moments_beacon.shape[:-2])
    out = np.empty((*lead, 3, 3))
    for i, j in np.ndindex(3, 3):
        there, there_along = seen[0][..., i, :, :], seen[1][..., i, :, :]
        here, here_along = sent[0][..., j, :, :], sent[1][..., j, :, :]
        separate = np.linalg.norm(there[..., :, None, :] - here[..., None, :, :], axis=-1)
        both = np.einsum("...ax,...bx->...ab", there_along, here_along)
        out[..., i, j] = MU0_OVER_4PI * np.sum(both / separate, axis=(-1, -2))
    return out


def _of_dipoles(antenna: Antenna, beacon_from_sensor: Array, position_beacon: Array) -> Array:
    turn = np.swapaxes(beacon_from_sensor, -1, -2)
    place = position_beacon[..., None, :] + antenna.centres_sensor @ turn
    offset = place[..., :, None, :] - antenna.centres_beacon[..., None, :, :]
    field = dipole_field(offset, antenna.moments_beacon[..., None, :, :])
    in_sensor = field @ beacon_from_sensor[..., None, :, :]
    return np.asarray(np.einsum("...ia,...ija->...ij", antenna.sensitivities_sensor, in_sensor))


def noise_sigma(snr_db: float, distance: Array) -> Array:
    """Return the noise of a coupling (T) at a distance (m), relative to ``K / R^3``."""
    return np.asarray(10.0 ** (-snr_db / 20.0) * MU0_OVER_4PI / distance**3)


def bench_readings(
    coils: Array, centres: Array, diameter: float, config: Config, rng: np.random.Generator
) -> Array:
    """Return the probe's readings of antennas at six points, with the errors of the bench (T)."""
    points = bench_points(config.bench_distance)
    shape = (len(coils), 3, *points.shape)
    place = points + config.bench_position * rng.standard_normal(shape)
    if diameter:
        wire, along = (part[:, :, None, None] for part in wires(coils, centres, diameter))
        separate = place[..., None, :] - wire
        cubed = np.linalg.norm(separate, axis=-1, keepdims=True) ** 3
        field = MU0_OVER_4PI * np.sum(np.cross(along, separate) / cubed, axis=-2)
    else:
        offset = place - centres[:, :, None, None, :]
        field = dipole_field(offset, coils[:, :, None, None, :])
    tilt = rotated(config.bench_tilt_deg * DEGREE * rng.standard_normal(shape))
    sigma = noise_sigma(config.snr_db, np.array(config.bench_distance))
    return np.asarray((tilt @ field[..., None])[..., 0] + sigma * rng.standard_normal(shape))


def random_poses(
    shape: tuple[int, ...], rng: np.random.Generator, nearest: float = 0.3, farthest: float = 0.6
) -> tuple[Array, Array]:
    """Return attitudes and positions all around the beacon."""
    attitude = Rotation.random(int(np.prod(shape)), rng=rng).as_matrix().reshape(*shape, 3, 3)
    direction = rng.standard_normal((*shape, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return attitude, direction * rng.uniform(nearest, farthest, (*shape, 1))


def draw_survey(antenna: Antenna, config: Config, rng: np.random.Generator) -> AntennaSurvey:
    """Return surveys of all antennas, whose stated poses have the configured errors."""
    shape = (len(antenna.moments_beacon), config.poses)
    attitude, position = random_poses(shape, rng)
    sigma = noise_sigma(config.snr_db, np.linalg.norm(position, axis=-1))
    seen = couplings(antenna.at(np.s_[:, None]), attitude, position, config)
    noise = sigma[..., None, None] * rng.standard_normal(seen.shape)
    off = rotated(config.pose_deg * DEGREE * rng.standard_normal((*shape, 3)))
    moved = position + config.pose_m * rng.standard_normal((*shape, 3))
    return AntennaSurvey(attitude @ off, moved, seen + noise, sigma)


def usual_prior(errors: Errors, *, sized: bool = False) -> Array:
    """Return the prior of the joint fits: four times the errors that the antennas have."""
    mount, start = errors.mount_deg, nominal(sized=sized)
    return prior_sigma(
        start,
        gain=4.0 * errors.gain,
        tilt=4.0 * float(np.hypot(errors.tilt_deg, mount)) * DEGREE,
        centre=4.0 * float(np.hypot(errors.centre, errors.common_centre)),
    )[: start.vector().shape[-1]]


def locate(antenna: Antenna, seen: Array, guess_beacon: Array) -> tuple[Array, Array]:
    """Return poses by closed form and maximum likelihood with an antenna (n,), couplings (n, m)."""
    wide = antenna.at(np.s_[:, None])
    transmitter = np.swapaxes(wide.moments_beacon, -1, -2)
    free_parameters = eq_09_whitened(seen, np.linalg.inv(wide.sensitivities_sensor), transmitter)
    start = locate_by_svd(free_parameters).nearest(guess_beacon)
    attitude = np.swapaxes(start.sensor_from_beacon, -1, -2)
    return refine_poses(wide, seen, attitude, start.position_beacon[..., 0, :])
