"""A log without an IMU: a motion prior stands in for it, in batch, window and filter."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.graph.preintegration import cut_at_epochs, preintegrate
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.log import read_log, write_log
from magfusion.files.site import load_site, save_site
from magfusion.files.stream_contents import fields_content, write_record
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.platform_motion import NO_IMU, MotionPrior
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.without_imu import as_declared, on_motion_prior, without_imu
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import (
    EPOCH_NS,
    SimulationConfig,
    simulate_fields,
    simulate_log,
)
from magfusion.simulation.motion import Rests, random_walk_motion

HZ = 20.0
A_HAND = MotionPrior(2.0, 3.0)


def exact(prior: MotionPrior | None = A_HAND) -> Site:
    """Return a site whose survey is exact, without an IMU."""
    site = demo_site(coil_radius=None)
    beacons = tuple(
        replace(
            b,
            sigma=replace(
                b.sigma,
                position_world=np.zeros(3),
                rotation_beacon=np.zeros(3),
                log_moment=np.zeros(len(b.coils)),
            ),
        )
        for b in site.beacons
    )
    sensor = site.platform.magnetometer
    known = replace(
        sensor.sigma,
        matrix=np.zeros((3, 3)),
        offset=np.zeros(3),
        rotation_sensor=np.zeros(3),
        position_body=np.zeros(3),
    )
    platform = replace(
        site.platform,
        imu=NO_IMU,
        magnetometer=replace(sensor, sigma=known),
        motion_prior=prior,
    )
    return replace(site, beacons=beacons, platform=platform, model_error=1e-7)


def detected(site: Site, truth: Trajectory, rng: np.random.Generator) -> Log:
    fields = simulate_fields(site, truth, 1e-9, rng)
    fields = replace(fields, window=np.full(len(fields), 1.0 / HZ))
    return Log("free", EPOCH_NS, "test", ImuSamples.empty(), fields=fields, truth=truth)


def by_hand(seed: int, duration: float) -> tuple[Site, Log]:
    rng, site = np.random.default_rng(seed), exact()
    rests = Rests(0.0, duration, 0.0)
    motion = random_walk_motion(rng, duration, DEMO_BOX_WORLD, rests=rests)
    return site, detected(site, motion.trajectory(np.arange(0.2, duration, 1.0 / HZ)), rng)


def by_chance(seed: int, duration: float, prior: MotionPrior) -> tuple[Site, Log]:
    """Return a log of a motion with just these white accelerations, integrated at 400 Hz."""
    rng, site, dt = np.random.default_rng(seed), exact(prior), 1.0 / 400.0
    count = int(duration / dt)
    kicks = np.sqrt(dt) * rng.standard_normal((2, count, 3))
    rate = 0.5 * rng.standard_normal(3) + prior.angular_accel_density * np.cumsum(kicks[0], axis=0)
    speed = prior.accel_density * np.cumsum(kicks[1], axis=0)
    place = np.array([3.0, 2.5, 1.1]) + dt * np.cumsum(speed, axis=0)
    turn, turns = Rotation.random(rng=rng), []
    for one in Rotation.from_rotvec(dt * rate):
        turn = turn * one
        turns.append(turn.as_matrix())
    kept = np.arange(40, count, round(1.0 / HZ / dt))
    return site, detected(
        site, Trajectory(dt * (1 + kept), np.array(turns)[kept], place[kept]), rng
    )


def nees(states: Trajectory, truth: Trajectory | None) -> float:
    assert truth is not None
    result = trajectory_errors(states, truth).nees
    assert result is not None
    return float(np.mean(result))


def test_the_covariance_holds_for_motion_of_that_density() -> None:
    estimate = []
    for seed in (0, 2):
        log, site = without_imu(*reversed(by_chance(seed, 3.0, MotionPrior(0.3, 2.0))))
        result = smooth(log, site)
        estimate.append(nees(result.states, log.truth))
        tuned = {t.key: t.factor for t in result.noise if t.owner == "motion_prior"}
        assert set(tuned) == {"angular_accel_density", "accel_density"}
        assert max(tuned.values()) < 1.3
    assert 4.0 < np.mean(estimate) < 9.0


def test_the_covariance_holds_for_a_hand_and_the_prior_helps() -> None:
    site, log = by_hand(1, 3.0)
    result, trust = judge_result(smooth(log, site), log)
    assert trust.verdict == "trustworthy"
    assert 4.0 < nees(result.states, log.truth) < 9.0
    alone = trajectory_errors(result.start.states, log.truth).position_world
    smoothed = trajectory_errors(result.states, log.truth).position_world
    assert np.mean(smoothed**2) < np.mean(alone**2)


def of_moments(sigma: float, site: Site) -> Site:
    """Return a site whose moments are uncertain (sigma of the logarithm)."""
    beacons = tuple(
        replace(b, sigma=replace(b.sigma, log_moment=np.full(len(b.coils), sigma)))
        for b in site.beacons
    )
    return replace(site, beacons=beacons)


def of_samples(seed: int, beacons: int, duration: float) -> tuple[Log, Site]:
    """Return raw samples of a walk among beacons whose moments alone are uncertain, by 5 %."""
    site = of_moments(0.05, exact())
    site = replace(site, beacons=site.beacons[:beacons])
    config = SimulationConfig(DEMO_BOX_WORLD, duration=duration, magnetometer_rate_hz=400.0)
    return simulate_log(site, config, np.random.default_rng(seed)).log, site


def mean_nees_of_samples(beacons: int, seeds: range, duration: float) -> float:
    runs = [of_samples(seed, beacons, duration) for seed in seeds]
    assert not any(len(log.imu) for log, _ in runs)
    return float(np.mean([nees(smooth(log, site).states, log.truth) for log, site in runs]))


@pytest.mark.slow
def test_the_covariance_holds_for_raw_samples() -> None:
    """Windows follow the poses, and their residuals are no measure of their noise."""
    assert 3.0 < mean_nees_of_samples(4, range(2), 8.0) < 9.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_uncertain_moments_do_not_move_the_trajectory(seed: int) -> None:
    """A log determines moments better than a sigma of 5 % does, and as well as known ones."""
    uncertain = of_moments(0.05, exact())
    config = SimulationConfig(DEMO_BOX_WORLD, duration=12.0, magnetometer_rate_hz=400.0)
    simulated = simulate_log(uncertain, config, np.random.default_rng(seed))
    log, errors = simulated.log, []
    assert log.truth is not None
    for site in (uncertain, of_moments(0.0, simulated.true_site)):
        result, trust = judge_result(smooth(log, site), log)
        assert trust.verdict == "trustworthy"
        errors.append(trajectory_errors(result.states, log.truth).ate)
    assert errors[0] < 1.2 * errors[1]


@pytest.mark.slow
@pytest.mark.parametrize("beacons", [2, 4])
def test_the_covariance_holds_for_raw_samples_over_ten_seeds(beacons: int) -> None:
    assert 3.0 < mean_nees_of_samples(beacons, range(10), 12.0) < 8.0


def test_the_noise_within_an_interval_is_that_of_white_accelerations() -> None:
    """Closed form of the double integral: q^2 t^3/3, q^2 t^2/2, q^2 t."""
    prior, length = MotionPrior(0.7, 1.3), 0.2
    site = on_motion_prior(exact(prior))
    time = np.linspace(-0.1, 0.5, 601)
    none = np.zeros((len(time), 3))
    steps = cut_at_epochs(ImuSamples(time, none, none), 0.0, np.array([0.0, length]))
    zero = np.zeros((2, 3))
    (link,) = preintegrate(steps, site.platform.imu, site.gravity, zero, zero)
    cov = np.asarray(link.preintMeasCov())
    turn, place, speed, rate = cov[0, 0], cov[3, 3], cov[6, 6], cov[12, 12]
    q, p = prior.angular_accel_density, prior.accel_density
    assert rate == pytest.approx(q**2 * length, rel=0.02)
    assert turn == pytest.approx(q**2 * length**3 / 3.0, rel=0.02)
    assert speed == pytest.approx(p**2 * length, rel=0.02)
    assert place == pytest.approx(p**2 * length**3 / 3.0, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf", pytest.param("smoother", marks=pytest.mark.slow)])
def test_a_navigator_needs_no_inertial_samples(estimator: str) -> None:
    site, log = by_hand(0, 8.5)
    assert log.fields is not None
    navigator = Navigator(site, NavigatorSettings(estimator=estimator, lag=0.5))
    for one in log.fields.epochs():
        navigator.add_fields(one)
    built = navigator.take()
    assert len(built) > 40
    assert navigator.judgement.verdict == "trustworthy"
    assert built[-1].reset_counter == 0
    states = as_trajectory([*built])
    assert 3.0 < nees(states, log.truth) < 10.0
    with pytest.raises(InputError, match=r"describe platform\.imu"):
        navigator.add_imu(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))


@pytest.mark.slow
def test_the_pipe_tells_the_rate_of_the_body(tmp_path: Path) -> None:
    site, log = by_hand(0, 7.5)
    assert log.fields is not None
    save_site(site, tmp_path / "site.yaml")
    source, sink = io.BytesIO(), io.BytesIO()
    for one in log.fields.epochs():
        write_record(fields_content(one), source, "json")
    source.seek(0)
    settings = StreamSettings(NavigatorSettings(estimator="ekf"))
    run_stream(tmp_path / "site.yaml", settings, source, sink, io.StringIO())
    last = json.loads(sink.getvalue().splitlines()[-1])
    assert last["started"]
    assert "gyro_bias" not in last
    truth = log.truth
    assert truth is not None
    row = int(np.searchsorted(truth.time, last["time"] - 1e-6))
    turns = Rotation.from_matrix(truth.world_from_body)
    rate = (turns[row - 1].inv() * turns[row]).as_rotvec() * HZ
    sigma = np.array(last["sigma"]["rate"])
    assert np.all(np.abs(np.array(last["rate"]) - rate) < 4.0 * sigma)


def test_a_site_without_an_imu_is_written_and_read(tmp_path: Path) -> None:
    site = exact()
    save_site(on_motion_prior(site), tmp_path / "site.yaml")
    read = load_site(tmp_path / "site.yaml")
    assert read.platform.imu == NO_IMU
    assert read.platform.motion_prior == A_HAND
    assert read.gravity == site.gravity
    assert read.platform.motion == site.platform.motion
    result = as_declared(on_motion_prior(read))
    assert result.platform == read.platform


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """Return a directory of a log that has phasors alone, with a site that says nothing of it."""
    _, log = by_hand(1, 1.5)
    write_log(log, tmp_path / "bare")
    save_site(exact(None), tmp_path / "bare" / "site.yaml")
    return tmp_path / "bare"


@pytest.mark.slow
def test_fix_and_survey_need_no_imu_and_smooth_says_what_it_needs(
    bare: Path, tmp_path: Path, refuse: Refuse
) -> None:
    assert len(read_log(bare).imu) == 0
    findings = refuse("smooth", bare, "-o", tmp_path / "run")
    assert "platform.motion_prior" in findings
    assert "platform.motion_prior" in refuse("navigate", bare, "-o", tmp_path / "run")
    findings = refuse("calibrate", "magnetometer", bare, "-o", tmp_path / "run")
    assert "give the log with magnetometer.parquet" in findings
    run_command("fix", bare, "-o", tmp_path / "fixes")
    report = json.loads((tmp_path / "fixes" / "report.json").read_text())
    assert report["nees_mean"] < 9.0
    assert report["verdict"] == "trustworthy"
    run_command("survey", bare, "--points", "epochs", "-o", tmp_path / "survey")


def test_a_smoothed_log_has_no_biases_and_no_inertial_rate(
    bare: Path, tmp_path: Path, refuse: Refuse
) -> None:
    import pyarrow.parquet as pq

    save_site(exact(), bare / "site.yaml")
    assert "--rate HZ" in refuse("smooth", bare, "--rate", "imu", "-o", tmp_path / "run")
    run_command("smooth", bare, "--rate", 50, "-o", tmp_path / "run")
    names = pq.read_schema(tmp_path / "run" / "trajectory.parquet").names
    assert not [name for name in names if "bias" in name]
    assert len(pq.read_table(tmp_path / "run" / "trajectory.parquet")) > 50
    assert load_site(tmp_path / "run" / "site.yaml").gravity == exact().gravity


@pytest.mark.slow
def test_navigate_says_why_states_have_no_protection_level(tmp_path: Path) -> None:
    """Windows of 0.4 s are too far apart for the prior of a hand: each is a fix of its own."""
    run_command("simulate", "-o", tmp_path / "log", "--duration", 12, "--seed", 3)
    (tmp_path / "log" / "imu.parquet").unlink()
    site = load_site(tmp_path / "log" / "site.yaml")
    platform = replace(site.platform, motion_prior=A_HAND)
    save_site(replace(site, platform=platform), tmp_path / "log" / "site.yaml")
    run_command("navigate", tmp_path / "log", "--estimator", "ekf", "-o", tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["states_without_level"] == report["epochs"] > 0
    (remark,) = [one for one in report["remarks"] if one["code"] == "no_redundancy"]
    assert "states have no protection level" in remark["text"]
    page = (tmp_path / "run" / "report.html").read_text()
    assert "states have no protection level" in page


def test_inertial_samples_that_the_site_does_not_describe_are_refused(
    bare: Path, tmp_path: Path, refuse: Refuse
) -> None:
    log = read_log(bare)
    time = np.linspace(0.0, 1.5, 200)
    force = np.tile([0.0, 0.0, 9.8], (200, 1))
    write_log(replace(log, imu=ImuSamples(time, 0.1 * force, force)), bare)
    assert "platform.imu: is missing" in refuse("fix", bare, "-o", tmp_path / "run")
