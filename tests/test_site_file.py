"""A site file that is wrong in one place says so in one sentence; a right one loses nothing."""

import dataclasses
import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.site import load_site, save_site
from magfusion.files.site_schema import ClockEntry, EarthEntry, MotionEntry
from magfusion.files.yaml_files import StrictModel
from magfusion.model.physics.earth import earth_field_world
from magfusion.model.site import (
    BeaconSigma,
    ClockModel,
    Coil,
    EarthModel,
    Location,
    MagnetometerSigma,
    MotionModel,
    Site,
)
from magfusion.simulation.demo_site import demo_site
from magfusion.units import DEGREE, Array

LOGS = Path(__file__).parents[1].parent / "shared" / "logs"

PLAIN = """\
magfusion_site: 1
world:
  earth_field_t: [0.0, 1.89e-5, -4.54e-5]
beacons:
  - name: A
    position_m: [0, 0, 0.1]
    rpy_deg: [2, -3, 10]
    frequency_hz: 25
    coils:
      - {moment_a_m2: [221.2, 0, 0]}
      - {moment_a_m2: [0, 221.2, 0], phase_deg: -90}
  - name: B
    position_m: [6, 0, 2]
    rpy_deg: [0, 0, 0]
    frequency_hz: 30
    coils:
      - {moment_a_m2: [0, 0, 100]}
platform:
  imu: {gyro_noise: 2.0e-3, accel_noise: 2.0e-2, gyro_bias_walk: 1.0e-5, accel_bias_walk: 1.0e-3,
        gyro_bias_sigma: 1.0e-2, accel_bias_sigma: 0.1}
  magnetometer:
    noise_density_t_rthz: 2.5e-10
"""

Key = tuple[str | int, ...]
REMOVED = object()
LOCATION = {"latitude_deg": 51.5, "longitude_deg": -0.1, "height_m": 20.0, "date": "2026-03-01"}
NAN, INF = float("nan"), float("inf")

WORLD: Key = ("world",)
BEACON: Key = ("beacons", 0)
COIL: Key = (*BEACON, "coils", 0)
IMU: Key = ("platform", "imu")
MAGNETOMETER: Key = ("platform", "magnetometer")
MOTION: Key = ("platform", "motion")


def _loaded(text: str | bytes, folder: Path) -> Site:
    path = folder / "site.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_site(path)


def _with(*changes: tuple[Key, Any]) -> str:
    """Return the plain site with values set or removed; mappings on the way are made."""
    content = yaml.safe_load(PLAIN)
    for key, value in changes:
        entry: Any = content
        for part in key[:-1]:
            if isinstance(entry, dict):
                entry.setdefault(part, {})
            entry = entry[part]
        if value is REMOVED:
            del entry[key[-1]]
        else:
            entry[key[-1]] = value
    return yaml.safe_dump(content)


def _refusal(text: str | bytes, folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        _loaded(text, folder)
    return str(caught.value)


def _path(key: Key) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).lstrip(".")


def _again(site: Site, folder: Path) -> Site:
    save_site(site, folder / "saved.yaml")
    return load_site(folder / "saved.yaml")


def _assert_same(result: Any, wanted: Any, place: str = "site") -> None:
    """Compare to float precision; values that went through degrees to 1e-12 (rad)."""
    if dataclasses.is_dataclass(wanted):
        assert type(result) is type(wanted), place
        for field in dataclasses.fields(wanted):
            name = field.name
            _assert_same(getattr(result, name), getattr(wanted, name), f"{place}.{name}")
    elif isinstance(wanted, tuple):
        assert len(result) == len(wanted), place
        for i, (a, b) in enumerate(zip(result, wanted, strict=True)):
            _assert_same(a, b, f"{place}[{i}]")
    elif place.endswith(("_from_beacon", "_from_sensor", ".phase")):
        np.testing.assert_allclose(result, wanted, rtol=0.0, atol=1e-12, err_msg=place)
    elif ".rotation_" in place or place.endswith((".phase_walk", ".declination_sigma", "ion_walk")):
        np.testing.assert_allclose(result, wanted, rtol=4e-15, atol=0.0, err_msg=place)
    elif isinstance(wanted, np.ndarray):
        np.testing.assert_array_equal(result, wanted, err_msg=place)
    else:
        assert result == wanted, place


