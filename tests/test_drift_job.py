"""The job that tries the online estimators for days: its verdicts, its files, its resumption."""

import json
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, replace
from multiprocessing import get_context

import numpy as np
import pytest

from magfusion.cli import main
from magfusion.errors import InputError
from magfusion.files.checkpoint import Checkpoint, write_checkpoint
from magfusion.jobs import drift, drift_world
from magfusion.jobs.drift import DriftSettings, overall, run_drift, summarise
from magfusion.jobs.drift_events import judge_events
from magfusion.jobs.drift_figures import (
    after_settling,
    drift_of,
    judge_runs,
    nees_limits,
    verdict_of_one,
)
from magfusion.jobs.drift_world import Reported, WorldRun, WorldTask, run_world
from magfusion.results.brief import lines
from magfusion.results.drift import QUANTITIES, ErrorSeries

SHORT = 0.2  # h; two stretches
PIECES = 10.0 * np.arange(8640.0)  # s; a day
SIGMA = np.repeat([1e-3, 4e-3, 1e-2, 5e-3, 1e-4], 3)


def a_run(
    world=0,
    *,
    slope=0.0,
    growth=0.0,
    slower=0.0,
    sigma_error=1.0,
    jump=0.0,
    losses=None,
    memory=200.0,
):
    """Return a day of synthetic white errors, with what is to be found in them."""
    rng = np.random.default_rng(world)
    stamps = 60.0 * np.arange(1440.0)
    error = sigma_error * SIGMA * rng.standard_normal((len(stamps), 15))
    error[:, 0] += slope * stamps / 86_400.0
    nees = [
        np.sum((error[:, part] / SIGMA[part]) ** 2, axis=1) for part in (slice(6), slice(9, 15))
    ]
    share = PIECES / PIECES[-1]
    pace = np.column_stack(
        [
            PIECES,
            2e-3 * (1.0 + slower * share) * rng.uniform(1.0, 1.02, len(PIECES)),
            np.ones_like(PIECES),
            memory + growth * share,
            np.ones_like(PIECES),
            np.full_like(PIECES, 3e-6),
        ]
    )
    measured = np.arange(len(stamps)) % 2 == 0
    error[501, 3] += jump
    series = ErrorSeries(
        stamps,
        measured,
        error,
        np.tile(SIGMA, (len(stamps), 1)),
        nees[0],
        nees[1],
    )
    task = WorldTask(world, "ekf", 24.0, 0)
    return WorldRun(task, series, pace, 10.0, losses or {})


def verdicts(**changes):
    _, findings = judge_runs("ekf", [a_run(world, **changes) for world in range(8)])
    return {f.name.removeprefix("ekf_"): f.verdict for f in findings}


def test_an_estimator_that_stands_passes():
    assert set(verdicts().values()) == {"pass"}


@pytest.mark.parametrize(
    ("changes", "failing"),
    [
        ({"slope": np.deg2rad(3.0)}, "attitude_drift"),
        ({"slope": np.deg2rad(0.04)}, "attitude_common_drift"),
        ({"growth": 100.0}, "memory"),
        ({"growth": 25.0, "memory": 400.0}, "memory"),
        ({"slower": 2.0}, "latency"),
        ({"sigma_error": 2.0}, "pose_consistency"),
        ({"sigma_error": 2.0}, "bias_consistency"),
        ({"jump": 3.0}, "carried"),
        ({"losses": {"lost and found again": 1}}, "lost"),
    ],
)
def test_each_fault_fails_its_own_verdict(changes, failing):
    assert verdicts(**changes)[failing] == "fail"


@pytest.mark.parametrize(("slope_deg", "verdict"), [(3.0, "fail"), (0.1, "undecided")])
def test_one_world_alone_drifts_only_by_more_than_it_claims(slope_deg, verdict):
    """Biases walk: a line through one walk is no drift."""
    _, findings = judge_runs("ekf", [a_run(0, slope=np.deg2rad(slope_deg))])
    result = {f.name: f.verdict for f in findings}
    assert result["ekf_attitude_drift"] == verdict


@pytest.mark.parametrize(("worlds", "verdict"), [(1, "pass"), (4, "fail")])
def test_sigmas_too_large_need_several_worlds_to_be_told_from_luck(worlds, verdict):
    """One survey may happen to err little; not all of them."""
    _, findings = judge_runs("ekf", [a_run(world, sigma_error=0.5) for world in range(worlds)])
    result = next(f for f in findings if f.name == "ekf_pose_consistency")
    assert result.verdict == verdict
    assert ("too large" in result.sentence) == (verdict == "fail")


