"""Simulated logs of a hand-held sensor in the Earth's field alone, and what disturbs it indoors.

Motions are turning, shaking to and fro (a hand that carries, with little turning), and both; slow
and fast; at a stretch or with pauses.  The building's iron is dipoles far off, a magnet near the
path is one near, and one on the sensor is a constant of its axes, from the beginning or from some
time on.  The sensors err by what their site declares, or by a share of it, as those do whose maker
is careful: rates are means over the step that ends at a stamp, the magnetometer lags, its samples
repeat.  Nothing here knows the estimator.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import (
    EarthModel,
    ImuModel,
    Magnetometer,
    MagnetometerSigma,
    Platform,
    Site,
)
from magfusion.model.trajectory import Trajectory
from magfusion.units import DEGREE, Array

EARTH_WORLD = np.array([0.0, 1.64e-5, -4.14e-5])  # T
GRAVITY = 9.8  # m/s^2
RATE = 100.0  # Hz
REST = 6.0  # s; before it moves
LIFTED = 0.4  # m; above the table that it rests on first
REPEATED = 0.3  # of the magnetometer's samples
IMU = ImuModel(2e-3, 2e-2, 1e-5, 1e-3, 1e-2, 0.1)


@dataclass(frozen=True)
class Kind:
    """How a sensor is moved, and what is near.

    Parameters
    ----------
    turning : float
        Usual rate of turning about any axis, all round (rad/s, each component).
    wobble : float
        Usual angle of turning to and fro (rad, each component).
    shaking : float
        Usual acceleration by carrying (m/s^2, each component).
    hertz : float
        Of turning and carrying, about.
    pauses : bool
        Whether it rests now and then.
    magnet : {'none', 'near', 'attached', 'from the start'}
    late : float
        Most that the magnetometer lags (s).
    rest : float
        Before it moves (s).
    lifted : bool
        Whether it rests on a table with iron in it first, and is moved above it.
    iron : (float, float)
        Distances of the building's iron (m).
    walk : float
        Usual speed of who carries it, to and fro (m/s, each horizontal component).
    axes : (float, float, float)
        Share of the turning about each axis of the body.
    visits : int
        Times that something magnetic is brought near and taken away.
    repeated : float
        Of the magnetometer's samples.
    imu, imu_errors : ImuModel
        As declared, and of which the share is usual.
    """

    turning: float = 0.0
    wobble: float = 0.0
    shaking: float = 0.0
    hertz: float = 0.5
    pauses: bool = False
    magnet: str = "none"
    late: float = 0.005
    rest: float = REST
    lifted: bool = False
    iron: tuple[float, float] = (1.2, 3.0)
    walk: float = 0.0
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0)
    visits: int = 0
    repeated: float = REPEATED
    imu: ImuModel = IMU
    imu_errors: ImuModel = IMU


KINDS = {
    "slow turning": Kind(turning=0.7, shaking=0.3, hertz=0.4),
    "fast turning": Kind(turning=4.0, shaking=2.0, hertz=1.2),
    "slow carrying": Kind(wobble=0.06, shaking=1.0, hertz=0.35),
    "fast carrying": Kind(wobble=0.08, shaking=8.0, hertz=0.9),
    "fast carrying, pauses": Kind(wobble=0.08, shaking=8.0, hertz=0.9, pauses=True),
    "both, pauses": Kind(turning=2.0, shaking=3.0, hertz=0.8, pauses=True),
    "magnet near path": Kind(turning=0.8, shaking=1.0, hertz=0.3, magnet="near"),
    "magnet attached": Kind(turning=1.5, shaking=1.5, hertz=0.6, magnet="attached"),
    "magnet from the start": Kind(turning=1.5, shaking=1.5, hertz=0.6, magnet="from the start"),
    "violent carrying": Kind(
        wobble=0.08,
        shaking=20.0,
        hertz=1.5,
        late=0.015,
        rest=15.0,
        lifted=True,
        iron=(0.7, 1.4),
    ),
    "turning, lifted": Kind(
        turning=3.0,
        shaking=4.0,
        hertz=0.8,
        pauses=True,
        late=0.015,
        rest=15.0,
        lifted=True,
        iron=(0.7, 1.4),
    ),
    "walking": Kind(wobble=0.08, shaking=1.5, hertz=0.9, iron=(6.0, 12.0), walk=1.0),
}


def site_as_declared(
    offset_sigma: float = 2e-6, matrix_sigma: float = 0.02, imu: ImuModel = IMU
) -> Site:
    """Return a site as a careful user would write it (offset in T)."""
    sigma = MagnetometerSigma(
        np.full((3, 3), matrix_sigma), np.full(3, offset_sigma), np.zeros(3), np.zeros(3)
    )
    sensor = Magnetometer(
        position_body=np.zeros(3),
        body_from_sensor=np.eye(3),
        noise_density=5e-8,
        matrix=np.eye(3),
        offset=np.zeros(3),
        sigma=sigma,
    )
    return Site(
        gravity=GRAVITY,
        model_error=0.005,
        beacons=(),
        platform=Platform(imu, sensor),
        earth_field_world=EARTH_WORLD,
        earth=EarthModel(),
    )


def simulated(
    name: str, seed: int, duration: float = 45.0, rate: float = RATE, share: float = 0.3
) -> tuple[Log, Site]:
    """Return a log and its site.

    Parameters
    ----------
    name : str
        One of `KINDS`.
    share : float
        Of what the site declares: usual errors of the instruments.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    return simulated_kind(KINDS[name], rng, duration, rate, share, f"{name} x{share:g} {seed}")