OUT_OF_RANGE: list[tuple[Key, Any, str]] = [
    (("magfusion_site",), 2, "write 1"),
    (("magfusion_site",), True, "write an integer"),
    (("magfusion_site",), "1", "integer"),
    (WORLD, [1], "mapping with the keys gravity_m_s2"),
    ((*WORLD, "gravity_m_s2"), -9.8, "greater than 0"),
    ((*WORLD, "gravity_m_s2"), "9.8", "number"),
    ((*WORLD, "gravity_m_s2"), 10**400, "number"),
    ((*WORLD, "model_error"), -0.01, "greater than or equal to 0"),
    ((*WORLD, "model_error"), 2.0, "less than or equal to 1"),
    ((*WORLD, "model_error"), INF, "finite"),
    ((*WORLD, "earth_field_t"), [0.0, 18900.0, -45400.0], "in T, not nT"),
    ((*WORLD, "earth_field_t"), [0.0, 18.9, -45.4], "in T, not nT"),
    ((*WORLD, "earth_field_t"), [1e308, 1e308, 1e308], "in T, not nT"),
    ((*WORLD, "earth_field_t"), [0.0, 2e-5], "3 numbers"),
    ((*WORLD, "earth_field_t"), [0.0, 2e-5, NAN], "finite"),
    ((*WORLD, "earth_field_t"), {"x": 1}, "3 numbers"),
    ((*WORLD, "location"), LOCATION | {"latitude_deg": 91}, "-90 to 90"),
    ((*WORLD, "location"), 51.5, "mapping with the keys latitude_deg"),
    ((*WORLD, "field_map"), "", "at least 1 character"),
    ((*WORLD, "field_map"), 5, "write text"),
    (("beacons",), [], "at least one beacon"),
    (("beacons",), {}, "list"),
    (BEACON, 5, "mapping with the keys name"),
    ((*BEACON, "name"), "", "at least 1 character"),
    ((*BEACON, "name"), 7, "write text"),
    ((*BEACON, "position_m"), [0, 0], "3 numbers"),
    ((*BEACON, "position_m"), [0, 0, True], "3 numbers"),
    ((*BEACON, "position_m"), [0, 0, "1"], "3 numbers"),
    ((*BEACON, "position_m"), [0, 0, [1]], "3 numbers"),
    ((*BEACON, "position_m"), [0, 0, 10**400], "finite"),
    ((*BEACON, "rpy_deg"), [0, INF, 0], "finite"),
    ((*BEACON, "rpy_deg"), None, "3 numbers"),
    ((*BEACON, "frequency_hz"), 0, "greater than 0"),
    ((*BEACON, "frequency_hz"), -25.0, "greater than 0"),
    ((*BEACON, "frequency_hz"), NAN, "finite"),
    ((*BEACON, "frequency_hz"), "25 Hz", "number"),
    ((*BEACON, "frequency_hz"), True, "number"),
    ((*BEACON, "coils"), [], "at least one coil"),
    ((*BEACON, "synchronised"), "yes", "write true or false"),
    ((*BEACON, "synchronised"), 1, "write true or false"),
    ((*BEACON, "sigma", "position_m"), -0.001, "not negative"),
    ((*BEACON, "sigma", "position_m"), [0.1, 0.1, -0.1], "not negative"),
    ((*BEACON, "sigma", "position_m"), [0.1, 0.1], "one number or a list of 3 numbers"),
    ((*BEACON, "sigma", "rotation_deg"), NAN, "finite"),
    ((*BEACON, "sigma", "rotation_deg"), True, "one number"),
    ((*BEACON, "sigma", "log_moment"), -0.1, "not negative"),
    ((*BEACON, "sigma", "log_moment"), [0.1, -0.1], "not negative"),
    ((*BEACON, "sigma", "log_moment"), [0.1, 0.1, 0.1], "list of 2, one per coil"),
    ((*BEACON, "sigma", "log_moment"), [], "list of 2, one per coil"),
    ((*BEACON, "sigma", "log_moment"), "small", "one number"),
    ((*COIL, "moment_a_m2"), [0, 0, 0], "not zero"),
    ((*COIL, "moment_a_m2"), 221.2, "3 numbers"),
    ((*COIL, "moment_a_m2"), [INF, 0, 0], "finite"),
    ((*COIL, "phase_deg"), NAN, "finite"),
    ((*COIL, "centre_m"), [0, 0], "3 numbers"),
    ((*COIL, "radius_m"), 0.0, "greater than 0"),
    ((*COIL, "length_m"), -0.1, "greater than 0"),
    ((*COIL, "frequency_hz"), 0.0, "greater than 0"),
    ((*COIL, "slot"), -1, "greater than or equal to 0"),
    ((*COIL, "slot"), 0.5, "integer"),
    (("platform",), None, "mapping with the keys imu, imu_intrinsics, magnetometer"),
    ((*IMU, "gyro_noise"), 0.0, "greater than 0"),
    ((*IMU, "accel_noise"), "2e-2 m", "number"),
    ((*IMU, "gyro_bias_walk"), -1e-5, "greater than or equal to 0"),
    ((*IMU, "accel_bias_walk"), INF, "finite"),
    ((*IMU, "gyro_bias_sigma"), -1.0, "greater than or equal to 0"),
    ((*IMU, "accel_bias_sigma"), [0.1], "number"),
    ((*IMU, "time_offset_s"), NAN, "finite"),
    ((*IMU, "time_offset_sigma_s"), -0.01, "greater than or equal to 0"),
    ((*IMU, "clock_rate_ppm"), 2e4, "between -10000 and 10000"),
    ((*IMU, "gyro_range_rad_s"), 0, "greater than 0"),
    ((*IMU, "gyro_range_rad_s"), NAN, "finite number"),
    ((*IMU, "accel_range_m_s2"), -160.0, "greater than 0"),
    ((*MAGNETOMETER, "range_t"), 0.0, "greater than 0"),
    ((*MAGNETOMETER, "range_t"), INF, "finite number"),
    ((*MAGNETOMETER, "range_t"), 1e5, "not nT"),
    ((*IMU, "clock_rate_sigma_ppm"), -1.0, "greater than or equal to 0"),
    ((*MOTION, "rest_gyro_rad_s"), 0.0, "greater than 0"),
    ((*MOTION, "rest_span_s"), 0.1, "greater than or equal to 0.2"),
    ((*MOTION, "speed_sigma_m_s"), "fast", "number"),
    (("clock", "drift_sigma"), -1e-5, "greater than 0"),
    (("clock",), 2e-5, "mapping with the keys drift_sigma, "),
    (("world", "earth", "strength_walk_t"), 1000.0, "in T, not nT"),
    ((*MAGNETOMETER, "offset_walk_t"), 20.0, "in T, not nT"),
    ((*MAGNETOMETER, "body_from_sensor", "rpy_deg"), [0, 0], "3 numbers"),
    ((*MAGNETOMETER, "body_from_sensor", "position_m"), 0.05, "3 numbers"),
    ((*MAGNETOMETER, "noise_density_t_rthz"), 0.25, "not nT"),
    ((*MAGNETOMETER, "noise_density_t_rthz"), 0.0, "greater than 0"),
    ((*MAGNETOMETER, "noise_density_t_rthz"), None, "number"),
    ((*MAGNETOMETER, "matrix"), [[1, 0, 0], [0, 1, 0], [1, 1, 0]], "inverted"),
    ((*MAGNETOMETER, "matrix"), [[0, 0, 0], [0, 0, 0], [0, 0, 0]], "inverted"),
    ((*MAGNETOMETER, "matrix"), [[1, 0], [0, 1]], "3 lists of 3 numbers"),
    ((*MAGNETOMETER, "matrix"), [1, 1, 1], "3 lists of 3 numbers"),
    ((*MAGNETOMETER, "matrix"), [[1, 0, 0], [0, NAN, 0], [0, 0, 1]], "finite"),
    ((*MAGNETOMETER, "offset_t"), [120.0, -40.0, 3.0], "in T, not nT"),
    ((*MAGNETOMETER, "offset_t"), 1e-8, "3 numbers"),
    ((*MAGNETOMETER, "sigma", "matrix"), -0.01, "not negative"),
    ((*MAGNETOMETER, "sigma", "matrix"), [0.01, 0.01, 0.01], "3 lists of 3 numbers"),
    ((*MAGNETOMETER, "sigma", "offset_t"), 40.0, "in T, not nT"),
    ((*MAGNETOMETER, "sigma", "offset_t"), -1e-9, "not negative"),
    ((*MAGNETOMETER, "sigma", "rotation_deg"), INF, "finite"),
    ((*MAGNETOMETER, "sigma", "position_m"), [0, 0], "one number or a list of 3 numbers"),
    (("calibration",), ["log"], "write a mapping"),
]


