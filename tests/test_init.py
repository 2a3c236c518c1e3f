"""The init command: files that the loader reads back, tones of a recording, and its refusals."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command
from scipy.spatial.transform import Rotation

from magfusion.cli import main
from magfusion.errors import InputError
from magfusion.estimation.data_checks.tones import transmitted
from magfusion.files.instruments import imus, magnetometers, named_imu, named_magnetometer
from magfusion.files.log import write_log
from magfusion.files.site import load_site
from magfusion.files.site_draft import beacon_draft, place_of
from magfusion.files.site_text import SiteDraft, site_text
from magfusion.jobs.init import run_init
from magfusion.jobs.init_questions import answered
from magfusion.jobs.init_settings import InitSettings
from magfusion.model.physics.earth import gravity
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.units import DEGREE

MICRO_G = 9.80665e-6  # m/s^2
A = "A position_m=0.5,-1,2 rpy_deg=10,-20,30 frequency_hz=25 moment_a_m2=220 axes=xy"


# What is said comes back ----------------------------------------------------------------------


def test_the_file_holds_what_was_said(tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    settings = InitSettings(
        beacon=(
            f"{A} synchronised=yes radius_m=0.2",
            "B position_m=5,0,1 rpy_deg=0,0,0 frequency_hz=1000,1100,1200 moment_a_m2=1,2,3"
            " axes=zxy",
            "it's: rpy_deg=unknown frequency_hz=30 axes=z",
        ),
        imu="stim 300",
        magnetometer="mag03",
        lever="0.05,-0.02,0.03",
        mounting="0,0,-90",
        location="47.37,8.55,408,2026-03-01",
    )
    figures = run_init(settings, path)
    site = load_site(path, unknown=True)
    first, second, third = site.beacons
    np.testing.assert_array_equal(first.position_world, [0.5, -1.0, 2.0])
    rotated = Rotation.from_euler("xyz", [10.0, -20.0, 30.0], degrees=True).as_matrix()
    np.testing.assert_allclose(first.world_from_beacon, rotated, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(first.moments_beacon, [[220.0, 0.0, 0.0], [0.0, 220.0, 0.0]])
    assert [coil.phase for coil in first.coils] == pytest.approx([0.0, -np.pi / 2])
    assert [coil.radius for coil in first.coils] == [0.2, 0.2]
    assert (first.synchronised, second.synchronised) == (True, False)
    assert list(second.tone_frequencies_hz) == [1000.0, 1100.0, 1200.0]
    np.testing.assert_array_equal(second.moments_beacon, [[0, 0, 1], [2, 0, 0], [0, 3, 0]])
    assert (third.name, third.unknown, len(third.coils)) == ("it's:", "pose", 1)
    assert third.sigma.log_moment[0] == 1.0  # a guess
    np.testing.assert_array_equal(first.sigma.position_world, 0.05)
    np.testing.assert_allclose(first.sigma.rotation_beacon, 2.0 * DEGREE, rtol=1e-12)
    platform = site.platform
    assert platform.imu.gyro_noise == named_imu("STIM300").model.gyro_noise
    np.testing.assert_array_equal(platform.magnetometer.position_body, [0.05, -0.02, 0.03])
    assert platform.magnetometer.body_from_sensor @ [1.0, 0.0, 0.0] == pytest.approx([0, -1, 0])
    assert platform.magnetometer.noise_density == 1e-11
    assert site.gravity == pytest.approx(gravity(47.37, 408.0), abs=1e-4)
    assert site.earth_field_world is not None
    assert 4e-5 < np.linalg.norm(site.earth_field_world) < 5e-5
    assert figures is not None
    assert figures["verdict"] == "doubtful"  # a pose and a moment are wanting
    assert all("beacon it's:" in str(one) for one in figures["reasons"])  # type: ignore[union-attr]


def test_nothing_is_assumed_where_all_is_said(tmp_path: Path) -> None:
    settings = InitSettings(
        beacon=(A,),
        imu="BMI088",
        magnetometer="RM3100",
        lever="0,0,0",
        mounting="0,0,0",
        location="-33.9,18.4,20,2026-03-01",
    )
    figures = run_init(settings, tmp_path / "site.yaml")
    assert figures is not None
    assert figures["verdict"] == "trustworthy"
    assert "TO DO:" not in (tmp_path / "site.yaml").read_text()


def test_every_key_has_its_comment_and_no_line_is_long() -> None:
    draft = SiteDraft(
        (beacon_draft(A), beacon_draft("B frequency_hz=3")),
        named_imu("MEMS"),
        named_magnetometer("RM3100"),
        place_of("47,8,400,2026-01-01"),
    )
    lines = site_text(draft).splitlines()
    headings = ("world:", "beacons:", "platform:", "magnetometer:", "body_from_sensor:", "- {")
    for line in lines[3:]:
        bare = line.strip()
        assert len(line) <= 150
        assert "#" in line or bare.startswith((*headings, "magfusion_site")), line


# Data sheets ----------------------------------------------------------------------------------


def test_the_table_has_the_common_instruments_with_their_sources() -> None:
    assert len(imus()) >= 20
    assert len(magnetometers()) >= 8
    for sheet in imus().values():
        assert len(sheet.source) > 10
        model = sheet.model
        assert 1e-5 < model.gyro_noise < 1e-3
        assert 1e-4 < model.accel_noise < 1e-2
        # The walk takes over between a second and an hour: no bias is white or constant.
        for white, walk in (
            (model.gyro_noise, model.gyro_bias_walk),
            (model.accel_noise, model.accel_bias_walk),
        ):
            assert 1.0 < np.sqrt(1.5) * white / walk < 3600.0


def test_the_units_of_the_sheets_are_converted() -> None:
    bmi = named_imu("bmi_088").model
    assert bmi.gyro_noise == pytest.approx(np.deg2rad(0.014), rel=5e-3)
    assert bmi.accel_noise == pytest.approx(190.0 * MICRO_G, rel=5e-3)
    assert bmi.accel_bias_sigma == pytest.approx(0.020 * 9.80665, rel=5e-3)
    # A random walk of 0.15 degrees in an hour is what sqrt(3600) seconds of white noise make;
    # one-sided, that noise is larger by sqrt(2).
    stim = named_imu("STIM300").model
    assert stim.gyro_noise == pytest.approx(np.sqrt(2.0) * np.deg2rad(0.15) / 60.0, rel=5e-3)
    # The sheet of the ADIS16470 states both: 0.008 deg/s/sqrt(Hz), 0.34 degrees in an hour.
    adis = named_imu("ADIS16470").model.gyro_noise
    assert adis == pytest.approx(np.sqrt(2.0) * np.deg2rad(0.34) / 60.0, rel=0.01)
    assert named_magnetometer("LIS3MDL").noise_density == pytest.approx(
        4.1e-7 / np.sqrt(77.5), 1e-2
    )


def test_the_walk_of_a_bias_has_its_least_allan_deviation_where_the_sheet_says() -> None:
    model = named_imu("VN-100").model
    white, walk = model.gyro_noise / np.sqrt(2.0), model.gyro_bias_walk
    tau = np.geomspace(0.1, 1e5, 4000)
    least = np.sqrt(np.min(white**2 / tau + walk**2 * tau / 3.0))
    assert least == pytest.approx(np.deg2rad(10.0) / 3600.0, rel=0.01)


# A recording ----------------------------------------------------------------------------------


def _recording() -> Log:
    """Return 40 s of two coils at 25 Hz, one at 31.3 Hz, mains, and a turning sensor."""
    rng = np.random.default_rng(5)
    time = np.arange(0.0, 40.0, 1.0 / 200.0)

    def wave(hertz: float, phase: float = 0.0) -> np.ndarray:
        return np.cos(2.0 * np.pi * hertz * time + phase)[:, None]

    still = 3e-7 * wave(25.0) * [1.0, 0.0, 0.2] + 2e-7 * wave(25.0, -1.5) * [0.0, 1.0, 0.3]
    still = still + 1e-7 * wave(31.3) * [0.6, 0.0, 0.8] + 2e-8 * wave(49.97) * [0.0, 0.0, 1.0]
    still = still + np.array([2e-5, 0.0, -4e-5])
    turns = Rotation.from_rotvec(0.3 * np.sin(0.8 * time)[:, None] * [0.1, 0.2, 1.0])
    field = turns.inv().apply(still) + 2e-10 * rng.normal(size=(len(time), 3))
    imu = ImuSamples(time, np.zeros((len(time), 3)), np.tile([0.0, 0.0, 9.81], (len(time), 1)))
    return Log("synthetic", 0, "test", imu, Waveform(time, field))


def test_tones_are_told_with_their_coils_and_without_mains() -> None:
    result = transmitted(_recording(), None)
    assert result is not None
    assert [tone.meant_hz for tone in result.tones] == [25.0, 31.3]
    assert [tone.rotating for tone in result.tones] == [True, False]
    for tone, true in zip(result.tones, (25.0, 31.3), strict=True):
        assert abs(tone.frequency_hz - true) < 4.0 * tone.sigma_hz + 1e-6
        assert tone.sigma_hz < 2e-3
    assert any("mains of 50 Hz" in other for other in result.others)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "log"
    write_log(_recording(), path)
    return path


def test_a_log_gives_its_beacons_to_the_file(
    recorded: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run_command("init", "--log", recorded, "-o", tmp_path / "site.yaml", "--json")
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    site = load_site(tmp_path / "site.yaml", unknown=True)
    assert [beacon.frequency_hz for beacon in site.beacons] == [25.0, 31.3]
    assert [len(beacon.coils) for beacon in site.beacons] == [2, 1]
    assert [beacon.unknown for beacon in site.beacons] == ["pose", "pose"]
    assert report["verdict"] == "doubtful"
    assert {one["code"] for one in report["reasons"]} == {"assumed"}


def test_what_is_said_is_held_against_the_recording(recorded: Path, tmp_path: Path) -> None:
    settings = InitSettings(beacon=("A frequency_hz=28.3", "B frequency_hz=25"), log=recorded)
    figures = run_init(settings, tmp_path / "site.yaml")
    assert figures is not None
    findings = {one["code"]: str(one["text"]) for one in figures["reasons"]}  # type: ignore[union-attr,index]
    assert findings["silent_beacon"].startswith("beacon A is not detected at 28.3 Hz")
    assert findings["undeclared_line"].startswith("31.3 Hz")


def test_a_frequency_that_is_wanting_is_found_where_it_can_only_be_one(
    recorded: Path, tmp_path: Path
) -> None:
    rest = InitSettings(beacon=("A frequency_hz=25", "B position_m=0,0,1"), log=recorded)
    run_init(rest, tmp_path / "site.yaml")
    second = load_site(tmp_path / "site.yaml", unknown=True).beacons[1]
    assert (second.frequency_hz, len(second.coils)) == (31.3, 1)
    with pytest.raises(InputError, match=r"25 Hz \(.*, two coils\), 31.3 Hz \(.*, one coil\)"):
        run_init(InitSettings(beacon=("A", "B"), log=recorded), tmp_path / "other.yaml")


# Questions ------------------------------------------------------------------------------------


def test_questions_are_asked_again_until_the_answer_can_be_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    answers = iter(
        [
            *("A", "", "25 Hz", "25", "", "220", "0, 0, 1", "0,0", "0,0,90", "yes", ""),
            *("bmi", "BMI088", "RM3100", "", "", "47,8,400,2026-01-01"),
        ]
    )
    given = "magfusion.jobs.init_questions.Prompt.ask"
    monkeypatch.setattr(given, lambda *_args, default, **_more: next(answers) or default)
    settings = answered(InitSettings(), ())
    assert settings.beacon == (
        "A frequency_hz=25 axes=xy moment_a_m2=220 position_m=0,0,1 rpy_deg=0,0,90"
        " synchronised=yes",
    )
    assert settings.imu == "BMI088"
    findings = capsys.readouterr().err
    assert "it is required here" in findings
    assert "did you mean BMI055" in findings
    run_init(settings, tmp_path / "site.yaml")
    assert load_site(tmp_path / "site.yaml").beacons[0].synchronised
    assert next(answers, None) is None


# Refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("findings", "sentence"),
    [
        ("", "begin with the beacon's name"),
        ("position_m=0,0,1", "begin with the beacon's name"),
        ("A position_m=0,0,1 freq=20", "freq is not a known key; write one of position_m"),
        ("A position_m=0,0 frequency_hz=20", "write 3 numbers"),
        ("A position_m= 0,0,1 frequency_hz=20", "write no blanks about ="),
        ("A position_m=0,0,nan frequency_hz=20", "write 3 numbers"),
        ("A frequency_hz=-20", "must be above zero"),
        ("A frequency_hz=20 frequency_hz=30", "given twice"),
        ("A frequency_hz=20 axes=xx", "beacon axis of each coil once"),
        ("A frequency_hz=20,30 axes=x", "2 numbers for 1 axes"),
        ("A frequency_hz=20 axes=xyz", "cannot be separated"),
        ("A frequency_hz=20 synchronised=maybe", "write yes or no"),
    ],
)
def test_a_beacon_that_cannot_be_read_is_refused_in_one_sentence(
    findings: str, sentence: str
) -> None:
    with pytest.raises(InputError) as refused:
        beacon_draft(findings)
    assert sentence in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "no description given"),
        (("--beacon", "A position_m=0,0,1"), "frequency_hz is missing"),
        (("--beacon", "A frequency_hz=1e9"), "beacons[0].frequency_hz: found 1000000000.0"),
        (("--beacon", A, "--beacon", A), "is given twice"),
        (("--imu", "nonesuch"), "--list-imus lists them all"),
        (("--magnetometer", "rm310"), "did you mean RM3100"),
        (("--location", "47,8"), "write LATITUDE,LONGITUDE,HEIGHT,DATE"),
        (("--location", "147,8,0,2026-01-01"), "degrees from -90 to 90"),
        (("--location", "47,8,0,1.1.2026"), "give a date as YYYY-MM-DD"),
        (("--lever", "5 cm", "--imu", "MEMS"), "--lever: found '5 cm'; write 3 numbers"),
        (("--log", "nowhere"), "nowhere: there is no such file"),
    ],
)
def test_what_makes_no_site_is_refused_and_nothing_is_written(
    arguments: tuple[str, ...],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    refuse: Refuse,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert sentence in refuse("init", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_there_is_kept(tmp_path: Path, refuse: Refuse) -> None:
    (tmp_path / "site.yaml").write_text("mine")
    assert "already exists" in refuse("init", "--beacon", A, "-o", tmp_path / "site.yaml")
    assert (tmp_path / "site.yaml").read_text() == "mine"


def test_the_instruments_are_listed(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["init", "--list-imus", "--list-magnetometers", "-o", str(tmp_path / "site.yaml")])
    assert not ended.value.code
    shown = capfd.readouterr().out
    assert all(name in shown for name in (*imus(), *magnetometers()))
    assert not (tmp_path / "site.yaml").exists()
