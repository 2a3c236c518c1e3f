"""What fixes, matches and calibrations say of themselves: clean is trusted, wrong is said."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from conftest import Worked, run_command
from paper_rooms import ROOM, S1, draw_world
from test_antenna_job import make_survey, nominal
from test_calibrate_beacon import written
from test_calibrate_magnetometer_job import miscalibrated
from test_matching_job import RATE, write_turning
from tracker_site import tracker_site

from magfusion.cli import main
from magfusion.errors import EstimationError
from magfusion.estimation.snapshot.priors import contradiction, unexplained
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.files.site import load_site, save_site
from magfusion.files.survey import read_survey, write_survey
from magfusion.jobs.calibrate_log import PartScore, Transfer, transferred
from magfusion.model.trust import CODES, Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

REMEDY = "Survey again."


def changes(rng, count, prior, posterior, independent):
    """Draw changes of a calibration from declared values that are as sure as they say."""
    true = rng.multivariate_normal(np.zeros(len(prior)), prior, count)
    if independent:
        return true + rng.multivariate_normal(np.zeros(len(prior)), posterior, count)
    gain = (prior - posterior) @ np.linalg.inv(prior)  # of a fit that begins at the prior
    noise = gain @ prior - gain @ prior @ gain.T
    return true @ gain.T + rng.multivariate_normal(np.zeros(len(prior)), noise, count)


@pytest.mark.parametrize("independent", [False, True])
def test_honest_declarations_are_contradicted_as_rarely_as_it_is_said(independent):
    rng = np.random.default_rng(1)
    prior = np.diag([1.0, 4.0, 0.01, 9.0])
    data = np.array([[1.0, 0.5, 0.0, 0.0], [0.0, 1.0, 10.0, 0.0]])  # two of four directions
    posterior = np.linalg.inv(np.linalg.inv(prior) + 50.0 * data.T @ data)
    cov = prior + posterior if independent else prior - posterior
    names = ["a", "b", "c", "d"]
    drawn = changes(rng, 4000, prior, posterior, independent)
    findings = [bool(contradiction(names, d, cov, prior, REMEDY).findings) for d in drawn]
    assert np.sum(findings) <= 20 + 3.0 * np.sqrt(20)  # 0.5 %


@pytest.mark.parametrize(
    ("sigmas", "verdict"), [(3.0, None), (5.0, Verdict.DOUBTFUL), (7.0, Verdict.FAILED)]
)
def test_a_parameter_far_from_its_declared_value_is_named(sigmas, verdict):
    prior, change = np.eye(6), np.zeros(6)
    change[2] = sigmas * np.sqrt(0.96)
    result = contradiction(list("abcdef"), change, 0.96 * prior, prior, REMEDY)
    assert [f.verdict for f in result.findings] == ([] if verdict is None else [verdict])
    for finding in result.findings:
        assert f"c by {sigmas:.1f}" in finding.text
        assert finding.text.endswith(REMEDY)
        assert result.excess == pytest.approx(sigmas**2)


def test_many_small_changes_together_contradict_the_site():
    prior = np.eye(40)
    result = contradiction([f"p{i}" for i in range(40)], np.full(40, 2.0), prior, prior, REMEDY)
    assert result.findings[0].verdict is Verdict.FAILED
    assert result.excess == pytest.approx(4.0)


def test_what_the_data_say_nothing_of_contradicts_nothing():
    prior = np.eye(2)
    result = contradiction(["a", "b"], np.array([9.0, 0.1]), np.diag([1e-4, 0.9]), prior, REMEDY)
    assert not result.findings


def test_residuals_are_doubted_where_they_are_larger_and_no_chance():
    rng = np.random.default_rng(2)
    squares = rng.chisquare(30, 5000)
    assert not any(unexplained("beacon A", s, 30, REMEDY).findings for s in squares[:50])
    assert unexplained("beacon A", 9.0 * 30, 30, REMEDY).findings[0].verdict is Verdict.DOUBTFUL
    assert unexplained("beacon A", 9.0 * 30, 30, REMEDY).excess == pytest.approx(9.0)
    assert unexplained("beacon A", 400.0 * 30, 30, REMEDY).findings[0].verdict is Verdict.FAILED
    assert not unexplained("beacon A", 9.0, 2, REMEDY, limit=1e-3).findings  # of two numbers
    assert not unexplained("beacon A", 0.0, 0, REMEDY).findings


ROOT = Path(__file__).parents[1]


def report(directory: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((directory / "report.json").read_text())
    return read


def failing(*arguments: object) -> None:
    """Run a command that must end with exit code 1."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert ended.value.code == 1


