"""Beacons far below the noise, after an hour at rest: integration and a reference magnetometer.

A receiver rests 300 m from four beacons, through rock, and samples at 100 Hz.  Their fields are 14
to 30 dB below the noise of a single sample.  ``--at-rest`` makes one epoch of the rest.

1. An hour: errors of phasors against the bound of Cramer and Rao, the NEES of phasors and of the
   pose, with beacons on the log's clock and with clocks of their own.
2. Noise alone: how often it is taken for a beacon, where one in a hundred is the required rate.
3. Storms that fall with the root of the frequency, 40 dB above the instrument at 1 Hz, with a
   second magnetometer whose clock is late and runs otherwise; one that receives other storms, and
   one next to a beacon.
"""

from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.estimation.demodulation.demodulation import first_fixes
from magfusion.estimation.rests.stationary_integration import IntegratedRests, integrate_rests
from magfusion.model.ground import in_ground
from magfusion.model.parameters import initial_calibration
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
from magfusion.units import Array, ComplexArray

DISTANCE = 300.0  # m, of each beacon from the middle
DIRECTIONS = np.array([[1.0, 0.9, 0.4], [-0.9, 1.0, -0.5], [-1.0, -0.8, 0.6], [0.8, -1.0, -0.3]])
FREQUENCIES_HZ = (21.0, 24.0, 27.0, 31.0)
RATE_HZ, IMU_RATE_HZ = 100.0, 25.0
CONDUCTIVITY = 0.01  # S/m
NOISE_DENSITY = 1e-11  # T/sqrt(Hz)
FAR_AWAY = np.array([5e3, 0.0, 0.0])  # m
STORMS = 1e-9  # T/sqrt(Hz) at 1 Hz
LATE, RATE = 0.137, 2e-5  # s, and as a share: the clock of the second magnetometer
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


def noise_log(site: Site, duration: float, seed: int, *, detected: bool = False) -> Log:
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
    active_beacons = site if detected else replace(site, beacons=silent)
    drives = draw_drives(site, rng)
    imu = simulate_imu(motion, site.platform.imu, site.gravity, IMU_RATE_HZ, duration, rng)
    waveform = simulate_waveform(motion, active_beacons, drives, RATE_HZ, duration, rng)
    truth = motion.trajectory(imu.samples.time)
    return Log("far_and_weak", EPOCH_NS, "simulation", imu.samples, waveform, truth=truth)


def monitored_log(
    site: Site,
    duration: float,
    seed: int,
    place_world: Array,
    storms: float,
    late: float = 0.0,
    rate: float = 0.0,
) -> SimulatedLog:
    """Return a log at rest with storms that a second magnetometer receives, too.

    Parameters
    ----------
    place_world : ndarray, shape (3,)
        Of the second magnetometer (m).
    storms : float
        Density at 1 Hz (T/sqrt(Hz)).
    late, rate : float
        Of its clock (s).
    """
    rotated = Rotation.random(random_state=seed).as_matrix()
    config = SimulationConfig(
        box_world=np.array([[-20.0, -20.0, -10.0], [20.0, 20.0, 10.0]]),
        duration=duration,
        motion="static",
        imu_rate_hz=IMU_RATE_HZ,
        magnetometer_rate_hz=RATE_HZ,
        perturb=False,
        ambient=Ambient(atmosphere=Atmosphere(storms, seed, duration, 0.5 * RATE_HZ)),
        reference=Reference(place_world, rotated, late, rate),
    )
    known = replace(site, reference_world=place_world)
    return simulate_log(known, config, np.random.default_rng(seed))


def true_phasors(rested: IntegratedRests, simulation: SimulatedLog) -> ComplexArray:
    """Return what was there at the middle of each rest, shape (n, channels, 3) (T)."""
    truth, time = simulation.log.truth, rested.fields.time
    assert truth is not None
    pose = np.repeat(truth.world_from_body[:1], len(time), 0), truth.position_world[:1]
    there = Trajectory(time, pose[0], np.repeat(pose[1], len(time), 0))
    none = np.random.default_rng(0)
    return simulate_fields(
        simulation.true_site, there, NOTHING, none, simulation.drives
    ).phasor_sensor