@pytest.mark.parametrize(
    ("key", "value", "remedy"),
    OUT_OF_RANGE,
    ids=[f"{_path(k)}={v!s:.20}" for k, v, _ in OUT_OF_RANGE],
)
def test_a_bad_value_is_refused_with_its_place_itself_and_the_remedy(
    key: Key, value: Any, remedy: str, tmp_path: Path
) -> None:
    changes = [(key, value)]
    if "location" in key:
        changes.append(((*WORLD, "earth_field_t"), None))
    findings = _refusal(_with(*changes), tmp_path)
    assert findings.startswith(f"{tmp_path / 'site.yaml'}: {_path(key)}"), findings
    result = (
        value["latitude_deg"] if isinstance(value, dict) and value.get("latitude_deg") else value
    )
    assert f"found {result!r:.57}" in findings
    assert remedy in findings
    assert "\n" not in findings
    assert "Entry" not in findings, "a name of our code"
    assert "should be a valid" not in findings, "words of a library"


NEEDED: list[Key] = [
    ("magfusion_site",),
    ("beacons",),
    ("platform",),
    *((*BEACON, key) for key in ("name", "position_m", "rpy_deg", "frequency_hz", "coils")),
    (*COIL, "moment_a_m2"),
    *((*IMU, f"{sensor}_{key}") for sensor in ("gyro", "accel") for key in ("noise", "bias_walk")),
    *((*IMU, f"{sensor}_bias_sigma") for sensor in ("gyro", "accel")),
    MAGNETOMETER,
    (*MAGNETOMETER, "noise_density_t_rthz"),
]