def codes(reported: dict[str, Any]) -> list[str]:
    return [reason["code"] for reason in reported["reasons"]]


def test_a_mirrored_fix_is_never_trusted_and_its_covariance_holds_both_poses(
    worked: Worked, tmp_path: Path
) -> None:
    site = load_site(worked.log / "site.yaml")
    save_site(replace(site, beacons=site.beacons[:1]), tmp_path / "one.yaml")
    run_command("simulate", "--site", tmp_path / "one.yaml", "-o", tmp_path / "log",
                "--duration", 10)  # fmt: skip
    run_command("fix", tmp_path / "log", "-o", tmp_path / "fixes")
    reported = report(tmp_path / "fixes")
    assert reported["verdict"] == "doubtful"
    assert "ambiguous" in codes(reported)
    rows = pyarrow.parquet.read_table(tmp_path / "fixes" / "trajectory.parquet").to_pydict()
    assert set(rows["verdict"]) == {"doubtful"}
    assert reported["inside_3_sigma"] > 0.9


@pytest.mark.slow
def test_a_beacon_that_is_not_where_it_should_be_is_left_out_and_told(
    worked: Worked, tmp_path: Path
) -> None:
    site = load_site(worked.log / "site.yaml")
    first, *rest = site.beacons
    moved = replace(first, position_world=first.position_world + np.array([0.3, 0.0, 0.0]))
    save_site(replace(site, beacons=(moved, *rest)), tmp_path / "moved.yaml")
    run_command("fix", worked.log, "--site", tmp_path / "moved.yaml", "-o", tmp_path / "fixes")
    reported = report(tmp_path / "fixes")
    findings = [one["text"] for one in reported["remarks"] if one["code"] == "beacon_excluded"]
    assert f"beacon {first.name} contradict" in findings[0]
    assert reported["nees_mean"] < 12.0


def test_every_code_is_told_in_words() -> None:
    assert list(CODES) == sorted(CODES)
    for code, words in CODES.items():
        assert code.replace("_", "").isalpha()
        assert code.islower()
        assert words[0].islower()
        assert 15 < len(words) < 100
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "docs/troubleshooting.md" in readme  # which has a cause and a remedy of each


def contradicted(directory: Path) -> dict[str, Any]:
    """Return the report of a result that is failed, and nothing else under a result's name."""
    assert {path.name for path in directory.iterdir()} == {"report.json", "failed"}
    reported = report(directory)
    assert reported["verdict"] == "failed"
    return reported


def calibrated_beacon(root: Path, declared_noise: float = 1.0) -> Path:
    """Calibrate by a survey whose sigmas are so many times what they should be."""
    written(root)
    survey = read_survey(root / "survey.parquet")
    write_survey(replace(survey, sigma=declared_noise * survey.sigma), root / "survey.parquet")
    arguments = ("--site", root / "site.yaml", "-o", root / "out")
    run_command("calibrate", "beacon", root / "survey.parquet", *arguments)
    return root / "out"


@pytest.mark.slow
def test_noise_three_times_as_declared_makes_a_beacon_doubtful_and_its_sigmas_larger(
    tmp_path: Path,
) -> None:
    (tmp_path / "as_declared").mkdir()
    (tmp_path / "more").mkdir()
    clean = calibrated_beacon(tmp_path / "as_declared")
    doubtful = calibrated_beacon(tmp_path / "more", declared_noise=1.0 / 3.0)
    assert report(clean)["verdict"] == "trustworthy"
    reported = report(doubtful)
    assert reported["verdict"] == "doubtful"
    assert set(codes(reported)) == {"field_residuals"}
    before, after = (load_site(place / "site.yaml").beacons for place in (clean, doubtful))
    for old, new in zip(before, after, strict=True):
        assert np.all(new.sigma.position_world > 0.6 * old.sigma.position_world)