def test_the_limits_of_the_nees_follow_from_the_number_of_worlds():
    """Six errors of a survey are drawn in a world: the mean of their squares spreads by it."""
    draws = np.random.default_rng(38).standard_normal((20_000, 6, 6))
    for worlds in (1, 6):
        low, high = nees_limits(worlds)
        level = np.mean(draws[:, :worlds] ** 2, axis=(1, 2))
        assert 0.007 < np.mean(level < low) < 0.013
        assert 0.007 < np.mean(level > high) < 0.013


def test_the_machine_growing_slower_is_not_the_estimator_growing_slower():
    run = a_run(0, slower=2.0)
    slowed = np.array(run.pace)
    slowed[:, 5] *= 1.0 + 2.0 * PIECES / PIECES[-1]
    _, findings = judge_runs("ekf", [replace(run, pace=slowed)])
    assert {f.name: f.verdict for f in findings}["ekf_latency"] == "pass"


def test_the_figures_tell_the_slope():
    runs = [a_run(world, slope=np.deg2rad(3.0)) for world in range(8)]
    slope = drift_of(QUANTITIES[1], runs)
    assert abs(slope.per_day - 3.0) < 5.0 * slope.standard_error + 0.1
    figures, findings = judge_runs("ekf", runs)
    assert figures["ekf_attitude_slope_deg_per_day"] == slope.per_day
    reported = next(f.sentence for f in findings if f.name == "ekf_attitude_drift")
    assert "drifts" in reported
    assert "limit 0.05" in reported


def test_the_worst_verdict_is_the_whole():
    assert overall(["pass", "undecided", "pass"]) == "undecided"
    assert overall(["undecided", "fail"]) == "fail"
    assert overall(["pass"]) == "pass"


@pytest.fixture(scope="module")
def short_run():
    return run_world(WorldTask(0, "ekf", SHORT, 1))


@pytest.mark.slow
def test_a_short_run_navigates_within_its_sigmas(short_run):
    errors = short_run.errors
    measured = errors.rows(errors.measured & (errors.time > 60.0))
    assert len(measured) > 150
    assert np.median(measured.size(slice(3, 6))) < 0.02
    assert 0.2 < np.median(measured.pose_nees) / 6.0 < 3.0
    assert "lost and found again" not in short_run.losses


def test_both_estimators_see_the_same_world():
    light, window = (drift_world.draw_task(WorldTask(0, e, 1.0, 1)) for e in ("ekf", "smoother"))
    assert np.array_equal(light.phase, window.phase)
    a, b = (w.stretch(0, 1, w.start()) for w in (light, window))
    assert np.array_equal(a.imu.accel_body, b.imu.accel_body)
    assert np.array_equal(a.fields.phasor_sensor, b.fields.phasor_sensor)


