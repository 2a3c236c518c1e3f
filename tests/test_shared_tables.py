"""Small tables as strangers write them: read as what they are, by the commands themselves."""

import json
from pathlib import Path

import pytest
from conftest import run_command

RECORDINGS = Path(__file__).parents[1].parent / "shared" / "recordings"
pytestmark = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the shared recordings are not beside the repository"
)
SITE = RECORDINGS / "site.yaml"
TRUTH = RECORDINGS / "truth_at_5_hz"


def _report(capfd: pytest.CaptureFixture[str], *command: str | Path) -> dict[str, object]:
    capfd.readouterr()
    run_command(*command, "--json")
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert isinstance(report, dict)
    return report


@pytest.mark.parametrize("name", ["euroc_without_header", "euroc_float_ns", "euroc_float_s"])
def test_a_euroc_folder_is_smoothed_as_what_it_is(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert _report(capfd, "check", RECORDINGS / name, "--site", SITE)["verdict"] == "trustworthy"
    out = tmp_path / "run"
    smoothed = _report(capfd, "smooth", RECORDINGS / name, "--site", SITE, "-o", out)
    assert smoothed["verdict"] == "trustworthy"
    compared = _report(capfd, "evaluate", out, TRUTH / "truth_10hz.tum")
    ate, aligned = compared["ate_m"], compared["aligned_ate_m"]
    assert isinstance(ate, float)
    assert isinstance(aligned, float)
    assert ate < 0.03  # m; the survey's, as of the import of the same
    assert aligned < 0.002


def test_stamps_in_milliseconds_lose_no_sample(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    tables = [RECORDINGS / "stamps_in_ms" / f"{name}.csv" for name in ("imu", "mag")]
    report = _report(capfd, "import", *tables, "-o", tmp_path / "log")
    assert report["magnetometer_rate_hz"] == pytest.approx(400.0, rel=1e-3)
    assert report["magnetometer_lost_share"] == 0.0
    remarks = json.dumps(report)
    assert "rounded to 1 ms" in remarks


@pytest.mark.parametrize("rate", ["5hz", "10hz"])
def test_a_slow_truth_covers_every_epoch(rate: str, capfd: pytest.CaptureFixture[str]) -> None:
    report = _report(capfd, "evaluate", TRUTH / "estimate.tum", TRUTH / f"truth_{rate}.tum")
    assert report["compared_epochs"] == 149
    assert report["ate_m"] == pytest.approx(0.0168, abs=1e-4)


def test_allan_names_the_axes_of_a_simulator(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    report = _report(capfd, "allan", RECORDINGS / "allan_of_a_simulator", "-o", tmp_path / "out")
    assert "axes x, y, z without noise" in json.dumps(report["reasons"])
    assert report["gyro_noise"] == pytest.approx(1e-3, rel=0.05)  # 0.01 rad/s at 100 Hz


@pytest.mark.slow
def test_biases_that_do_not_walk_are_a_legitimate_model(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = RECORDINGS / "bias_walk_zero"
    assert _report(capfd, "check", log)["verdict"] == "trustworthy"
    out = tmp_path / "run"
    assert _report(capfd, "smooth", log, "-o", out)["verdict"] == "trustworthy"
    compared = _report(capfd, "evaluate", out, TRUTH / "truth_10hz.tum")
    ate = compared["ate_m"]
    assert isinstance(ate, float)
    assert ate < 0.02  # m