def errors_in_sigmas(rested: IntegratedRests, simulation: SimulatedLog) -> Array:
    """Return the square of each phasor's error in its sigmas, shape (n, channels); six are due."""
    error = rested.fields.phasor_sensor - true_phasors(rested, simulation)
    solved = np.linalg.solve(rested.fields.phasor_cov, error[..., None])[..., 0]
    return np.asarray(np.real(np.sum(np.conj(error) * solved, axis=-1)))


@dataclass(frozen=True)
class Config:
    """What is simulated."""

    hour: float = 3600.0  # s
    silence: float = 120.0  # s
    storm: float = 600.0  # s
    runs: int = 10
    silent_runs: int = 150
    seed: int = 10


@dataclass(frozen=True)
class Hour:
    """What an hour gives of phasors and poses, with a site that is known."""

    name: str
    below_noise_db: float  # a tone's mean power over that of a sample's noise, all axes
    detected: float  # share of the tones
    times_bound: float  # rms error of a phasor
    nees: float  # of phasors; six are due
    position_m: float
    pose_nees: float


@dataclass(frozen=True)
class Silence:
    """How often noise is taken for a beacon."""

    name: str
    requested: float
    alarms: int
    tried: int


@dataclass(frozen=True)
class Storm:
    """What a second magnetometer is worth."""

    name: str
    gain: float  # median, of the sigma
    best_gain: float  # that two instruments of the same noise allow
    error_gain: float  # of the rms error
    nees: float
    findings: str


def run_hour(name: str, density: float, config: Config, *, synchronised: bool) -> Hour:
    """Measure hours at rest."""
    site, square, nees = far_site(noise_density=density, synchronised=synchronised), [], []
    detected, places, pose_nees, power = [], [], [], []
    for seed in range(config.seed, config.seed + config.runs):
        built = monitored_log(site, config.hour, seed, FAR_AWAY, 0.0)
        log = replace(built.log, reference=None)
        rested = integrate_rests(log, site)
        detected.append(rested.detected)
        error = rested.fields.phasor_sensor - true_phasors(rested, built)
        square.append(np.abs(error) ** 2 / 2.0)
        nees.append(errors_in_sigmas(rested, built))
        power.append(np.sum(np.abs(true_phasors(rested, built)) ** 2, axis=-1) / 2.0)
        off, ratio = pose_error(rested, log, site)
        places.append(off)
        pose_nees.append(ratio)
    sigma = density * np.sqrt(RATE_HZ / 2.0)
    bound = sigma * np.sqrt(2.0 / (config.hour * RATE_HZ))
    return Hour(
        name,
        float(10.0 * np.log10(np.mean(power) / (3.0 * sigma**2))),
        float(np.mean(detected)),
        float(np.sqrt(np.nanmean(square)) / bound),
        float(np.nanmean(nees)),
        rms(np.array(places)),
        float(np.mean(pose_nees)),
    )


def pose_error(rested: IntegratedRests, log: Log, site: Site) -> tuple[float, float]:
    """Return the error of the position (m), and the NEES of the pose."""
    truth, time = log.truth, float(rested.fields.time[0])
    assert truth is not None
    best = first_fixes(rested.fields, log, initial_calibration(site, time)).best()
    assert best.pose_cov is not None
    rotation, true = best.world_from_body[0], truth.world_from_body[0]
    turn = Rotation.from_matrix(true.T @ rotation).as_rotvec()
    offset = best.position_world[0] - truth.position_world[0]
    error = np.concatenate([turn, rotation.T @ offset])
    return float(np.linalg.norm(offset)), float(error @ np.linalg.solve(best.pose_cov[0], error))


