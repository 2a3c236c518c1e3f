"""Phasors and inertial samples of a walk as they arrive, for tests of what navigates online."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.results.errors import TrajectoryErrors, trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import Rests, SimulatedMotion, random_walk_motion

SIGMA = 1e-9  # T
WINDOW = 0.4  # s


def surveyed_site() -> Site:
    """Return a site that is known exactly, so that a covariance can be right."""
    site = replace(demo_site(coil_radius=None), model_error=1e-5)
    none = np.zeros(3)
    known = BeaconSigma(none, none, np.zeros(2))
    sensor = replace(
        site.platform.magnetometer, sigma=MagnetometerSigma(np.zeros((3, 3)), none, none, none)
    )
    imu = replace(site.platform.imu, time_offset_sigma=0.0)
    return replace(
        site,
        beacons=tuple(replace(beacon, sigma=known) for beacon in site.beacons),
        platform=replace(site.platform, imu=imu, magnetometer=sensor),
    )


@dataclass(frozen=True, eq=False)
class OnlineLog:
    """Samples with the motion that they are of."""

    site: Site
    imu: ImuSamples
    fields: FieldSamples
    motion: SimulatedMotion

    def errors(self, states: list[State]) -> TrajectoryErrors:
        truth = self.motion.trajectory(np.array([s.time for s in states]))
        return trajectory_errors(as_trajectory(states), truth)


def online_log(
    seed: int,
    duration: float,
    rests: Rests | None = None,
    rate_hz: float = 50.0,
    every: float = 0.5,
) -> OnlineLog:
    """Return a walk among four beacons, with phasors every so many seconds."""
    rng, site = np.random.default_rng(seed), surveyed_site()
    motion = random_walk_motion(rng, duration, DEMO_BOX_WORLD, rests=rests or Rests(5.0, 20.0, 3.0))
    imu = simulate_imu(motion, site.platform.imu, site.gravity, rate_hz, duration, rng).samples
    at = motion.trajectory(np.arange(0.25, duration - 0.25, every))
    return OnlineLog(site, imu, simulate_fields(site, at, SIGMA, rng, window=WINDOW), motion)


def epoch(fields: FieldSamples, k: int) -> FieldSamples:
    """Return one epoch of phasors."""
    row = slice(k, k + 1)
    return FieldSamples(
        fields.time[row],
        fields.window[row],
        fields.channels,
        fields.phasor_sensor[row],
        fields.phasor_cov[row],
    )


def silent(fields: FieldSamples, channels: list[int], begin: float, end: float) -> FieldSamples:
    """Return phasors of which some channels are missing for a while."""
    phasor, cov = fields.phasor_sensor.copy(), fields.phasor_cov.copy()
    rows = np.flatnonzero((fields.time > begin) & (fields.time < end))
    phasor[np.ix_(rows, channels)], cov[np.ix_(rows, channels)] = np.nan, np.nan
    return replace(fields, phasor_sensor=phasor, phasor_cov=cov)


def spoiled(
    fields: FieldSamples, share: float, begin: float, end: float, seed: int = 9
) -> tuple[FieldSamples, int]:
    """Return phasors with outliers of a microtesla in some of their channels, and how many."""
    rng, phasor = np.random.default_rng(seed), fields.phasor_sensor.copy()
    during = (fields.time > begin) & (fields.time < end)
    hit = (rng.random(phasor.shape[:2]) < share) & during[:, None]
    noise = rng.standard_normal((2, int(hit.sum()), 3))
    phasor[hit] += 1e-6 * (noise[0] + 1j * noise[1])
    detected = hit & np.isfinite(fields.phasor_sensor).all(axis=2)
    return replace(fields, phasor_sensor=phasor), int(detected.sum())


def without_imu(imu: ImuSamples, begin: float, end: float) -> ImuSamples:
    """Return the stream with a gap."""
    kept = (imu.time < begin) | (imu.time > end)
    return ImuSamples(imu.time[kept], imu.gyro_body[kept], imu.accel_body[kept])


def navigate(
    log: OnlineLog,
    settings: NavigatorSettings,
    late: float = 0.0,
    chunk: float = 0.25,
    watch: Callable[[Navigator, float], None] | None = None,
) -> tuple[Navigator, list[State]]:
    """Feed a log as it arrives, its fields late by so much; return the states as they were made."""
    navigator, imu, fields = Navigator(log.site, settings), log.imu, log.fields
    states: list[State] = []
    arrival = fields.time + WINDOW / 2.0 + late
    edges = np.arange(0.0, imu.time[-1] + chunk, chunk)
    for begin, end in pairwise(edges):
        own = slice(*np.searchsorted(imu.time, [begin, end]))
        navigator.add_imu(imu.time[own], imu.gyro_body[own], imu.accel_body[own])
        for k in range(*np.searchsorted(arrival, [begin, end])):
            navigator.add_fields(epoch(fields, k))
        states += navigator.take()
        if watch is not None:
            watch(navigator, float(end))
    return navigator, states
