"""The check of logs with real inertial motion: nominal ones are trusted, what is wrong is named."""

from pathlib import Path

import pytest

from magfusion.jobs.check import CheckSettings, run_check

LOGS = Path(__file__).parents[1].parent / "shared" / "logs"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not LOGS.is_dir(), reason="the shared logs are not beside the repository"),
]
NOMINAL = ("walk_calibrated", "turn_miscalibrated", "walk_unsynchronised", "fast_nominal")
NAMED = {
    "beacon_silent_30s": ("silent_beacon", "15.1 to 44.9 s"),
    "body_iron_undeclared": ("body_iron", "iron or a magnet is on the body"),
    "imu_gap_10s": ("gap", "25.00 to 35.00 s"),
}
REMARKED = {
    "earth_fast_translation": "repeated_samples",
    "imu_spikes": "imu_spikes",
    "jittered_stamps": "jitter",
    "samples_lost": "samples_lost",
}


def codes(report: object) -> list[str]:
    assert isinstance(report, list)
    return [one["code"] for one in report]


@pytest.mark.parametrize("name", NOMINAL)
def test_nominal_logs_are_trusted(name: str) -> None:
    assert run_check(CheckSettings(log=LOGS / name))["reasons"] == []


@pytest.mark.parametrize("name", NAMED)
def test_what_is_wrong_is_named_first(name: str) -> None:
    reasons = run_check(CheckSettings(log=LOGS / name))["reasons"]
    code, words = NAMED[name]
    assert codes(reasons)[0] == code
    assert isinstance(reasons, list)
    assert words in str(reasons[0])


@pytest.mark.parametrize("name", REMARKED)
def test_what_estimators_cope_with_is_said_and_no_doubt(name: str) -> None:
    report = run_check(CheckSettings(log=LOGS / name))
    assert report["verdict"] == "trustworthy"
    assert REMARKED[name] in codes(report["remarks"])