def run_silence(config: Config, *, synchronised: bool) -> Silence:
    """Count false alarms in noise alone."""
    site, requested, alarms, tried = far_site(synchronised=synchronised), 0.01, 0, 0
    for seed in range(config.silent_runs):
        rested = integrate_rests(noise_log(site, config.silence, seed), site, false_alarm=requested)
        alarms, tried = alarms + int(np.sum(rested.detected)), tried + rested.detected.size
    name = "on the log's clock" if synchronised else "clocks of their own"
    return Silence(name, requested, alarms, tried)


def run_storm(name: str, place_world: Array, config: Config, *, other: bool = False) -> Storm:
    """Measure what a second magnetometer takes off."""
    site, gains, nees, square, findings = far_site(), [], [], [], set[str]()
    for seed in range(config.seed, config.seed + config.runs):
        storm = (config.storm, seed, place_world, STORMS, LATE, RATE)
        built = monitored_log(site, *storm)
        log = built.log
        if other:
            strange = monitored_log(site, config.storm, seed + 1000, place_world, STORMS)
            log = replace(log, reference=strange.log.reference)
        result = integrate_rests(log, built.true_site)
        alone = integrate_rests(replace(log, reference=None), built.true_site)
        true = true_phasors(result, built)
        square.append(
            [np.mean(np.abs(r.fields.phasor_sensor - true) ** 2) for r in (alone, result)]
        )
        assert result.gain is not None
        gains.append(np.where(np.isnan(result.gain), 1.0, result.gain))
        nees.append(errors_in_sigmas(result, built))
        findings |= {finding.code for finding in result.findings}
    density = np.hypot(STORMS / np.sqrt(np.array(FREQUENCIES_HZ)), NOISE_DENSITY)
    best = float(np.median(density / (np.sqrt(2.0) * NOISE_DENSITY)))
    total = np.sqrt(np.mean(square, axis=0))
    codes = ", ".join(sorted(findings))
    gain = float(np.median(gains))
    return Storm(name, gain, best, float(total[0] / total[1]), float(np.mean(nees)), codes)


def report(hours: list[Hour], silences: list[Silence], storms: list[Storm]) -> str:
    """Return the three tables."""
    lines = [
        "an hour                  tone/noise  found  error/bound  NEES (6)  position  NEES (6)"
    ]
    for one in hours:
        detected = (
            f"{one.below_noise_db:8.1f} dB{100.0 * one.detected:6.0f} %{one.times_bound:13.3f}"
        )
        pose = f"{one.nees:10.2f}{one.position_m:8.2f} m{one.pose_nees:10.2f}"
        lines.append(f"{one.name:24}{detected}{pose}")
    for alone in silences:
        share = f"{alone.alarms} of {alone.tried}"
        lines.append(f"noise alone, {alone.name}: {share} detected, {alone.requested:g} required")
    lines.append("second magnetometer      gain of sigma  at best  gain of error  NEES (6)")
    for storm in storms:
        gain = f"{storm.gain:13.2f}{storm.best_gain:9.2f}{storm.error_gain:15.2f}"
        lines.append(f"{storm.name:25}{gain}{storm.nees:10.2f}  {storm.findings}")
    return "\n".join(lines)


def main() -> None:
    """Measure hours, silence and storms."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--runs", type=int, default=Config.runs, help="of each kind")
    given = parser.parse_args()
    config = Config(runs=given.runs, seed=given.seed, silent_runs=15 * given.runs)
    hours = [
        run_hour("10 pT/rtHz", 1e-11, config, synchronised=True),
        run_hour("30 pT/rtHz", 3e-11, config, synchronised=True),
        run_hour("30 pT/rtHz, own clocks", 3e-11, config, synchronised=False),
    ]
    silences = [run_silence(config, synchronised=one) for one in (True, False)]
    others = far_site().beacons[0].position_world + np.array([60.0, 0.0, 0.0])
    storms = [
        run_storm("5 km away", FAR_AWAY, config),
        run_storm("receives other storms", FAR_AWAY, config, other=True),
        run_storm("60 m from beacon A", others, config),
    ]
    result = {"hours": hours, "silences": silences, "storms": storms}
    conclude(report(hours, silences, storms), result)


if __name__ == "__main__":
    main()