@pytest.mark.slow
def test_a_beacon_far_from_where_the_site_has_it_fails(tmp_path: Path) -> None:
    site, _ = written(tmp_path)
    certain = replace(site.beacons[0].sigma, position_world=np.full(3, 1e-3))
    beacons = tuple(replace(beacon, sigma=certain) for beacon in site.beacons)
    save_site(replace(site, beacons=beacons), tmp_path / "site.yaml")
    failing("calibrate", "beacon", tmp_path / "survey.parquet",
            "--site", tmp_path / "site.yaml", "-o", tmp_path / "out")  # fmt: skip
    reported = contradicted(tmp_path / "out")
    assert codes(reported)[0] == "prior"
    assert "position" in reported["reasons"][0]["text"]


@pytest.mark.slow
def test_couplings_noisier_than_declared_make_an_antenna_doubtful(tmp_path: Path) -> None:
    true = tracker_site(np.random.default_rng(21))
    save_site(nominal(true), tmp_path / "site.yaml")
    survey = make_survey(true, 40, 1, exact=True)
    arguments = ("--site", tmp_path / "site.yaml", "--pose-rotation-deg", 0, "--pose-position-m", 0)
    for name, scale in (("clean", 1.0), ("noisy", 1.0 / 3.0)):
        path = tmp_path / f"{name}.parquet"
        write_survey(replace(survey, sigma=scale * survey.sigma), path)
        run_command("calibrate", "antenna", path, *arguments, "-o", tmp_path / name)
    assert report(tmp_path / "clean")["verdict"] == "trustworthy"
    assert codes(report(tmp_path / "noisy")) == ["field_residuals"]
    key = "moment_change_a_m2_sigma_largest"
    assert report(tmp_path / "noisy")[key] > 0.8 * report(tmp_path / "clean")[key]