@pytest.fixture(scope="module", params=["ekf", pytest.param("smoother", marks=pytest.mark.slow)])
def resumed(request, tmp_path_factory):
    """Return a run that was never interrupted, and one that was, after its first stretch."""
    place = tmp_path_factory.mktemp("unfinished")
    task = WorldTask(0, request.param, SHORT, 1)
    whole = run_world(task)
    usual, calls = drift_world.navigate, []

    def interrupted(*given):
        calls.append(given)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return usual(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drift_world, "navigate", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_world(replace(task, place=str(place)))
    assert drift_world.stretches_done([replace(task, place=str(place))]) == 1
    again = run_world(replace(task, place=str(place)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drift_world, "navigate", None)
        once_more = run_world(replace(task, place=str(place)))
    return whole, again, once_more


@pytest.mark.slow
def test_a_run_that_was_interrupted_ends_with_the_same_figures(resumed):
    whole, again, _ = resumed
    for field in fields(ErrorSeries):
        assert np.array_equal(getattr(whole.errors, field.name), getattr(again.errors, field.name))
    assert whole.losses == again.losses
    for column in (0, 2, 4):  # not processor time, not memory
        assert np.array_equal(whole.pace[:, column], again.pace[:, column], equal_nan=True)


@pytest.mark.slow
def test_a_finished_run_is_not_run_again(resumed):
    _, again, once_more = resumed
    assert np.array_equal(again.errors.error, once_more.errors.error)
    assert again.losses == once_more.losses


def unfinished(output, settings):
    """Leave the directory of a run that was interrupted at once."""
    task = settings.tasks(output / "unfinished")[0]
    task.progress.parent.mkdir(parents=True)
    write_checkpoint(Checkpoint(task.key, 1, {}), task.progress)
    return task.progress


def events(condition, *reported, hours=48.0):
    """Return the verdicts of what was reported in a world whose beacon B settles or is changed."""
    run = a_run()
    task = replace(run.task, condition=condition, hours=hours)
    run = replace(run, task=task, reported=reported, event_beacon="B")
    return {one.name: one.verdict for one in judge_events([run])[1]}


def reported(code, beacon, hour):
    return Reported(code, (beacon,), 3600.0 * hour, f"Beacon {beacon} is reported.")


def test_an_event_is_to_be_reported_in_time():
    noon, late = reported("beacon_excluded", "B", 12.1), reported("beacon_excluded", "B", 14.0)
    right, wrong = {"false_findings": "pass"}, {"false_findings": "fail"}
    assert events("exchange", noon) == {**right, "event_reported": "pass"}
    assert events("exchange", late) == {**right, "event_reported": "fail"}
    of_another = reported("beacon_excluded", "A", 12.1)
    assert events("exchange", of_another) == {**wrong, "event_reported": "fail"}
    assert events("exchange", noon, of_another) == {**wrong, "event_reported": "pass"}
    assert events("settlement", reported("settlement", "B", 20.0))["event_reported"] == "pass"
    assert events("settlement", reported("beacon_pose", "B", 2.0))["event_reported"] == "fail"
    assert events("settlement", hours=12.0)["event_reported"] == "undecided"


def test_nothing_is_to_be_reported_that_did_not_happen():
    wrong = reported("settlement", "A", 20.0)
    assert events("usual") == {"false_findings": "pass"}
    assert events("usual", wrong) == {"false_findings": "fail"}
    assert events("usual", reported("lost", "", 20.0)) == {"false_findings": "fail"}
    assert events("common-settlement") == {"false_findings": "pass"}
    assert events("settlement", wrong)["false_findings"] == "fail"
    early = reported("beacon_excluded", "B", 11.0)
    assert events("exchange", early)["false_findings"] == "fail"


def test_the_screen_shows_what_was_reported():
    run = a_run()
    run = replace(run, reported=(reported("settlement", "B", 20.0),))
    figures = summarise(DriftSettings(hours=24.0, worlds=1, estimators=("ekf",)), [run])
    assert ["ekf reports", "20.00 h: settlement: Beacon B is reported."] in lines(figures)


@pytest.mark.slow
def test_the_command_writes_report_picture_and_recording(tmp_path, capsys):
    output = tmp_path / "drift"
    unfinished(output, DriftSettings(seed=5))  # of another run: begun anew without --resume
    arguments = ["drift", "--hours", "0.1", "--estimator", "ekf", "--workers", "1"]
    with pytest.raises(SystemExit) as stopped:
        main([*arguments, "--json", "-o", str(output)])
    assert not stopped.value.code
    assert {p.name for p in output.iterdir()} == {
        "report.html",
        "report.json",
        "drift.png",
        "stability.png",
        "run.rrd",
    }
    report = json.loads((output / "report.json").read_text())
    assert report == json.loads(capsys.readouterr().out.splitlines()[-1])
    assert report["job"] == "drift"
    assert report["verdict"] in ("stable", "unstable", "inconclusive")
    assert report["accel_bias_stability"] == report["ekf_accel_bias_drift_stability"]
    assert report["ekf_bare_loops"] > 0.5
    assert [row["hour"] for row in report["ekf_nees_by_hour"]] == [0.5]
    assert report["condition"] == "usual"
    assert any("95 %" in note for note in report["notes"])
    assert not any(key.startswith("smoother") for key in report)


def test_what_is_in_the_way_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files"):
        run_drift(DriftSettings(hours=0.1), tmp_path)


def test_runs_of_other_settings_are_not_gone_on_with(tmp_path):
    settings = DriftSettings(hours=0.1, seed=1, resume=True)
    unfinished(tmp_path, replace(settings, seed=2))
    with pytest.raises(InputError, match="another log, site or setting"):
        run_drift(settings, tmp_path)


def test_what_is_no_checkpoint_is_refused_and_kept(tmp_path):
    settings = DriftSettings(hours=0.1, estimators=("ekf",), workers=1, resume=True)
    progress = unfinished(tmp_path, settings)
    with pytest.raises(InputError, match="without --resume"):
        run_drift(settings, tmp_path)
    for name in ("progress.bin", "errors.rows", "mine.txt"):
        foreign = progress.with_name(name)
        foreign.write_bytes(b"not of this house")
        for resume in (True, False):
            with pytest.raises(InputError, match=f"{name}: .*is kept"):
                run_drift(replace(settings, resume=resume), tmp_path)
        assert foreign.read_bytes() == b"not of this house"
        foreign.unlink()


def test_progress_is_told_while_the_runs_write(tmp_path, monkeypatch):
    reported = []
    monkeypatch.setattr(drift, "LOOK", 0.01)

    def run_many(_task, tasks, **_others):
        for number in range(2):
            tasks[0].progress.parent.mkdir(exist_ok=True)
            write_checkpoint(Checkpoint(tasks[0].key, number + 1, {}), tasks[0].progress)
            time.sleep(0.2)
        raise KeyboardInterrupt

    monkeypatch.setattr("magfusion.jobs.drift.run_many", run_many)
    settings = DriftSettings(hours=1.0, worlds=2)
    with pytest.raises(KeyboardInterrupt):
        run_drift(settings, tmp_path / "drift", lambda *given: reported.append(given))
    assert {given[2] for given in reported} == {4 * 6}
    assert {1, 2} <= {given[1] for given in reported}
    assert (tmp_path / "drift" / "unfinished" / "world_0_ekf" / "progress.bin").is_file()


@pytest.mark.parametrize(
    "changes",
    [{"hours": 0.01}, {"hours": float("nan")}, {"worlds": 0}, {"seed": -1}, {"clock_ppm": 1e3}],
)
def test_settings_that_cannot_be_are_refused(changes, tmp_path):
    with pytest.raises(InputError, match="--"):
        run_drift(replace(DriftSettings(), **changes), tmp_path / "drift")
    assert not (tmp_path / "drift").exists()


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_hours_leave_memory_as_it_was(estimator):
    """In a process of its own: another's heap shrinks and grows by what ran before.

    Within any hour the resident memory varies by 9 MiB; in a run of 12 h its level is reached
    after three.  Inertial samples that are kept would add 20 MiB in the hour that is compared.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
        run = alone.submit(run_world, WorldTask(0, estimator, 2.0, 1)).result()
    figures, findings = judge_runs(estimator, [run])
    reported = {f.name.removeprefix(f"{estimator}_"): f.verdict for f in findings}
    assert reported["memory"] == reported["lost"] == "pass"
    assert figures[f"{estimator}_memory_growth_mib"] < 10.0  # MiB


@pytest.mark.slow
def test_a_clock_that_is_believed_turns_the_attitude(tmp_path):
    """The test can fail: a hundredth of a ppm, taken for none, is a drift of degrees a day."""
    settings = DriftSettings(hours=4.0, estimators=("ekf",), phase_known=True, clock_ppm=0.01)
    trapped = run_world(settings.tasks(tmp_path)[0])
    figures = summarise(settings, [trapped])
    assert figures["ekf_attitude_drift_verdict"] == "fail"
    assert figures["verdict"] == figures["attitude_stability"] == "unstable"
    slope = figures["ekf_attitude_slope_deg_per_day"]
    assert isinstance(slope, float)
    assert slope > 1.0


@pytest.mark.slow
def test_a_bias_that_walks_as_declared_does_not_drift():
    """Of 100 worlds of four hours, whose errors are alike for hours, at most two fail."""
    rng = np.random.default_rng(3)
    stamps = 60.0 * np.arange(240.0)
    failed = 0
    for world in range(100):
        walk = np.cumsum(rng.standard_normal((len(stamps), 15)), axis=0)
        kept = rng.standard_normal(15) * np.sqrt(120.0)
        error = SIGMA * (kept + walk - np.mean(walk, axis=0)) / np.sqrt(200.0)
        run = a_run(world)
        series = replace(
            run.errors,
            time=stamps,
            measured=np.ones(len(stamps), dtype=bool),
            error=error,
            sigma=np.tile(SIGMA, (len(stamps), 1)),
            pose_nees=np.full(len(stamps), 6.0),
            bias_nees=np.full(len(stamps), 6.0),
        )
        own = replace(run, task=replace(run.task, hours=4.0), errors=series)
        slopes, bias = drift_of(QUANTITIES[3], [own]), QUANTITIES[3]
        failed += verdict_of_one(bias, slopes, after_settling(own)) == "fail"
    assert failed <= 2
