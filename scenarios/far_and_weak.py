"""Beacons heard after minutes or hours at rest, far below the noise: what integration is worth.

A receiver rests 300 m from four beacons, through rock, and samples at 100 Hz.  Their fields are 10
to 30 dB below the noise of a single sample.  ``--at-rest`` makes one epoch of the rest.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.at_rest import AtRest
from magfusion.model.ground import in_ground
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, BeaconSigma, Coil, Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.atmosphere import Atmosphere
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.disturbance import Ambient
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import (
    EPOCH_NS,
    Reference,
    SimulatedLog,
    SimulationConfig,
    draw_drives,
    simulate_fields,
    simulate_log,
)
from magfusion.simulation.motion import static_motion
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import Array

DISTANCE = 300.0  # m, of each beacon from the middle
DIRECTIONS = np.array([[1.0, 0.9, 0.4], [-0.9, 1.0, -0.5], [-1.0, -0.8, 0.6], [0.8, -1.0, -0.3]])
FREQUENCIES_HZ = (21.0, 24.0, 27.0, 31.0)
RATE_HZ, IMU_RATE_HZ = 100.0, 25.0
CONDUCTIVITY = 0.01  # S/m
NOISE_DENSITY = 1e-11  # T/sqrt(Hz)
NOTHING = 1e-30  # T
SILENT = 1e-9  # of a moment: nothing


def far_site(
    moment: float = 2e3, noise_density: float = NOISE_DENSITY, *, synchronised: bool = True
) -> Site:
    """Return four rotating beacons about a middle that is the origin.

    Parameters
    ----------
    moment : float
        (A m^2)
    noise_density : float
        (T/sqrt(Hz))
    """
    plain = demo_site()
    away = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    turns = Rotation.random(len(away), random_state=7).as_matrix()
    coils = tuple(
        Coil(moment * axis, phase)
        for axis, phase in zip(np.eye(3)[:2], (0.0, -np.pi / 2.0), strict=True)
    )
    surveyed = BeaconSigma(np.full(3, 0.03), np.full(3, 3e-4), np.full(2, 5e-4))
    beacons = tuple(
        Beacon(
            name="ABCD"[k],
            position_world=DISTANCE * away[k],
            world_from_beacon=turns[k],
            frequency_hz=FREQUENCIES_HZ[k],
            coils=coils,
            synchronised=synchronised,
            sigma=surveyed,
        )
        for k in range(len(away))
    )
    sensor = plain.platform.magnetometer
    exact = replace(sensor.sigma, matrix=np.full((3, 3), 2e-4))
    sensor = replace(sensor, noise_density=noise_density, sigma=exact)
    platform = replace(plain.platform, magnetometer=sensor)
    return in_ground(
        replace(plain, beacons=beacons, platform=platform, model_error=1e-3), CONDUCTIVITY
    )


def noise_log(site: Site, duration: float, seed: int, *, heard: bool = False) -> Log:
    """Return a log of a receiver at rest: of noise alone, or with the beacons.

    Parameters
    ----------
    site : Site
        The true one.
    duration : float
        (s)
    """
    rng = np.random.default_rng(seed)
    place = rng.uniform(-20.0, 20.0, 3)
    motion = static_motion(place, Rotation.from_rotvec(rng.normal(0.0, 0.3, 3)))
    silent = tuple(
        replace(b, coils=tuple(replace(c, moment_beacon=SILENT * c.moment_beacon) for c in b.coils))
        for b in site.beacons
    )
    sending = site if heard else replace(site, beacons=silent)
    drives = draw_drives(site, rng)
    imu = simulate_imu(motion, site.platform.imu, site.gravity, IMU_RATE_HZ, duration, rng)
    waveform = simulate_waveform(motion, sending, drives, RATE_HZ, duration, rng)
    truth = motion.trajectory(imu.samples.time)
    return Log("far_and_weak", EPOCH_NS, "simulation", imu.samples, waveform, truth=truth)


def witnessed_log(
    site: Site,
    duration: float,
    seed: int,
    place_world: Array,
    storms: float,
    late: float = 0.0,
    rate: float = 0.0,
) -> SimulatedLog:
    """Return a log at rest with storms that a second magnetometer hears, too.

    Parameters
    ----------
    place_world : ndarray, shape (3,)
        Of the second magnetometer (m).
    storms : float
        Density at 1 Hz (T/sqrt(Hz)).
    late, rate : float
        Of its clock (s).
    """
    turned = Rotation.random(random_state=seed).as_matrix()
    config = SimulationConfig(
        box_world=np.array([[-20.0, -20.0, -10.0], [20.0, 20.0, 10.0]]),
        duration=duration,
        motion="static",
        imu_rate_hz=IMU_RATE_HZ,
        magnetometer_rate_hz=RATE_HZ,
        perturb=False,
        ambient=Ambient(atmosphere=Atmosphere(storms, seed, duration, 0.5 * RATE_HZ)),
        reference=Reference(place_world, turned, late, rate),
    )
    known = replace(site, reference_world=place_world)
    return simulate_log(known, config, np.random.default_rng(seed))


def errors_in_sigmas(rested: AtRest, made: SimulatedLog) -> Array:
    """Return the square of each phasor's error in its sigmas, shape (n, channels); six are due."""
    truth, time = made.log.truth, rested.fields.time
    assert truth is not None
    pose = np.repeat(truth.world_from_body[:1], len(time), 0), truth.position_world[:1]
    there = Trajectory(time, pose[0], np.repeat(pose[1], len(time), 0))
    none = np.random.default_rng(0)
    true = simulate_fields(made.true_site, there, NOTHING, none, made.drives).phasor_sensor
    error = rested.fields.phasor_sensor - true
    solved = np.linalg.solve(rested.fields.phasor_cov, error[..., None])[..., 0]
    return np.asarray(np.real(np.sum(np.conj(error) * solved, axis=-1)))