@pytest.fixture(scope="module")
def rotated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of a platform that is turned, with a site whose Earth field is wrong."""
    rests = Rests(2.0, 60.0, 0.0)
    config = SimulationConfig(DEMO_BOX_WORLD, 40.0, "turn", rests=rests, time_offset=0.0)
    site = miscalibrated()
    place = tmp_path_factory.mktemp("turned") / "log"
    write_log(simulate_log(site, config, np.random.default_rng(3)).log, place)
    assert site.earth_field_world is not None
    wrong = replace(site, earth_field_world=1.4 * site.earth_field_world)
    save_site(wrong, place / "site.yaml")
    return place


@pytest.mark.slow
def test_a_field_of_another_size_fails_the_magnetometer(rotated: Path, tmp_path: Path) -> None:
    failing("calibrate", "magnetometer", rotated, "-o", tmp_path / "out")
    assert set(codes(contradicted(tmp_path / "out"))) & {"prior", "earth_field"}


@pytest.mark.slow
def test_a_field_of_another_size_fails_matching(rotated: Path, tmp_path: Path) -> None:
    failing("match", rotated, "--yaw-deg", 10, "-o", tmp_path / "out")
    reported = contradicted(tmp_path / "out")
    assert "earth_field" in codes(reported)
    assert [one["parameter"] for one in reported["unverified"]] == ["earth.field", "given.yaw"]


@pytest.mark.slow
def test_attitudes_of_another_clock_make_no_database(tmp_path: Path) -> None:
    time = np.arange(60.0 * RATE) / RATE
    log = open_log(write_turning(tmp_path / "good", 3, 0.35 * np.sin(0.4 * time)))
    assert log.truth is not None
    late = replace(log.truth, time=log.truth.time + 3.0)
    write_log(replace(log, truth=late), tmp_path / "late")
    save_site(load_site(tmp_path / "good" / "site.yaml"), tmp_path / "late" / "site.yaml")
    arguments = ("calibrate", "attitude-database", "--step-deg", 8)
    run_command(*arguments, tmp_path / "good", "-o", tmp_path / "table")
    assert report(tmp_path / "table")["verdict"] == "trustworthy"
    failing(*arguments, tmp_path / "late", "-o", tmp_path / "none")
    assert codes(contradicted(tmp_path / "none"))[0] == "earth_field"


@pytest.mark.slow
def test_a_map_of_exchanged_beacons_fails(tmp_path: Path) -> None:
    world = draw_world(S1, np.random.default_rng(5), replace(ROOM, spacing=1.5))
    survey = world.survey(np.random.default_rng(6))
    assert survey.phasor_sensor is not None
    names = {"M1": "M2", "M2": "M1"}
    swapped = tuple((names.get(name, name), tone) for name, tone in survey.channels)
    write_survey(replace(survey, channels=swapped), tmp_path / "survey.parquet")
    save_site(world.site, tmp_path / "site.yaml")
    failing("calibrate", "fieldmap", tmp_path / "survey.parquet", "-o", tmp_path / "out")
    assert codes(contradicted(tmp_path / "out"))[0] == "transfer"


@pytest.mark.slow
def test_a_log_that_contradicts_its_survey_is_told(worked: Worked, tmp_path: Path) -> None:
    site = load_site(worked.log / "site.yaml")
    first, *rest = site.beacons
    certain = replace(first.sigma, position_world=np.full(3, 0.02))
    place = first.position_world + np.array([0.2, 0.0, 0.0])
    moved = replace(first, position_world=place, sigma=certain)
    save_site(replace(site, beacons=(moved, *rest)), tmp_path / "moved.yaml")
    failing("calibrate", "log", worked.log, "--site", tmp_path / "moved.yaml",
            "-o", tmp_path / "out")  # fmt: skip
    assert "prior" in codes(contradicted(tmp_path / "out"))


@pytest.mark.slow
def test_whatever_fails_leaves_a_report_that_says_so(
    worked: Worked,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    run_command("calibrate", "log", worked.log, "-o", tmp_path / "out", "--end", 8)
    assert (tmp_path / "out" / "site.yaml").is_file()

    def fails(*_given: object) -> None:
        raise EstimationError("the sky fell")

    monkeypatch.setattr("magfusion.estimation.batch.self_survey.smooth_and_place", fails)
    capfd.readouterr()
    failing("calibrate", "log", worked.log, "-o", tmp_path / "out")
    reported = contradicted(tmp_path / "out")
    assert codes(reported) == ["no_solution"]
    assert capfd.readouterr().out.splitlines()[1] == "FAILED"
    failing("calibrate", "log", worked.log, "-o", tmp_path / "out", "--json")
    assert json.loads(capfd.readouterr().out) == reported


def test_what_failed_is_shown_with_its_reasons(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    site = load_site(worked.log / "site.yaml")
    assert site.earth_field_world is not None
    wrong = replace(site, earth_field_world=2.0 * site.earth_field_world)
    save_site(wrong, tmp_path / "wrong.yaml")
    capfd.readouterr()
    failing("match", worked.log, "--site", tmp_path / "wrong.yaml", "--yaw-deg", 0,
            "-o", tmp_path / "out")  # fmt: skip
    out, err = capfd.readouterr()
    assert out.splitlines()[1] == "FAILED"
    assert contradicted(tmp_path / "out")["verdict"] == "failed"
    assert err.count("\n") == 1


def test_parts_of_a_log_that_disagree_are_told() -> None:
    scores = [PartScore(0.5, None, None)] * 2
    agreed = Transfer(scores, scores, [(0, 1), (1, 0)], 3.0)
    assert not transferred(agreed).findings
    assert transferred(agreed._replace(disagreement=8.0)).verdict is Verdict.DOUBTFUL
    worse = [PartScore(0.9, None, None)] * 2
    assert transferred(agreed._replace(calibrated=worse)).verdict is Verdict.DOUBTFUL