@pytest.mark.parametrize("key", NEEDED, ids=_path)
def test_a_missing_key_is_named(key: Key, tmp_path: Path) -> None:
    assert f": {_path(key)}: is missing; add it" in _refusal(_with((key, REMOVED)), tmp_path)


@pytest.mark.parametrize("key", sorted(LOCATION))
def test_a_location_is_given_whole(key: str, tmp_path: Path) -> None:
    part = {k: v for k, v in LOCATION.items() if k != key}
    findings = _refusal(_with((WORLD, {"location": part})), tmp_path)
    assert f": world.location.{key}: is missing; add it" in findings


@pytest.mark.parametrize(
    "owner",
    [
        (),
        WORLD,
        BEACON,
        (*BEACON, "sigma"),
        COIL,
        ("platform",),
        IMU,
        MOTION,
        ("clock",),
        ("world", "earth"),
        MAGNETOMETER,
        (*MAGNETOMETER, "body_from_sensor"),
        (*MAGNETOMETER, "sigma"),
    ],
    ids=_path,
)
def test_an_unknown_key_is_answered_by_the_known_ones(owner: Key, tmp_path: Path) -> None:
    key = (*owner, "colour")
    findings = _refusal(_with((key, "red")), tmp_path)
    known = {
        (): "beacons",
        WORLD: "earth_field_t",
        BEACON: "frequency_hz",
        COIL: "moment_a_m2",
        ("platform",): "imu",
        IMU: "time_offset_sigma_s",
        MOTION: "rest_gyro_rad_s",
        ("clock",): "drift_sigma",
        ("world", "earth"): "declination_sigma_deg",
        MAGNETOMETER: "noise_density_t_rthz",
        (*MAGNETOMETER, "sigma"): "offset_t",
    }.get(owner, "position_m")
    assert f": {_path(key)}: is not a known key; remove it or write one of" in findings
    assert known in findings


def test_the_first_of_several_mistakes_is_told_and_the_others_counted(tmp_path: Path) -> None:
    changes = [((*BEACON, "frequency_hz"), 0), ((*IMU, "gyro_noise"), 0), ((*COIL, "slot"), -1)]
    findings = _refusal(_with(*changes), tmp_path)
    assert "beacons[0].frequency_hz: found 0" in findings
    assert findings.endswith("(and 2 more in this file).")


@pytest.mark.parametrize(
    ("name", "remedy"), [("=1+1", "a letter or a digit"), ("A\x1b[31m", "printable characters")]
)
def test_a_name_that_a_terminal_or_a_spreadsheet_obeys_is_refused(
    name: str, remedy: str, tmp_path: Path
) -> None:
    for key in ((*BEACON, "name"), (*MAGNETOMETER, "name")):
        sentence = _refusal(_with((key, name)), tmp_path)
        assert _path(key) in sentence
        assert remedy in sentence
        assert "\x1b" not in sentence


