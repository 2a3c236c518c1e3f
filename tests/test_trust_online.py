"""Online, each state says whether it is to be believed, and a loss is said and ends."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import run_command
from online_log import OnlineLog, navigate, online_log
from test_checkpoint import _rest, same
from test_navigate_stream import answered, records

from magfusion.cli import main
from magfusion.estimation.graph.state import State
from magfusion.estimation.online import running_estimate
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.estimation.online_integrity.imu_checks import judge_biases
from magfusion.estimation.online_integrity.judgement import JudgedState, Judgement
from magfusion.estimation.online_integrity.recovery import MAX_WAIT, Attempts
from magfusion.estimation.online_integrity.running import nothing
from magfusion.estimation.online_integrity.summary import Summary
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.jobs.stream import StreamSettings
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.trust import Finding, Verdict
from magfusion.simulation.demo_site import demo_site

BOTH = ["smoother", "ekf"]


@pytest.fixture(scope="module")
def walk() -> OnlineLog:
    return online_log(21, 31.0)


def navigated(log: OnlineLog, estimator: str) -> tuple[Navigator, list[JudgedState]]:
    navigator, states = navigate(log, NavigatorSettings(estimator))  # type: ignore[arg-type]
    return navigator, [state for state in states if isinstance(state, JudgedState)]


def rotated(fields: FieldSamples, begin: float, end: float, channels: object) -> FieldSamples:
    """Return phasors of which some have a wrong phase for a while: no pose explains them."""
    phasor, own = fields.phasor_sensor.copy(), (fields.time > begin) & (fields.time < end)
    angle = np.linspace(1.0, 2.5, phasor.shape[1])[:, None]
    wrong = np.exp(1j * angle) * phasor[..., [1, 2, 0]]
    chosen = np.zeros(phasor.shape[1], dtype=bool)
    chosen[channels] = True  # type: ignore[call-overload]
    phasor = np.where((own[:, None] & chosen)[..., None], wrong, phasor)
    return replace(fields, phasor_sensor=phasor)


def codes(states: list[JudgedState]) -> set[str]:
    return {finding.code for state in states for finding in state.judgement.reasons}


@pytest.mark.parametrize("estimator", BOTH)
@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in range(2, 12))]
)
def test_a_clean_log_is_trustworthy_from_the_first_state_to_the_last(
    estimator: str, seed: int
) -> None:
    navigator, states = navigated(online_log(seed, 25.0), estimator)
    assert {state.verdict for state in states} == {Verdict.TRUSTWORTHY}
    assert navigator.summary.trust.findings == ()
    assert all(state.judgement.honest(state.cov) is state.cov for state in states)


@pytest.mark.slow
def test_states_are_carried_with_the_noise_that_the_samples_have(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    walk = online_log(21, 20.0, rate_hz=200.0)
    imu = walk.site.platform.imu
    quiet = replace(imu, gyro_noise=imu.gyro_noise / 10.0, accel_noise=imu.accel_noise / 10.0)
    site = replace(walk.site, platform=replace(walk.site.platform, imu=quiet))

    def result() -> tuple[set[str], float]:
        _, states = navigated(replace(walk, site=site), "ekf")
        nees = walk.errors(states).nees
        assert nees is not None
        return codes(states), float(np.mean(nees))

    findings, nees = result()
    assert "noise_tuned" in findings  # by the smoothed beginning
    # A fix that is better than the states is no reason to reject it.
    assert "beacon_excluded" not in findings
    assert nees < 9.0
    monkeypatch.setattr(running_estimate, "measured_noise", lambda _, declared: (declared, []))
    findings, without = result()
    assert "beacon_excluded" in findings
    assert without > 2.0 * nees


@pytest.mark.slow
def test_beacons_that_are_no_majority_cast_doubt_where_one_of_four_does_not(
    walk: OnlineLog,
) -> None:
    def within(channels: list[int]) -> list[JudgedState]:
        other = replace(walk, fields=rotated(walk.fields, 20.0, 60.0, channels))
        _, states = navigated(other, "ekf")
        return [state for state in states if 20.0 < state.time < 24.0]

    one, two = within([1]), within([1, 2])
    assert {state.judgement.excluded for state in two} == {("B", "C")}
    # Five epochs in a row: one may be an impulse on both.
    late = [state.verdict for state in two[5:]]
    assert set(late) == {Verdict.DOUBTFUL}
    assert {f.code for state in two[5:] for f in state.judgement.reasons} == {"field_innovations"}
    assert {state.verdict for state in one[:8]} == {Verdict.TRUSTWORTHY}


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_a_platform_that_nothing_explains_is_lost_until_it_is_found(
    walk: OnlineLog, estimator: str
) -> None:
    wrong = replace(walk, fields=rotated(walk.fields, 20.0, 27.0, slice(None)))
    navigator, states = navigated(wrong, estimator)
    lost_epochs = [state.time for state in states if state.is_lost]
    # Five epochs tell a loss, the last of which is half a second before.
    assert 20.0 < lost_epochs[0] < 23.5
    assert 26.0 < lost_epochs[-1] < 27.0 + MAX_WAIT + 0.5
    result = [state for state in states if state.time > lost_epochs[-1]]
    assert result[0].verdict is Verdict.DOUBTFUL
    assert "found_again" in codes(result[:1])
    assert result[-1].verdict is Verdict.TRUSTWORTHY
    assert np.max(np.linalg.norm(walk.errors(result).position_world, axis=1)) < 0.03  # m
    summary = navigator.summary
    assert summary.trust.verdict is Verdict.DOUBTFUL
    assert summary.lost_states == len(lost_epochs)
    assert summary.longest_loss == pytest.approx(result[0].time - lost_epochs[0], abs=0.01)


@pytest.mark.parametrize("estimator", BOTH)
def test_the_states_of_a_loss_that_is_not_told_yet_cover_their_errors(estimator: str) -> None:
    log = online_log(21, 20.0)

    def propagate_passage(navigator: Navigator, now: float) -> None:
        if now == 15.0:
            inner = (
                navigator._loop.running.estimator
            )  # nothing that arrives could tell it so much nonsense
            assert inner is not None
            wrong = inner.state.position_world + np.array([1.0, -0.5, 0.3])
            inner.replace_state(replace(inner.state, position_world=wrong))

    settings = NavigatorSettings(estimator)  # type: ignore[arg-type]
    _, states = navigate(log, settings, watch=propagate_passage)
    errors = log.errors(states)
    assert errors.nees is not None
    for state, nees, error in zip(states, errors.nees, errors.position_world, strict=True):
        assert isinstance(state, JudgedState)
        if np.linalg.norm(error) > 0.1:  # m
            assert state.verdict is not Verdict.TRUSTWORTHY
            assert nees < 25.0  # of 6; what is refused tells its size, not its direction


@pytest.mark.parametrize("estimator", BOTH)
def test_a_beacon_that_is_refused_again_and_again_is_named(walk: OnlineLog, estimator: str) -> None:
    wrong = replace(walk, fields=rotated(walk.fields, 20.0, 60.0, [1]))
    _, states = navigated(wrong, estimator)
    after = [state for state in states if state.time > 21.0]
    assert {state.judgement.excluded for state in after if state.judgement.excluded} == {("B",)}
    assert "beacon_excluded" in codes(after)
    assert not any(state.is_lost for state in after)
    named = [f.text for s in after for f in s.judgement.reasons if f.code == "beacon_excluded"]
    assert all("beacon B" in text for text in named)
    assert np.max(np.linalg.norm(walk.errors(after).position_world, axis=1)) < 0.01  # m


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_a_bias_that_no_such_instrument_has_is_said_and_covered(
    walk: OnlineLog, estimator: str
) -> None:
    """A tilt between the instruments looks like one: the attitude may be off by it."""
    imu, bias = walk.imu, 0.8  # m/s^2
    accel = imu.accel_body + np.array([bias, 0.0, 0.0])
    _, states = navigated(replace(walk, imu=ImuSamples(imu.time, imu.gyro_body, accel)), estimator)
    assert all("imu_bias" in codes([state]) for state in states)
    assert all(state.verdict is Verdict.DOUBTFUL for state in states)
    assert states[-1].rotation_sigma > 0.8 * bias / walk.site.gravity


def test_a_bias_that_is_barely_determined_is_measured_by_its_declaration() -> None:
    """Two sigma are no doubt, however little the estimate is known to have gained; six are."""
    site = demo_site()
    imu, kept = site.platform.imu, 0.99  # share of the prior that remains
    cov = np.eye(15)
    cov[9:12, 9:12] = kept * imu.accel_bias_sigma**2 * np.eye(3)
    cov[12:, 12:] = kept * imu.gyro_bias_sigma**2 * np.eye(3)
    for sigmas, wanted in ((2.0, []), (6.0, ["imu_bias"])):
        bias = np.array([0.0, sigmas * imu.accel_bias_sigma, 0.0])
        state = State(
            0.0,
            np.eye(3),
            np.zeros(3),
            np.zeros(3),
            bias,
            np.zeros(3),
            initial_calibration(site, 0.0),
            cov,
        )
        judgement = judge_biases(site, state, 0.0)
        assert [finding.code for finding in judgement.findings] == wanted


@pytest.mark.parametrize("walk", [1e-3, 0.0])
def test_a_bias_declared_as_zero_walks_before_the_first_state(walk: float) -> None:
    """As declared, or as the estimators let it so that states are not tied to the last digit."""
    site = demo_site()
    imu = replace(
        site.platform.imu, accel_bias_sigma=0.0, gyro_bias_sigma=0.0, accel_bias_walk=walk
    )
    site = replace(site, platform=replace(site.platform, imu=imu))
    for size, wanted in ((2e-5, []), (0.02, ["imu_bias"])):  # m/s^2
        bias, calibration = np.array([size, 0.0, 0.0]), initial_calibration(site, 0.0)
        state = State(
            0.0, np.eye(3), np.zeros(3), np.zeros(3), bias, np.zeros(3), calibration, np.eye(15)
        )
        judgement = judge_biases(site, state, 0.0)
        assert [finding.code for finding in judgement.findings] == wanted


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_an_imu_that_comes_loose_is_noticed(walk: OnlineLog, estimator: str) -> None:
    """From upside down it feels gravity where it never was; fields alone would not tell."""
    imu, flip = walk.imu, np.array([1.0, -1.0, -1.0])
    after = imu.time[:, None] > 20.0
    gyro = np.where(after, flip * imu.gyro_body, imu.gyro_body)
    accel = np.where(after, flip * imu.accel_body, imu.accel_body)
    navigator, states = navigated(replace(walk, imu=ImuSamples(imu.time, gyro, accel)), estimator)
    wrong = [state for state in states if state.time > 23.0]
    assert all(state.verdict is not Verdict.TRUSTWORTHY for state in wrong)
    assert navigator.summary.trust.verdict is not Verdict.TRUSTWORTHY


@pytest.mark.slow
def test_a_navigator_that_is_lost_goes_on_from_its_checkpoint_to_the_last_bit(
    walk: OnlineLog,
) -> None:
    log = replace(walk, fields=rotated(walk.fields, 20.0, 27.0, slice(None)))
    twins: dict[float, Navigator] = {}

    def watch(navigator: Navigator, now: float) -> None:
        if now in (12.0, 25.0):
            twins[now] = restored(log.site, settings, navigator.checkpoint())

    settings = NavigatorSettings("smoother")
    navigator, states = navigate(log, settings, watch=watch)
    for begin, twin in twins.items():
        again = _rest(log, twin, begin)
        expected = states[len(states) - len(again) :]
        assert all(same(a, b) for a, b in zip(again, expected, strict=True))
        for one, other in zip(again, expected, strict=True):
            assert isinstance(one, JudgedState)
            assert isinstance(other, JudgedState)
            assert one.judgement == other.judgement
        assert twin.summary.trust == navigator.summary.trust


def as_log(walk: OnlineLog) -> Log:
    truth = walk.motion.trajectory(walk.imu.time)
    return Log("walk", 1_700_000_000_000_000_000, "test", walk.imu, None, walk.fields, truth)


def written(walk: OnlineLog, path: Path) -> Path:
    write_log(as_log(walk), path)
    save_site(walk.site, path / "site.yaml")
    return path


@pytest.mark.slow
def test_in_a_pipe_a_loss_gives_no_pose(walk: OnlineLog, tmp_path: Path) -> None:
    log = replace(walk, fields=rotated(walk.fields, 20.0, 24.0, slice(None)))
    save_site(walk.site, tmp_path / "site.yaml")
    lines, _ = answered(
        tmp_path / "site.yaml", records(log), StreamSettings(NavigatorSettings("ekf"))
    )
    reported = [line for line in lines if line["started"]]
    lost_epochs = [line for line in reported if line["lost"]]
    assert len(lost_epochs) >= 2
    for line in lost_epochs:
        assert line["verdict"] == "failed"
        assert line["reasons"][0]["code"] == "lost"
        assert not line.keys() & {"position", "quaternion", "velocity", "sigma"}
    for line in reported:
        assert line["lost"] is (line["verdict"] == "failed")
        assert line["lost"] or len(line["position"]) == 3
        assert line["protection_level_m"] is None
    assert reported[-1]["verdict"] == "trustworthy"
    assert reported[-1]["reasons"] == []
    waiting = [line for line in lines if not line["started"]]
    assert all(line["verdict"] is None and line["reasons"] == [] for line in waiting)


@pytest.mark.slow
def test_a_loss_that_was_found_again_makes_the_whole_doubtful(
    walk: OnlineLog, tmp_path: Path
) -> None:
    log = replace(walk, fields=rotated(walk.fields, 20.0, 26.0, slice(None)))
    output = tmp_path / "run"
    run_command("navigate", written(log, tmp_path / "log"), "-o", output)
    figures = json.loads((output / "report.json").read_text())
    assert list(figures).index("verdict") < list(figures).index("epochs")
    assert figures["verdict"] == "doubtful"
    rows = figures["reasons"]
    reasons = {code for row in rows for code in (row["code"], *row.get("explains", ()))}
    assert {"lost", "found_again"} <= reasons
    assert figures["lost_epochs"] > 4
    assert figures["lost_s"] == pytest.approx(figures["longest_loss_s"])
    assert figures["nees_mean"] < 12.0
    table = pq.read_table(output / "trajectory.parquet").to_pydict()
    assert len(table["verdict"]) == figures["epochs"]
    assert set(table["verdict"]) == {"trustworthy", "doubtful"}
    assert table["verdict"][-1] == "trustworthy"
    levels = [level for level in table["protection_level_m"] if level is not None]
    assert len(levels) > 0.9 * len(table["verdict"])
    assert 0.0 < np.median(levels) < 0.1  # m
    seen = {name for names in table["excluded"] for name in names}
    assert seen == {"A", "B", "C", "D"}


@pytest.mark.slow
def test_a_log_that_ends_lost_has_failed_and_leaves_no_result(
    walk: OnlineLog, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = replace(walk, fields=rotated(walk.fields, 20.0, 99.0, slice(None)))
    path, output = written(log, tmp_path / "log"), tmp_path / "run"
    with pytest.raises(SystemExit) as ended:
        main(["navigate", str(path), "-o", str(output), "--estimator", "ekf"])
    assert ended.value.code == 1
    reported = capfd.readouterr().err
    assert "failed: " in reported
    assert reported.count("\n") == 1
    assert {file.name for file in output.iterdir()} == {"report.json", "failed"}
    figures = json.loads((output / "report.json").read_text())
    assert figures["verdict"] == "failed"
    assert "lost" in {reason["code"] for reason in figures["reasons"]}
    table = pq.read_table(output / "failed" / "trajectory.parquet").to_pydict()
    assert table["verdict"][-1] == "failed"
    # A failed result may be replaced as any other.
    run_command("navigate", written(walk, tmp_path / "good"), "-o", output, "--estimator", "ekf")
    assert (output / "trajectory.tum").is_file()
    assert not (output / "failed").exists()


def test_attempts_are_spaced_out_and_never_given_up() -> None:
    attempts, times = Attempts(), []
    for k in range(400):
        if attempts.due(0.1 * k):
            times.append(0.1 * k)
    assert times[0] == 0.0
    assert np.max(np.diff(times)) == pytest.approx(MAX_WAIT, abs=0.11)
    assert len(times) < 30
    attempts.over()
    assert attempts.due(40.1)


def test_a_running_mean_is_worth_fewer_samples_than_it_has_seen() -> None:
    rng, mean = np.random.default_rng(0), nothing()
    means = []
    for k in range(5000):
        mean = mean.with_sample(rng.standard_normal(1), 0.2 * k, 10.0)
        means.append(mean.mean[0])
    assert mean.count == pytest.approx(2.0 * 10.0 / 0.2, rel=0.01)
    assert np.var(means[500:]) == pytest.approx(1.0 / mean.count, rel=0.3)


def test_the_worst_state_counts_unless_it_was_a_loss_that_ended() -> None:
    findings = {v: Judgement((Finding("lost", "Lost.", v),)) for v in Verdict}
    findings[Verdict.TRUSTWORTHY] = Judgement()
    summary, verdicts = Summary(), []
    for k, verdict in enumerate((*Verdict, Verdict.TRUSTWORTHY)):
        summary.note(float(k), findings[verdict])
        verdicts.append(summary.trust.verdict)
    assert verdicts == [*Verdict, Verdict.DOUBTFUL]
    assert summary.lost_states == 1
    assert summary.lost_time == summary.longest_loss == 1.0


def test_what_is_held_and_wrong_is_named_as_the_motion_tells_of_it() -> None:
    """A lever arm shows where the platform turns; before, the report lists it as unverified."""
    log = online_log(21, 20.0)
    sensor = log.site.platform.magnetometer
    wrong = replace(sensor, position_body=sensor.position_body + np.array([0.1, 0.0, 0.0]))
    site = replace(log.site, platform=replace(log.site.platform, magnetometer=wrong))
    navigator, states = navigated(replace(log, site=site), "ekf")
    assert "lever_arm" in {reason.code for reason in navigator.summary.trust.reasons}
    reported = [state for state in states if "lever_arm" in codes([state])]
    assert reported[0].time < 12.0
    nees = log.errors(reported).nees
    assert nees is not None
    assert np.mean(nees) < 20.0