def simulated_kind(
    kind: Kind, rng: np.random.Generator, duration: float, rate: float, share: float, name: str
) -> tuple[Log, Site]:
    """Return a log of a kind, and its site."""
    time = np.arange(0.0, duration, 1.0 / rate)
    truth, place = _motion(kind, rng, time)
    world = EARTH_WORLD + _building(rng, place, share, kind.iron)
    if kind.lifted:
        world += _table(rng, place)
    for _ in range(kind.visits):
        world += _visit(rng, time, place)
    body = np.tile(2e-6 * share * rng.normal(size=3), (len(time), 1))
    if kind.magnet == "near":
        world += _magnet_near(rng, place)
    elif kind.magnet != "none":
        begun = 0.0 if kind.magnet == "from the start" else 0.4 * duration
        body[time >= begun] += _some_way(rng) * rng.uniform(5e-6, 30e-6)
    site = site_as_declared(imu=kind.imu)
    imu = _inertial(rng, time, truth, place, share, kind.imu_errors)
    wave = _field(rng, time, truth, world, body, share, kind)
    poses = Trajectory(time, truth.as_matrix(), place)
    return Log(name, 0, "simulated", imu, wave, truth=poses), site


def _some_way(rng: np.random.Generator) -> Array:
    way = rng.normal(size=3)
    return np.asarray(way / np.linalg.norm(way))


def _wave(rng: np.random.Generator, time: Array, hertz: float) -> Array:
    """Return a band-limited motion of unit variance, shape (n, 3)."""
    out = np.zeros((len(time), 3))
    for frequency in hertz * rng.uniform(0.4, 1.4, size=16):
        phase = rng.uniform(0.0, 2.0 * np.pi, size=3)
        out += rng.normal(size=3) * np.sin(2.0 * np.pi * frequency * time[:, None] + phase)
    return out / np.sqrt(8.0)


def _activity(kind: Kind, rng: np.random.Generator, time: Array) -> Array:
    """Return how much of the motion takes place: 0 at rest, 1 in motion, shape (n, 1)."""
    edges, now = [kind.rest], kind.rest
    while kind.pauses and now < time[-1]:
        moves, rests = rng.uniform(6.0, 12.0), rng.uniform(3.0, 6.0)
        edges += [now + moves, now + moves + rests]
        now += moves + rests
    active = np.zeros(len(time))
    for k, edge in enumerate(edges):
        ramp = np.clip((time - edge) / 1.5, 0.0, 1.0)
        active += (-1.0) ** k * ramp**2 * (3.0 - 2.0 * ramp)
    return active[:, None]


def _motion(kind: Kind, rng: np.random.Generator, time: Array) -> tuple[Rotation, Array]:
    active = _activity(kind, rng, time)
    step = time[1] - time[0]
    spin = kind.turning * np.array(kind.axes) * _wave(rng, time, kind.hertz) * active
    turns = [Rotation.from_rotvec([*rng.uniform(-0.5, 0.5, size=2), rng.uniform(-3.0, 3.0)])]
    if kind.turning > 0.0:
        for turn in Rotation.from_rotvec(spin[1:] * step):
            turns.append(turns[-1] * turn)
        truth = Rotation.concatenate(turns)
    else:
        angle = np.cumsum(_wave(rng, time, kind.hertz) * active, axis=0) * step
        truth = turns[0] * Rotation.from_rotvec(kind.wobble * angle * 2.0 * np.pi * kind.hertz)
    push = _wave(rng, time, kind.hertz) / (2.0 * np.pi * kind.hertz) ** 2
    lever = 0.1 * rng.normal(size=3)
    propagated = kind.shaking * push * active
    # A hand swings about an elbow or a shoulder: what is carried to a side turns with it.
    arm = rng.uniform(0.4, 0.8) * _some_way(rng)
    truth = Rotation.from_rotvec(np.cross(arm, propagated) / (arm @ arm)) * truth
    place = propagated + truth.apply(lever)
    if kind.lifted:
        up = np.clip((time - kind.rest + 2.0) / 2.0, 0.0, 1.0)
        place[:, 2] += LIFTED * up**3 * (10.0 - 15.0 * up + 6.0 * up**2)
    if kind.walk > 0.0:
        place[:, :2] += np.cumsum(kind.walk * _wave(rng, time, 0.1) * active, axis=0)[:, :2] * step
    return truth, np.asarray(place - place[0])


def _dipole(offset: Array, moment: Array) -> Array:
    """Return the field (T) of a dipole (A m^2) at places so far from it, shape (n, 3)."""
    far = np.linalg.norm(offset, axis=1)[:, None]
    along = offset @ moment
    return np.asarray(1e-7 * (3.0 * along[:, None] * offset / far**5 - moment / far**3))