def test_two_beacons_of_one_name_are_refused(tmp_path: Path) -> None:
    findings = _refusal(_with((("beacons", 1, "name"), "A")), tmp_path)
    assert "beacons[1].name: found 'A'; give it another name than beacons[0]" in findings


def test_earth_field_and_location_are_not_both_given(tmp_path: Path) -> None:
    findings = _refusal(_with(((*WORLD, "location"), LOCATION)), tmp_path)
    assert "world.earth_field_t: found [0.0, 1.89e-05, -4.54e-05]" in findings
    assert "location, not both" in findings


@pytest.mark.parametrize("date", ["March", "2026-02-30", 5, "2026-03-01 10:00:00", "2040-01-01"])
def test_a_date_that_is_none_or_beyond_the_igrf_is_refused(date: object, tmp_path: Path) -> None:
    findings = _refusal(_with((WORLD, {"location": LOCATION | {"date": date}})), tmp_path)
    assert "world.location.date: found" in findings


@pytest.mark.parametrize(
    ("text", "findings"),
    [
        (b"", "found None at the top; write a mapping"),
        (b"- 1\n- 2", "found [1, 2] at the top; write a mapping"),
        (b"site", "found 'site' at the top"),
        (b"magfusion_site: 1\nworld: {}\nworld: {}", "line 3: key 'world' is repeated"),
        (PLAIN.replace("rpy_deg: [0", "name: C\n    rpy_deg: [0"), "key 'name' is repeated"),
        (b"world: {gravity_m_s2: 1, gravity_m_s2: 2}", "key 'gravity_m_s2' is repeated"),
        (b"a: &a [1]\nb: [*a, *a]", "line 2: aliases are not accepted"),
        (b"&a [*a]", "aliases are not accepted"),
        (b"a: !!python/object/apply:os.system [exit]", "line 1: tags are not accepted"),
        (b"a: !!python/name:os.system", "tags are not accepted"),
        (b"a: !!bool perhaps", "tags are not accepted"),
        (b"\xff\xfe\x00a", "byte 0 is not UTF-8"),
        (b"a: \x00", "special characters are not allowed"),
        (b"a: [1, 2", "line 1: "),
        (b"a: b: c", "line 1: mapping values are not allowed here"),
        (b"--- 1\n--- 2", "another document"),
        (b"? [1, 2]\n: 3", "unhashable key"),
        (b"a: 2026-13-45", "month must be in 1..12"),
        (b"a: " + b"9" * 5000, "4300 digits"),
        (b"[" * 100_000, "nested too deeply"),
        (b"{a: " * 100_000, "nested too deeply"),
        (b"#" * (1 << 20) + b"\n" + PLAIN.encode(), "larger than 1048576 bytes"),
    ],
)
def test_what_is_no_yaml_mapping_of_plain_values_is_refused_in_one_sentence(
    text: str | bytes, findings: str, tmp_path: Path
) -> None:
    sentence = _refusal(text, tmp_path)
    assert sentence.startswith(f"{tmp_path / 'site.yaml'}: ")
    assert findings in sentence
    assert "\n" not in sentence


def test_a_file_that_is_not_there_or_is_a_directory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: there is no such file"):
        load_site(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="is a directory"):
        load_site(tmp_path)


def test_what_is_left_out_takes_the_stated_defaults(tmp_path: Path) -> None:
    site = _loaded(_with((WORLD, REMOVED)), tmp_path)
    beacon, imu, magnetometer = site.beacons[0], site.platform.imu, site.platform.magnetometer
    assert (site.gravity, site.model_error) == (9.80665, 0.005)
    assert (site.earth_field_world, site.location, site.calibration) == (None, None, None)
    assert beacon.synchronised
    assert beacon.coils[0].phase == 0.0
    assert beacon.coils[0].radius is beacon.coils[0].length is None
    assert beacon.tones == ((25.0, None),)
    assert (imu.time_offset, imu.time_offset_sigma) == (0.0, 0.01)
    assert (imu.clock_rate, imu.clock_rate_sigma) == (0.0, 5e-5)
    of_sensor = list(vars(magnetometer.sigma).values())
    zeros: list[Array] = [
        beacon.coils[0].centre_beacon,
        *vars(beacon.sigma).values(),
        magnetometer.position_body,
        magnetometer.offset,
        *of_sensor[:4],
    ]
    assert not any(array.any() for array in zeros)
    assert of_sensor[4] == magnetometer.clock_offset == 0.0
    assert [a.shape for a in vars(beacon.sigma).values()] == [(3,), (3,), (2,)]
    assert [a.shape for a in of_sensor[:4]] == [(3, 3), (3,), (3,), (3,)]
    np.testing.assert_array_equal(magnetometer.matrix, np.eye(3))
    np.testing.assert_array_equal(magnetometer.body_from_sensor, np.eye(3))


