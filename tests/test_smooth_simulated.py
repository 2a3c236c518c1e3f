"""The whole way from a simulated waveform to a trajectory, on short logs."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.batch.chain import choose_chains, start_phases
from magfusion.estimation.batch.log_graph import overlap
from magfusion.estimation.demodulation.demodulation import first_fixes, phasors
from magfusion.model.parameters import Calibration, difference, initial_calibration
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.receiver.windows import LockinSettings
from magfusion.results.errors import TrajectoryErrors, trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

DURATION = 20.0  # s


@dataclass(frozen=True, eq=False)
class Run:
    """A simulated log and what the smoother makes of it."""

    site: Site
    simulated: SimulatedLog
    result: Smoothed

    @property
    def errors(self) -> TrajectoryErrors:
        assert self.simulated.log.truth is not None
        return trajectory_errors(self.result.states, self.simulated.log.truth)


def surveyed_exactly(site: Site) -> Site:
    """Return the site with every sigma of its survey zero."""
    none = np.zeros(3)
    sensor = site.platform.magnetometer
    sensor = replace(sensor, sigma=MagnetometerSigma(np.zeros((3, 3)), none, none, none))
    known = BeaconSigma(none, none, np.zeros(2))
    beacons = tuple(replace(beacon, sigma=known) for beacon in site.beacons)
    return replace(site, beacons=beacons, platform=replace(site.platform, magnetometer=sensor))


def simulated(
    seed: int, *, synchronised: bool = True, time_offset: float = 0.004, clock_rate: float = 0.0
) -> tuple[Site, SimulatedLog]:
    site = replace(demo_site(coil_radius=None, synchronised=synchronised), model_error=1e-5)
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=DURATION,
        motion="turn",
        rests=Rests(start=2.0, move=12.0, pause=2.0),
        time_offset=time_offset,
        clock_rate=clock_rate,
    )
    return site, simulate_log(site, config, np.random.default_rng(seed))


def true_calibration(run: Run) -> Calibration:
    reference = run.result.calibration.reference_time
    true = initial_calibration(run.simulated.true_site, reference)
    drives = run.simulated.drives
    at_epoch = replace(true, phase=drives.phase, drift=drives.drift, reference_time=0.0)
    return replace(
        at_epoch, phase=at_epoch.drive_phase(np.array(reference)), reference_time=reference
    )


def turns(angle: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * angle))


@pytest.fixture(scope="module")
def plain() -> Run:
    site, built = simulated(1)
    return Run(site, built, smooth(built.log, site))


@pytest.mark.slow
def test_a_log_is_smoothed_without_any_hint_of_the_start(plain: Run) -> None:
    assert plain.result.converged
    assert len(plain.result.states) > 90
    assert plain.errors.ate < 0.006  # m; the survey is good to a millimetre an axis
    assert plain.errors.attitude_rmse_deg < 0.3
    assert plain.errors.inside_3_sigma is not None
    assert plain.errors.inside_3_sigma > 0.97
    assert plain.result.dropped == {}
    assert plain.result.gap_bridged == 0


@pytest.mark.slow
def test_the_passes_settle_where_the_first_pass_was_not(plain: Run) -> None:
    first = smooth(plain.simulated.log, plain.site, SmootherSettings(max_iterations=1))
    assert not first.converged
    assert first.iteration_count == 1
    assert plain.result.iteration_count > 2
    moved = first.states.position_world - plain.result.states.position_world
    assert np.sqrt(np.mean(moved**2)) > 5e-5  # m
    again = smooth(plain.simulated.log, plain.site, SmootherSettings(max_iterations=12))
    converged = again.states.position_world - plain.result.states.position_world
    assert np.max(np.abs(converged)) < 1e-6  # m


@pytest.mark.slow
def test_the_start_is_the_right_hypothesis_at_every_epoch(plain: Run) -> None:
    truth = plain.simulated.motion.trajectory(plain.result.start.states.time)
    separate = plain.result.start.states.position_world - truth.position_world
    assert np.max(np.linalg.norm(separate, axis=1)) < 0.2  # m; a mirror is metres away
    assert plain.result.rival_chi_square is None or plain.result.rival_chi_square > 1e3


def test_velocities_and_biases_are_the_true_ones(plain: Run) -> None:
    states, truth = plain.result.states, plain.simulated.log.truth
    moving = plain.simulated.motion.trajectory(states.time)
    assert truth is not None
    assert truth.gyro_bias_body is not None
    assert states.gyro_bias_body is not None
    assert states.velocity_world is not None
    assert moving.velocity_world is not None
    speed = np.linalg.norm(states.velocity_world - moving.velocity_world, axis=1)
    assert np.sqrt(np.mean(speed**2)) < 0.01  # m/s
    bias = states.gyro_bias_body.mean(axis=0) - truth.gyro_bias_body.mean(axis=0)
    assert np.all(np.abs(bias) < 5e-4)  # rad/s; a tenth of its prior


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "time_offset", "clock_rate"), [(2, 0.012, 8e-5), (3, -0.009, -5e-5), (4, 0.0, 0.0)]
)
def test_the_imus_clock_is_recovered_within_three_sigma(
    seed: int, time_offset: float, clock_rate: float
) -> None:
    site, built = simulated(seed, time_offset=time_offset, clock_rate=clock_rate)
    result = smooth(built.log, site)
    assert [b.name for b in result.blocks] == ["imu.time_offset", "imu.clock_rate"]
    sigma = np.sqrt(np.diag(result.calibration_cov))
    assert abs(result.calibration.time_offset - time_offset) < 3.0 * sigma[0]
    assert abs(result.calibration.clock_rate - clock_rate) < 3.0 * sigma[1]
    assert sigma[1] < 4e-5  # of 20 s, in part at rest; its prior is 5e-5
    middle = DURATION / 2.0
    by_both = np.array([1.0, middle])
    there = float(np.sqrt(by_both @ result.calibration_cov @ by_both))
    assert there < 5e-4  # s; a twentieth of the prior of the time offset
    true = time_offset + clock_rate * middle
    assert abs(float(result.calibration.imu_offset(np.array(middle))) - true) < 3.0 * there


@pytest.mark.slow
def test_unsynchronised_beacons_give_up_phase_and_drift() -> None:
    site, built = simulated(5, synchronised=False)
    run = Run(site, built, smooth(built.log, site))
    step = difference(true_calibration(run), run.result.calibration, run.result.blocks)
    sigma = np.sqrt(np.diagonal(run.result.calibration_cov))
    seen = set()
    for block in run.result.blocks:
        if block.kind not in ("phase", "drift"):
            continue
        seen.add(block.name)
        error = turns(step[block.columns]) if block.kind == "phase" else step[block.columns]
        assert np.all(np.abs(error) < 3.5 * sigma[block.columns]), block.name
        assert sigma[block.columns][0] < {"phase": 0.02, "drift": 5e-6}[block.kind]
    assert len(seen) == 2 * len(site.beacons)
    assert np.max(np.abs(built.drives.drift)) > 1e-5  # there was something to find
    assert run.errors.aligned_ate < 0.006  # m
    assert run.errors.ate < 0.01  # m


def test_start_phases_find_a_drift_of_many_turns() -> None:
    site = demo_site(synchronised=False)
    drift = np.array([5e-5, -8e-5, 0.0, 2e-5])
    frequencies = np.array([b.frequency_hz for b in site.beacons])
    rng = np.random.default_rng(6)
    time, middle = np.arange(0.0, 3600.0, 1.0), 1800.0
    at_middle = rng.uniform(-np.pi, np.pi, 4)
    phase = at_middle + 2.0 * np.pi * (time[:, None] - middle) * frequencies * drift
    assert np.ptp(phase[:, 0]) > 20.0  # rad; three turns
    noisy = turns(phase + rng.normal(0.0, 0.3, phase.shape))
    result = start_phases(initial_calibration(site, middle), time, noisy)
    assert np.allclose(result.drift, drift, rtol=0.0, atol=2e-6)
    assert np.all(np.abs(turns(result.phase - at_middle)) < 0.05)  # rad


@pytest.mark.parametrize("seed", range(5))
def test_start_phases_of_a_beacon_below_the_noise_leave_its_clock_as_declared(seed: int) -> None:
    """Its phases are noise that lasts: in a half of the log it points another way by chance."""
    rng, time = np.random.default_rng(seed), np.arange(0.0, 30.0, 0.2)
    site = demo_site(coil_radius=None, synchronised=False)
    phase = np.cumsum(0.5 * rng.standard_normal((len(time), len(site.channels))), axis=0)
    phase[:60] = 0.1 * rng.standard_normal((60, len(site.channels)))
    result = start_phases(initial_calibration(site, 15.0), time, phase)
    assert np.all(np.abs(result.drift) < 3.0 * site.clock.drift_sigma)


def without_imu(log: Log, start: float, end: float) -> Log:
    imu = log.imu
    kept = (imu.time < start) | (imu.time > end)
    return replace(log, imu=ImuSamples(imu.time[kept], imu.gyro_body[kept], imu.accel_body[kept]))


def without_field(log: Log, start: float, end: float) -> Log:
    assert log.waveform is not None
    time = log.waveform.time
    kept = (time < start) | (time > end)
    return replace(log, waveform=Waveform(time[kept], log.waveform.measured_sensor[kept]))


def test_a_gap_in_the_magnetometer_is_bridged_by_the_imu(plain: Run) -> None:
    holed = without_field(plain.simulated.log, 8.0, 9.5)
    result = smooth(holed, plain.site)
    run = Run(plain.site, plain.simulated, result)
    assert result.dropped["gap in the magnetometer stream"] >= 2
    assert result.gap_bridged == 0
    step = np.diff(result.states.time)
    assert 1.5 < np.max(step) < 2.5  # s
    assert run.errors.ate < 0.008  # m
    assert run.errors.inside_3_sigma is not None
    assert run.errors.inside_3_sigma > 0.95


@pytest.mark.slow
def test_a_gap_in_the_imu_is_bridged_and_counted(plain: Run) -> None:
    holed = without_imu(plain.simulated.log, 8.0, 9.0)
    result = smooth(holed, plain.site)
    run = Run(plain.site, plain.simulated, result)
    assert result.gap_bridged >= 1
    within = (result.states.time > 8.1) & (result.states.time < 8.9)
    assert np.sum(within) >= 3  # fields are heard there
    assert result.dropped["gap in the inertial stream"] <= 1  # and only an edge is lost
    off = np.linalg.norm(run.errors.position_world, axis=1)
    silent = (run.errors.time > 7.8) & (run.errors.time < 9.2)
    assert np.sqrt(np.mean(off[~silent] ** 2)) < 0.008  # m
    assert np.sqrt(np.mean(off[silent] ** 2)) < 0.1  # m
    assert run.errors.inside_3_sigma is not None
    assert run.errors.inside_3_sigma > 0.95


def test_a_log_of_phasors_alone_is_smoothed(plain: Run) -> None:
    samples, dropped = phasors(plain.simulated.log, plain.site)
    assert dropped == {}
    bare = replace(plain.simulated.log, waveform=None, fields=samples)
    run = Run(plain.site, plain.simulated, smooth(bare, plain.site))
    assert run.result.fields is samples
    assert run.errors.ate < 0.01  # m
    assert run.errors.ate > plain.errors.ate  # the motion inside the windows is not taken off


@pytest.mark.slow
def test_overlapping_windows_are_not_counted_twice(plain: Run) -> None:
    samples, _ = phasors(plain.simulated.log, plain.site)
    assert overlap(samples) == pytest.approx(2.0)
    spread, _ = phasors(plain.simulated.log, plain.site, LockinSettings(window=0.4, step=0.5))
    assert overlap(spread) == 1.0
    site, built = simulated(8)
    sigma = {}
    for step in (0.4, 0.1):
        settings = SmootherSettings(lockin=LockinSettings(window=0.4, step=step))
        cov = smooth(built.log, surveyed_exactly(site), settings).states.pose_cov
        assert cov is not None
        sigma[step] = np.median(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)), axis=0)
    # Four times as many windows of the same samples hold no more information.
    assert np.allclose(sigma[0.1], sigma[0.4], rtol=0.2, atol=0.0)


def among_beacons(seed: int, number: int) -> tuple[Site, SimulatedLog]:
    site, _ = simulated(seed)
    site = replace(site, beacons=site.beacons[:number])
    rests = Rests(start=2.0, move=12.0, pause=2.0)
    config = SimulationConfig(DEMO_BOX_WORLD, DURATION, motion="turn", rests=rests)
    return site, simulate_log(site, config, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_one_beacon_leaves_two_chains_of_which_one_is_right(seed: int) -> None:
    site, built = among_beacons(seed, 1)
    samples, _ = phasors(built.log, site, LockinSettings(window=0.4, step=0.2))
    fixes = first_fixes(samples, built.log, initial_calibration(site, 0.0))
    truth = built.motion.trajectory(fixes.time).position_world

    def wrong(position: np.ndarray) -> float:
        return float(np.mean(np.linalg.norm(position - truth, axis=1) > 0.3))  # m

    assert wrong(fixes.best().position_world) > 0.3  # a single epoch cannot tell the mirrors apart
    chains = choose_chains(fixes, built.log.imu, 0.0, site)
    shares = sorted(wrong(chain.states.position_world) for chain in chains)
    assert len(shares) == 2
    assert shares[0] < 0.06
    assert shares[1] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_motion_decides_between_the_mirrors_of_one_beacon(seed: int) -> None:
    site, built = among_beacons(seed, 1)
    settings = SmootherSettings(lockin=LockinSettings(window=0.4, step=0.2))
    run = Run(site, built, smooth(built.log, site, settings))
    assert run.errors.ate < 0.1  # m; the mirror is metres away
    assert run.result.rival_chi_square is not None
    assert run.result.rival_chi_square > 25.0


@pytest.mark.slow
def test_progress_is_told_from_first_to_last() -> None:
    site, built = simulated(7)
    reported: list[tuple[str, int, int]] = []
    smooth(built.log, site, report=lambda *step: reported.append(step))
    assert [stage for stage, _, _ in reported[:3]] == ["demodulating", "finding a start", "pass 1"]
    assert reported[-1][0] == "done"
    assert reported[-1][1] == reported[-1][2]
    done = [count for _, count, _ in reported]
    assert done == sorted(done)


def cut(log: Log, end: float) -> Log:
    return without_field(without_imu(log, end, 1e9), end, 1e9)


def test_too_short_a_log_is_refused_in_one_sentence(plain: Run) -> None:
    with pytest.raises(InputError, match=r"no window of 0\.4 s is usable .*too short"):
        smooth(cut(plain.simulated.log, 0.3), plain.site)
    with pytest.raises(EstimationError, match="has 1 field epoch; at least 2"):
        smooth(cut(plain.simulated.log, 0.5), plain.site)


def test_a_log_without_any_field_is_refused(plain: Run) -> None:
    with pytest.raises(EstimationError, match="neither waveform nor phasors"):
        smooth(replace(plain.simulated.log, waveform=None), plain.site)


def test_two_epochs_are_enough(plain: Run) -> None:
    result = smooth(cut(plain.simulated.log, 0.7), plain.site)
    assert len(result.states) == 2
    separate = result.states.position_world - plain.result.states.position_world[:2]
    assert np.max(np.abs(separate)) < 0.02  # m


def test_settings_without_a_pass_are_refused() -> None:
    with pytest.raises(ValueError, match="passes"):
        SmootherSettings(max_iterations=0)