def _building(
    rng: np.random.Generator, place: Array, share: float, away: tuple[float, float]
) -> Array:
    """Return what iron far off adds: much the same everywhere, a little more here than there."""
    added, strength = np.zeros_like(place), np.exp(rng.uniform(np.log(1.5e-7), np.log(8e-7)))
    for far in rng.uniform(*away, size=4):
        moment = _some_way(rng) * strength * far**3 / 1e-7
        added += _dipole(place - far * _some_way(rng), moment)
    usual = np.mean(added, axis=0)
    # The user turned the world's axes to the field of the room, within the declination.
    east = 0.5 * DEGREE * EARTH_WORLD[1] * rng.normal() * max(share, 0.5)
    return np.asarray(added - np.array([usual[0] - east, 0.0, 0.0]))


def _magnet_near(rng: np.random.Generator, place: Array) -> Array:
    """Return the field of a magnet near the path: tens of microteslas where it is closest."""
    away = place[int(np.argmax(np.linalg.norm(place, axis=1)))]
    centre = away + rng.uniform(0.1, 0.2) * _some_way(rng)
    if np.linalg.norm(centre) < np.linalg.norm(away):  # it begins far from it
        centre = 2.0 * away - centre
    result = _dipole(place - centre, _some_way(rng))
    return np.asarray(result * rng.uniform(1e-5, 4e-5) / np.max(np.linalg.norm(result, axis=1)))


def _visit(rng: np.random.Generator, time: Array, place: Array) -> Array:
    """Return the field of something magnetic that is near for some seconds."""
    begin, length = rng.uniform(0.1 * time[-1], 0.9 * time[-1]), rng.uniform(3.0, 20.0)
    near = np.clip(np.minimum(time - begin, begin + length - time) / 1.0, 0.0, 1.0)[:, None]
    centre = place[np.searchsorted(time, begin)] + rng.uniform(0.2, 0.6) * _some_way(rng)
    offset = place - centre
    # It is in no one's way: what is carried passes it at a distance of at least 0.1 m.
    far = np.linalg.norm(offset, axis=1)[:, None]
    offset *= np.maximum(1.0, 0.1 / np.maximum(far, 1e-3))
    result = near * _dipole(offset, _some_way(rng))
    return np.asarray(result * rng.uniform(5e-6, 4e-5) / np.max(np.linalg.norm(result, axis=1)))


def _table(rng: np.random.Generator, place: Array) -> Array:
    """Return what iron in a table adds: microteslas on it, little above it."""
    below = np.array([*rng.uniform(-0.15, 0.15, size=2), -rng.uniform(0.15, 0.35)])
    result = _dipole(place - below, _some_way(rng))
    return np.asarray(result * rng.uniform(1e-6, 3e-6) / np.linalg.norm(result[0]))


def _inertial(
    rng: np.random.Generator,
    time: Array,
    truth: Rotation,
    place: Array,
    share: float,
    imu: ImuModel,
) -> ImuSamples:
    rate = 1.0 / (time[1] - time[0])
    spin = (truth[:-1].inv() * truth[1:]).as_rotvec() * rate
    gyro = np.concatenate([spin[:1], spin])
    push = np.gradient(np.gradient(place, time, axis=0), time, axis=0)
    force = truth.inv().apply(push + np.array([0.0, 0.0, GRAVITY]))
    gyro = gyro @ (np.eye(3) + 3e-3 * rng.normal(size=(3, 3))).T
    gyro += 2e-4 * share * force @ rng.normal(size=(3, 3))  # by the force
    gyro += imu.gyro_bias_sigma * share * rng.normal(size=3)
    walk = imu.gyro_bias_walk / np.sqrt(rate) * rng.normal(size=gyro.shape)
    gyro += np.cumsum(walk, axis=0)
    gyro += share * imu.gyro_noise * np.sqrt(rate / 2.0) * rng.normal(size=gyro.shape)
    force = force @ (np.eye(3) + 3e-3 * share * rng.normal(size=(3, 3))).T
    force += imu.accel_bias_sigma * share * rng.normal(size=3)
    force += share * imu.accel_noise * np.sqrt(rate / 2.0) * rng.normal(size=force.shape)
    return ImuSamples(time, gyro, force)


def _field(
    rng: np.random.Generator,
    time: Array,
    truth: Rotation,
    world: Array,
    body: Array,
    share: float,
    kind: Kind,
) -> Waveform:
    matrix = np.eye(3) + 0.02 * share * rng.normal(size=(3, 3))
    field = truth.inv().apply(world) @ matrix.T + body
    late = rng.uniform(0.0, kind.late)
    field = np.stack([np.interp(time - late, time, c) for c in field.T], axis=1)
    field += 4e-7 * rng.normal(size=field.shape)
    shown = np.arange(len(time))
    again = np.flatnonzero(rng.random(len(time) - 1) < kind.repeated) + 1
    shown[again] = again - 1
    return Waveform(time, field[shown])