def test_roll_pitch_yaw_are_turns_about_the_world_axes_x_y_z_in_that_order(tmp_path: Path) -> None:
    roll, pitch, yaw = np.array([20.0, -35.0, 130.0]) * DEGREE
    about_x = [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
    about_y = [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    about_z = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    wanted = np.array(about_z) @ np.array(about_y) @ np.array(about_x)
    sensor = (*MAGNETOMETER, "body_from_sensor", "rpy_deg")
    changes = [((*BEACON, "rpy_deg"), [20, -35, 130]), (sensor, [20.0, -35.0, 130.0])]
    site = _loaded(_with(*changes), tmp_path)
    for result in (site.beacons[0].world_from_beacon, site.platform.magnetometer.body_from_sensor):
        np.testing.assert_allclose(result, wanted, rtol=0.0, atol=1e-15)


def test_a_scalar_sigma_stands_for_every_entry_and_degrees_become_radians(tmp_path: Path) -> None:
    beacon = {"position_m": 0.002, "rotation_deg": [1.0, 2.0, 3.0], "log_moment": 0.1}
    sensor = {"matrix": 0.01, "offset_t": 4e-8, "rotation_deg": 2.0, "position_m": [0, 0, 0.1]}
    changes = [((*BEACON, "sigma"), beacon), ((*MAGNETOMETER, "sigma"), sensor)]
    site = _loaded(_with(*changes), tmp_path)
    wanted = BeaconSigma(np.full(3, 0.002), np.array([1.0, 2.0, 3.0]) * DEGREE, np.full(2, 0.1))
    _assert_same(site.beacons[0].sigma, wanted)
    wanted_sensor = MagnetometerSigma(
        np.full((3, 3), 0.01), np.full(3, 4e-8), np.full(3, 2.0 * DEGREE), np.array([0, 0, 0.1])
    )
    _assert_same(site.platform.magnetometer.sigma, wanted_sensor)


def test_numbers_without_a_point_are_numbers(tmp_path: Path) -> None:
    """YAML 1.1, which PyYAML follows, takes 1e-5 for text."""
    site = _loaded(PLAIN.replace("1.0e-5", "1e-5").replace("25\n", "2e1\n"), tmp_path)
    assert site.platform.imu.gyro_bias_walk == 1e-5
    assert site.beacons[0].frequency_hz == 20.0


@pytest.mark.parametrize("date", ["2026-03-01", "'2026-03-01'", "20260301"])
def test_a_location_gives_the_field_of_the_igrf(date: str, tmp_path: Path) -> None:
    location = f"location: {{latitude_deg: 51.5, longitude_deg: -0.1, height_m: 20, date: {date}}}"
    text = PLAIN.replace("earth_field_t: [0.0, 1.89e-5, -4.54e-5]", location)
    site = _loaded(text, tmp_path)
    assert site.location == Location(51.5, -0.1, 20.0, "2026-03-01")
    day = datetime.date(2026, 3, 1)
    np.testing.assert_array_equal(site.earth_field_world, earth_field_world(51.5, -0.1, 20.0, day))


def test_a_location_is_saved_and_not_the_field_that_follows_from_it(tmp_path: Path) -> None:
    site = _loaded(_with((WORLD, {"location": LOCATION})), tmp_path)
    _assert_same(_again(site, tmp_path), site)
    text = (tmp_path / "saved.yaml").read_text()
    assert "date: 2026-03-01" in text
    assert "earth_field_t" not in text


def test_the_demo_site_survives_its_file(tmp_path: Path) -> None:
    _assert_same(_again(demo_site(), tmp_path), demo_site())


def test_a_site_without_an_earth_field_survives_its_file(tmp_path: Path) -> None:
    site = dataclasses.replace(demo_site(), earth_field_world=None)
    _assert_same(_again(site, tmp_path), site)


def _random_site(rng: np.random.Generator) -> Site:
    """Return the demo site with every option set and every value one of many digits."""
    demo = demo_site()
    coils = tuple(
        Coil(
            moment_beacon=rng.normal(size=3),
            phase=rng.normal(),
            centre_beacon=rng.normal(size=3),
            radius=rng.uniform(0.01, 1.0),
            length=rng.uniform(0.01, 1.0),
            frequency_hz=rng.uniform(10.0, 100.0),
            slot=slot,
        )
        for slot in range(3)
    )
    beacon = dataclasses.replace(
        demo.beacons[0],
        name="1e5",
        position_world=rng.normal(size=3),
        world_from_beacon=Rotation.random(rng=rng).as_matrix(),
        frequency_hz=rng.uniform(10.0, 100.0),
        coils=coils,
        synchronised=False,
        sigma=BeaconSigma(*rng.uniform(1e-6, 1.0, (3, 3))),
    )
    magnetometer = dataclasses.replace(
        demo.platform.magnetometer,
        position_body=rng.normal(size=3),
        body_from_sensor=Rotation.random(rng=rng).as_matrix(),
        noise_density=1e-10 * rng.uniform(),
        matrix=np.eye(3) + 0.1 * rng.normal(size=(3, 3)),
        offset=1e-7 * rng.normal(size=3),
        sigma=MagnetometerSigma(
            rng.uniform(size=(3, 3)),
            1e-8 * rng.uniform(size=3),
            rng.uniform(size=3),
            rng.uniform(size=3),
        ),
    )
    imu = type(demo.platform.imu)(*rng.uniform(1e-6, 1.0, 8), *(rng.uniform(1.0, 1e3, 2) / 1e6))
    ranges = dict(zip(("gyro_range", "accel_range"), rng.uniform(1.0, 99.0, 2), strict=True))
    imu = dataclasses.replace(imu, **ranges)
    motion = MotionModel(*rng.uniform(0.5, 1.0, len(vars(MotionModel()))))
    magnetometer = dataclasses.replace(magnetometer, offset_walk=1e-8 * rng.uniform())
    magnetometer = dataclasses.replace(magnetometer, field_range=1e-3 * rng.uniform())
    return dataclasses.replace(
        demo,
        gravity=rng.uniform(9.7, 9.9),
        model_error=rng.uniform(),
        beacons=(beacon, *demo.beacons[1:]),
        platform=dataclasses.replace(
            demo.platform, imu=imu, magnetometer=magnetometer, motion=motion
        ),
        clock=ClockModel(*rng.uniform(size=len(vars(ClockModel())))),
        earth=EarthModel(*rng.uniform(size=3), 1e-6 * rng.uniform()),
        earth_field_world=1e-5 * rng.normal(size=3),
        calibration={"log": "walk", "determined": ["A.position"], "spread": {"A": [1.5, None]}},
    )


@pytest.mark.parametrize("seed", range(5))
def test_every_option_survives_its_file_to_the_last_digit(seed: int, tmp_path: Path) -> None:
    site = _random_site(np.random.default_rng(seed))
    _assert_same(_again(site, tmp_path), site)


def test_an_earth_field_other_than_the_locations_is_what_is_kept(tmp_path: Path) -> None:
    site = _loaded(_with((WORLD, {"location": LOCATION})), tmp_path)
    assert site.earth_field_world is not None
    assert _again(site, tmp_path).location == site.location
    rotated = dataclasses.replace(site, earth_field_world=1.01 * site.earth_field_world)
    again = _again(rotated, tmp_path)
    assert again.location is None
    _assert_same(again.earth_field_world, rotated.earth_field_world)


@pytest.mark.parametrize(
    ("model", "entry"),
    [(ClockModel, ClockEntry), (EarthModel, EarthEntry), (MotionModel, MotionEntry)],
)
def test_the_keys_of_a_model_are_its_fields_with_their_units(
    model: type[Any], entry: type[StrictModel]
) -> None:
    for key, name in zip(entry.model_fields, vars(model()), strict=True):
        assert key.removeprefix(name) in ("", "_deg", "_t", "_s", "_m_s", "_m_s2", "_rad_s"), key


def test_what_is_as_usual_of_platform_and_clocks_is_not_written(tmp_path: Path) -> None:
    site = _loaded(PLAIN, tmp_path)
    assert (site.clock, site.earth, site.platform.motion) == (
        ClockModel(),
        EarthModel(),
        MotionModel(),
    )
    _assert_same(_again(site, tmp_path), site)
    text = (tmp_path / "saved.yaml").read_text()
    assert not any(key in text for key in ("clock", "motion", "earth:", "walk_t"))
    drill = {"rest_gyro_rad_s": 0.3, "rest_accel_m_s2": 2.0}
    changes = [(("platform", "motion"), drill), (("clock",), {"phase_walk_deg": 5.0})]
    site = _loaded(_with(*changes), tmp_path)
    assert site.platform.motion == MotionModel(rest_gyro=0.3, rest_accel=2.0)
    assert site.clock == ClockModel(phase_walk=5.0 * DEGREE)
    _assert_same(_again(site, tmp_path), site)
    written = yaml.safe_load((tmp_path / "saved.yaml").read_text())
    assert written["platform"]["motion"] == drill
    assert written["clock"] == {"phase_walk_deg": 5.0}


@pytest.mark.parametrize("below_deg", [0.0, 1e-12, 1e-9, 1e-7, 1e-6, 5e-6, 1e-5, 1e-3])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_attitude_near_gimbal_lock_survives_its_file(
    below_deg: float, sign: float, tmp_path: Path
) -> None:
    rpy_deg = [33.0, sign * (90.0 - below_deg), -71.0]
    rotation = Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix()
    demo = demo_site()
    beacon = dataclasses.replace(demo.beacons[0], world_from_beacon=rotation)
    site = dataclasses.replace(demo, beacons=(beacon,))
    _assert_same(_again(site, tmp_path), site)


@pytest.mark.parametrize("name", ["1", "1e5", "no", "null", "2026-01-01", "ä: #b", "<<", " "])
def test_a_name_that_looks_like_something_else_stays_a_name(name: str, tmp_path: Path) -> None:
    demo = demo_site()
    beacon = dataclasses.replace(demo.beacons[0], name=name)
    site = _again(dataclasses.replace(demo, beacons=(beacon,)), tmp_path)
    assert site.beacons[0].name == name


def test_numpy_values_and_tuples_in_the_calibration_are_saved_as_plain_ones(tmp_path: Path) -> None:
    figures = {
        "sigma": np.float64(0.5),
        "epochs": np.int64(3),
        "mean": np.ones(2),
        "by": ("A", "B"),
    }
    site = _again(dataclasses.replace(demo_site(), calibration=figures), tmp_path)
    assert site.calibration == {"sigma": 0.5, "epochs": 3, "mean": [1.0, 1.0], "by": ["A", "B"]}


def test_a_saved_site_reads_as_a_person_would_write_it(tmp_path: Path) -> None:
    save_site(demo_site(), tmp_path / "site.yaml")
    lines = {line.strip() for line in (tmp_path / "site.yaml").read_text().splitlines()}
    assert {
        "- name: A",
        "position_m: [0.0, 0.0, 0.1]",
        "rpy_deg: [2.0, -3.0, 10.0]",
        "rpy_deg: [3.0, 88.0, -35.0]",
        "phase_deg: -90.0",
        "sigma: {position_m: 0.001, rotation_deg: 0.05, log_moment: 0.001}",
    } <= lines


def test_a_site_that_cannot_be_saved_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    path.write_text(PLAIN)
    with pytest.raises(yaml.representer.RepresenterError):
        save_site(dataclasses.replace(demo_site(), calibration={"log": object()}), path)
    assert path.read_text() == PLAIN
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["walk_calibrated", "turn_miscalibrated", "walk_unsynchronised"])
def test_the_shared_logs_sites_load_and_survive(name: str, tmp_path: Path) -> None:
    path = LOGS / name / "site.yaml"
    if not path.is_file():
        pytest.skip(f"shared/logs/{name} is not here")
    site = load_site(path)
    assert [b.name for b in site.beacons] == ["A", "B", "C", "D"]
    assert site.beacons[0].synchronised is (name != "walk_unsynchronised")
    assert site.beacons[0].coils[1].phase == pytest.approx(-np.pi / 2.0, rel=1e-15)
    known = name == "walk_calibrated"
    np.testing.assert_array_equal(
        site.beacons[3].sigma.position_world, np.full(3, 0.001 if known else 0.05)
    )
    _assert_same(_again(site, tmp_path), site)
