"""The equations of the four papers: each number is there, and what is said of it is so.

What other tests hold is not repeated: `test_tracker` and `test_antenna` (000),
`test_magnetometer_calibration` (001), `test_beacon_calibration` (002), `test_ellipse`,
`test_direction`, `test_rssi` and `test_fingerprint` (004).
"""

import ast
import inspect
import re
from types import ModuleType

import beacon_calibration
import numpy as np
import pytest
from beacon_calibration import PLACES_WORLD
from beacon_methods import calibrate_as_printed
from scipy.spatial.transform import Rotation

from magfusion.files.attitude_table import AttitudeDatabase
from magfusion.model.antenna import Antenna
from magfusion.model.physics.disturbance import sphere_polarizability
from magfusion.model.physics.winding import Winding
from magfusion.papers.p000_tracker import equations as p000
from magfusion.papers.p001_magnetometer import equations as p001
from magfusion.papers.p001_magnetometer.matching import predict_field
from magfusion.papers.p001_magnetometer.matching_database import nearest_entries, prepare
from magfusion.papers.p002_beacon import equations as p002
from magfusion.papers.p004_fingerprints import equations as p004
from magfusion.simulation.field import phasors_world
from magfusion.units import DEGREE, MU0_OVER_4PI

PAPERS = {"000": (p000, 20), "001": (p001, 20), "002": (p002, 33), "004": (p004, 31)}
NAME = re.compile(r"eq_(\d\d)_\w+")
VERDICT = re.compile(r"\b(Right|Misprint|False|Corrected|Unclear)\b")

# The register ----------------------------------------------------------------------------------


def reported(module: ModuleType) -> dict[str, str]:
    """Return the text under each name of a module, in the order of the file."""
    nodes = ast.parse(inspect.getsource(module)).body
    texts: dict[str, str] = {}
    for node, below in zip(nodes, [*nodes[1:], None], strict=True):
        if isinstance(node, ast.FunctionDef):
            texts[node.name] = ast.get_docstring(node) or ""
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            text = below.value if isinstance(below, ast.Expr) else None
            texts[node.targets[0].id] = str(text.value) if isinstance(text, ast.Constant) else ""
    return {name: text for name, text in texts.items() if NAME.fullmatch(name)}


@pytest.mark.parametrize("paper", PAPERS)
def test_every_number_of_a_paper_is_a_function_or_has_a_reason(paper: str) -> None:
    module, last = PAPERS[paper]
    names = [name for name in vars(module) if NAME.fullmatch(name)]
    numbers = [int(name[3:5]) for name in names]
    assert all(callable(getattr(module, name)) for name in names)
    assert numbers == sorted(numbers), "not in the order of the paper"
    assert set(numbers).isdisjoint(module.NOT_FUNCTIONS)
    assert {*numbers, *module.NOT_FUNCTIONS} == set(range(1, last + 1))


@pytest.mark.parametrize("paper", PAPERS)
def test_every_equation_says_what_is_known_of_it(paper: str) -> None:
    module, _ = PAPERS[paper]
    texts = reported(module)
    assert texts.keys() == {name for name in vars(module) if NAME.fullmatch(name)}
    for name, text in texts.items():
        assert VERDICT.search(text), f"{name} has no verdict"
        if name.endswith("_as_printed"):
            assert re.search(r"\b(Misprint|False)\b", text), f"{name} could do without its suffix"


# 000 -------------------------------------------------------------------------------------------


def test_000_eq_5_needs_one_ambient_vector_and_eq_10_a_moment_a_coil() -> None:
    rng = np.random.default_rng(1)
    attitude = Rotation.random(20, rng=rng).as_matrix()
    position = rng.standard_normal((20, 3))
    sent, seen = (np.eye(3) + 0.1 * rng.standard_normal((3, 3)) for _ in range(2))
    ideal = p000.eq_01_coupling(MU0_OVER_4PI, attitude, position, sent)
    antenna = Antenna(sent.T, np.zeros((3, 3)), seen, np.zeros((3, 3)))
    result = p000.eq_10_coupling(antenna, np.swapaxes(attitude, 1, 2), position).value
    np.testing.assert_allclose(result, seen @ ideal, rtol=0, atol=1e-12 * np.max(np.abs(ideal)))
    silent = np.max(np.abs(ideal)) * rng.standard_normal((20, 3, 1))
    measured = p000.eq_05_coupling(MU0_OVER_4PI, attitude, position, sent, silent * np.ones(3))
    remaining = measured - silent
    np.testing.assert_allclose(remaining, ideal, rtol=0, atol=1e-13 * np.max(np.abs(measured)))


def test_000_eq_18_is_a_rotation_to_first_order_and_eq_20_its_inverse() -> None:
    rng = np.random.default_rng(2)
    point, axis, shift = rng.standard_normal((3, 50, 3))
    for angle in (0.01, 0.1):
        turn = angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)
        actual = p000.eq_18_point_as_printed(point, 1.0, turn, shift)
        rotated = Rotation.from_rotvec(turn).apply(point) + shift
        error = np.linalg.norm(actual - rotated, axis=1) / np.linalg.norm(point, axis=1)
        assert 0.1 * angle**2 < np.max(error) < angle**2
        back = p000.eq_20_ideal_point_as_printed(actual, turn, shift)
        np.testing.assert_allclose(back, point, rtol=0, atol=1e-12)


# 001 -------------------------------------------------------------------------------------------

NED = np.array([2.7e-5, -4e-6, 4.7e-5])  # T
BIAS, SCALE = np.array([6e-6, -2e-6, 3e-6]), np.array([1.1, 0.93, 1.02])
E = np.array([[0.0, 0.02, -0.01], [0.015, 0.0, 0.03], [-0.02, 0.01, 0.0]])
SENSOR = (BIAS, SCALE, E)


def test_001_readings_on_the_table_are_those_of_the_printed_lines() -> None:
    exy, ezy, exz, eyz = E[1, 0], E[1, 2], E[2, 0], E[2, 1]
    signs = np.array([[1, 1, 1], [-1, -1, 1], [1, -1, -1], [-1, 1, -1]])  # north, east, down
    along_z = BIAS[2] + SCALE[2] * (signs * NED) @ [exz, eyz, 1.0]
    along_y = BIAS[1] + SCALE[1] * (signs * NED) @ [exy, 1.0, ezy]
    for position in range(4):
        z = (p001.eq_04_z_at_1, p001.eq_05_z_at_2, p001.eq_06_z_at_3, p001.eq_07_z_at_4)[position]
        y = (p001.eq_12_y_at_1, p001.eq_13_y_at_2, p001.eq_14_y_at_3, p001.eq_15_y_at_4)[position]
        assert z(NED, *SENSOR) == pytest.approx(along_z[position], rel=1e-12)
        assert y(NED, *SENSOR) == pytest.approx(along_y[position], rel=1e-12)
    assert p001.eq_08_sum(along_z) == pytest.approx(4.0 * BIAS[2], rel=1e-9)
    assert p001.eq_09_bias(along_z) == pytest.approx(BIAS[2], rel=1e-9)
    assert p001.eq_10_signed_sum(along_z) == pytest.approx(4.0 * NED[2] * SCALE[2], rel=1e-12)
    assert p001.eq_11_scale(along_z, NED[2]) == pytest.approx(SCALE[2], rel=1e-12)
    assert p001.eq_16_misalignment(along_y, NED[2], SCALE[1]) == pytest.approx(ezy, rel=1e-9)


def test_001_eq_16_finds_what_eq_2_has_with_bz_and_nothing_as_printed() -> None:
    on_table = p001.SENSOR_FROM_NED[:4] @ NED
    for voltage, result in (
        (p001.eq_02_voltage_y, E[1, 2]),
        (p001.eq_02_voltage_y_as_printed, 0.0),
    ):
        readings = voltage(on_table, *SENSOR)
        assert p001.eq_16_misalignment(readings, NED[2], SCALE[1]) == pytest.approx(
            result, abs=1e-9
        )


def test_001_the_database_asks_what_eq_17_to_20_ask() -> None:
    rng = np.random.default_rng(3)
    north = NED * [1.0, 1.0, -1.0]  # world z is up
    for angles, nearest, distance in (
        ("roll", p001.eq_17_nearest, p001.eq_19_distance),
        ("roll-pitch", p001.eq_18_nearest, p001.eq_20_distance),
    ):
        rpy = rng.uniform([-3.0, -0.5, 0.3], [3.0, 0.5, 0.3], (80, 3))
        if angles == "roll":
            rpy[:, 1] = 0.1
        entries = predict_field(rpy, north)
        index = prepare(AttitudeDatabase(entries, rpy, angles, "drawn"))
        requested = entries[:20] + 1e-6 * rng.standard_normal((20, 3))
        separate, row = nearest_entries(index, requested)
        np.testing.assert_array_equal(row[:, 0], nearest(requested, entries))
        np.testing.assert_allclose(
            distance(requested, entries[row[:, 0]]), separate[:, 0], rtol=1e-9
        )


def test_001_eq_18_does_not_see_a_turn_about_the_field() -> None:
    rpy = np.array([0.2, -0.3, 0.4])
    about = Rotation.from_rotvec(2.0 * NED / np.linalg.norm(NED))
    rotated = (about * Rotation.from_euler("xyz", rpy)).as_euler("xyz")
    assert np.max(np.abs(rotated - rpy)) > 1.0  # rad
    separate = p001.eq_20_distance(predict_field(rpy, NED), predict_field(rotated, NED))
    assert separate < 1e-15  # T


# 002 -------------------------------------------------------------------------------------------


def test_002_eq_2_and_3_are_a_coil_of_turns() -> None:
    """Against the exact field on the axis of a current sheet."""
    winding = Winding(8.0, 1, 120, 0.074, 0.002, 0.35 / 120)
    moment, radius, length = p002.eq_03_equivalent_coil(winding)
    assert length == pytest.approx(0.35, rel=1e-4)
    axis = np.linspace(1.0, 4.0, 5)
    offset = axis[:, None] * [0.0, 0.0, 1.0]
    field = p002.eq_02_field(offset, np.array([0.0, 0.0, moment]), radius, length)[:, 2]
    ends = axis[:, None] + 0.5 * 0.35 * np.array([1.0, -1.0])
    cosine = ends / np.hypot(ends, 0.075)
    exact = 2.0 * np.pi * MU0_OVER_4PI * 8.0 * 120 / 0.35 * (cosine[:, 0] - cosine[:, 1])
    np.testing.assert_allclose(field, exact, rtol=2e-5)


def test_002_the_law_of_cosines_and_the_misfit_vanish_at_the_true_centre() -> None:
    places = np.array([[2.0, 2.0, 0.5], [-2.0, 2.0, 0.5], [2.0, -2.0, 0.5], [-2.0, -2.0, 0.7]])
    centre = np.array([0.1, -0.2, 0.05])
    reach = np.linalg.norm(places - centre, axis=1)
    direction = p002.eq_18_direction(centre, places)
    np.testing.assert_allclose(centre + reach[:, None] * direction, places, rtol=0, atol=1e-12)
    length = p002.eq_10_lengths(places)
    assert length[:2] == pytest.approx([4.0, 4.0])  # of the first and the second, and the third
    cosine = p002.eq_09_cosines(direction)
    remaining = p002.eq_11_misfit(reach, cosine, length)
    np.testing.assert_allclose(remaining, 0.0, rtol=0, atol=1e-12)
    assert p002.eq_12_misfit(centre, places, reach) == pytest.approx(0.0, abs=1e-12)
    moved = p002.eq_12_misfit(centre + np.array([0.0, 0.0, 0.01]), places, reach)
    assert moved == pytest.approx(np.sum((0.01 * direction[:, 2]) ** 2), rel=0.05)
    np.testing.assert_allclose(  # what Eq 14-16 say of any orthogonal matrix
        p002.eq_09_cosines(direction @ Rotation.from_rotvec(centre).as_matrix()), cosine, rtol=1e-12
    )


def test_002_eq_26_holds_to_first_order_only() -> None:
    """Noise with both signs: what its mean leaves is the bias, 7 mm of the centre at 5 %."""
    attitude, magnetometers = beacon_calibration.paper_rotation(), PLACES_WORLD[:3]
    beacon = beacon_calibration.beacon(np.zeros(3), attitude)
    phasor = phasors_world(beacon, magnetometers)[:, 0] @ attitude
    coils = np.stack([phasor.real, phasor.imag])
    hemisphere = np.sign((magnetometers @ attitude)[:, 2])
    draws = np.random.default_rng(9).standard_normal((2000, *coils.shape))
    bias = []
    for share in (0.01, 0.05):
        noise = share * np.linalg.norm(coils, axis=-1, keepdims=True) * draws
        drawn = coils + np.concatenate([noise, -noise])
        seen = drawn[:, 0] + 1j * drawn[:, 1]
        result = calibrate_as_printed(seen, magnetometers, beacon_calibration.MOMENT, hemisphere)
        bias.append(np.abs(np.mean(result.centre_world, axis=0)))
    np.testing.assert_allclose(bias[1], [2.7e-3, 6.0e-3, 2.9e-3], rtol=0, atol=1e-3)  # m
    assert np.linalg.norm(bias[1]) / np.linalg.norm(bias[0]) == pytest.approx(25.0, rel=0.15)


# 004 -------------------------------------------------------------------------------------------

MOMENTS = np.array([65.0, 65.0])  # A m^2
TURN = np.arange(40) * 2.0 * np.pi / 40.0  # rad, one period


def places(count: int = 60, seed: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return polar angle, azimuth and distance."""
    rng = np.random.default_rng(seed)
    low, high = [0.05, -np.pi, 1.0], [0.5 * np.pi - 0.01, np.pi, 15.0]
    return tuple(rng.uniform(low, high, (count, 3)).T)


def offsets() -> tuple[np.ndarray, np.ndarray]:
    polar, azimuth, distance = places()
    direction = p004.eq_02_direction(polar, azimuth)
    return direction, direction * distance[:, None]


def test_004_the_fields_are_the_printed_ones() -> None:
    direction, offset = offsets()
    u, v, e = direction.T
    phase, moments = 0.7, np.array([70.0, 50.0])
    first, second = p004.eq_01_coil_fields(offset, moments, phase)
    unit = MU0_OVER_4PI / np.linalg.norm(offset, axis=1) ** 3
    x = np.stack([3 * u**2 - 1, 3 * u * v, 3 * u * e]) * moments[0] * np.cos(phase) * unit
    y = np.stack([3 * u * v, 3 * v**2 - 1, 3 * v * e]) * moments[1] * np.sin(phase) * unit
    np.testing.assert_allclose(first.T / unit, x / unit, rtol=0, atol=1e-11)
    np.testing.assert_allclose(second.T / unit, y / unit, rtol=0, atol=1e-11)
    total = p004.eq_04_field(offset, moments, phase)
    np.testing.assert_allclose(total.T / unit, (x + y) / unit, rtol=0, atol=1e-11)
    moment = np.array([*p004.eq_03_currents(moments, phase), 0.0])
    np.testing.assert_allclose(total, p004.eq_12_field(offset, moment), rtol=0, atol=1e-18)
    size = np.log(np.linalg.norm(total, axis=1))
    np.testing.assert_allclose(p004.eq_13_log_field(offset, moment), size, rtol=1e-12)


def test_004_currents_as_printed_turn_no_field() -> None:
    printed = np.array(p004.eq_03_currents_as_printed(MOMENTS, TURN))
    meant = np.array(p004.eq_03_currents(MOMENTS, TURN))
    assert np.linalg.svd(printed, compute_uv=False)[1] < 1e-12 * np.max(MOMENTS)
    np.testing.assert_allclose(np.hypot(*meant), MOMENTS[0], rtol=1e-12)


def test_004_the_printed_normal_keeps_its_line_and_has_no_mean() -> None:
    direction, offset = offsets()
    printed = p004.eq_05_normal_at(offset[:, None], MOMENTS, TURN)
    unit = (MU0_OVER_4PI * MOMENTS[0] / np.linalg.norm(offset, axis=1) ** 3) ** 2
    scaled = printed / unit[:, None, None]
    normal = p004.eq_05_normal(direction)
    across = np.cross(scaled, normal[:, None])
    np.testing.assert_allclose(across, 0.0, rtol=0, atol=1e-12)
    expected = (np.sin(TURN) * np.cos(TURN))[:, None] * normal[:, None]
    np.testing.assert_allclose(scaled, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.mean(scaled, axis=1), 0.0, rtol=0, atol=1e-12)


def test_004_pairs_a_quarter_period_apart_give_one_normal_of_the_other_sign() -> None:
    direction, offset = offsets()
    fields = p004.eq_04_field(offset[:, None], MOMENTS, TURN)
    later = p004.eq_04_field(offset[:, None], MOMENTS, TURN + 0.5 * np.pi)
    unit = (MU0_OVER_4PI * MOMENTS[0] / np.linalg.norm(offset, axis=1) ** 3) ** 2
    pairs = p004.eq_08_normal(fields, later) / unit[:, None, None]
    normal = p004.eq_05_normal(direction)
    np.testing.assert_allclose(pairs, -normal[:, None] * np.ones((40, 1)), rtol=0, atol=1e-10)
    mean = p004.eq_11_mean_as_printed(pairs)
    np.testing.assert_allclose(mean, -normal, rtol=0, atol=1e-10)
    lost_epochs = p004.eq_11_mean_as_printed(fields) / np.sqrt(unit)[:, None]
    np.testing.assert_allclose(lost_epochs, 0.0, rtol=0, atol=1e-12)
    phasor = fields[:, 0] - 1j * fields[:, 10]
    np.testing.assert_allclose(p004.eq_11_normal(phasor) / unit[:, None], normal, atol=1e-10)


def test_004_pairs_equally_far_apart_give_one_normal_and_any_two_instants_do_not() -> None:
    direction, offset = offsets()
    unit = (MU0_OVER_4PI * MOMENTS[0] / np.linalg.norm(offset, axis=1) ** 3) ** 2
    fields = p004.eq_04_field(offset[:, None], MOMENTS, TURN)
    for step in (0.3, 0.5 * np.pi, 4.0):  # rad
        later = p004.eq_04_field(offset[:, None], MOMENTS, TURN + step)
        pairs = p004.eq_08_normal(fields, later) / unit[:, None, None]
        expected = -np.sin(step) * p004.eq_05_normal(direction)[:, None] * np.ones((len(TURN), 1))
        np.testing.assert_allclose(pairs, expected, rtol=0, atol=1e-10)


def test_004_eq_8_as_printed_makes_eq_7_return_another_direction() -> None:
    """In the rotation of Eq 1, off by 90 degrees less asin(sin(phi_cs) / 3)."""
    direction, offset = offsets()
    earlier, later = (p004.eq_04_field(offset, MOMENTS, phase) for phase in (0.7, 0.7 + np.pi / 2))
    printed = p004.eq_08_normal(earlier, later)
    polar_of_normal = p004.eq_06_polar_of_normal(p004.eq_05_normal(direction))
    expected = 0.5 * np.pi - np.arcsin(np.sin(polar_of_normal) / 3.0)

    def off(normal: np.ndarray) -> np.ndarray:
        found = p004.eq_02_direction(*p004.eq_07_angles(p004.eq_06_polar_of_normal(normal), normal))
        return np.arctan2(
            np.linalg.norm(np.cross(found, direction), axis=1), np.sum(found * direction, axis=1)
        )

    np.testing.assert_allclose(off(printed), expected, rtol=0, atol=1e-7)
    assert np.min(off(printed)) > 70.5 * DEGREE
    np.testing.assert_allclose(off(-printed), 0.0, rtol=0, atol=1e-7)  # B(t1) x B(t2)


def test_004_eq_6_divides_by_z() -> None:
    polar, _, _ = places()
    direction, _ = offsets()
    normal = p004.eq_05_normal(direction)
    tangent = p004.eq_06_tangent_of_polar(polar)
    np.testing.assert_allclose(np.tan(p004.eq_06_polar_of_normal(normal)), tangent, rtol=1e-9)
    assert np.median(np.abs(p004.eq_06_tangent_as_printed(normal) / tangent - 1.0)) > 0.2


def test_004_eq_7_as_printed_finds_every_upper_direction() -> None:
    """Literally, with the angle between normal and z; an arctangent of Eq 6 is another angle."""
    direction = np.random.default_rng(7).standard_normal((100_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction[:, 2] = np.abs(direction[:, 2])
    normal = p004.eq_05_normal(direction)
    size = np.linalg.norm(normal, axis=1)
    polar_of_normal = np.arccos(np.clip(normal[:, 2] / size, -1.0, 1.0))
    above = polar_of_normal > 0.5 * np.pi
    assert np.mean(above) == pytest.approx(np.sqrt(2.0 / 3.0), abs=0.01)  # 3 e^2 < 2
    found = p004.eq_02_direction(*p004.eq_07_angles(polar_of_normal, normal))
    off = np.linalg.norm(np.cross(found, direction), axis=1)
    assert np.max(off) < 3e-10 * DEGREE  # rad
    np.testing.assert_allclose(p004.eq_07_direction(normal), direction, rtol=0, atol=1e-11)
    missed = p004.eq_02_direction(*p004.eq_07_angles(np.arctan(np.tan(polar_of_normal)), normal))
    assert np.all(np.linalg.norm(missed - direction, axis=1)[above] > 1.0)


def test_004_eq_7_has_its_own_value_between_the_branches() -> None:
    polar, _ = p004.eq_07_angles(np.array([0.5 * np.pi]), np.array([[1.0, 0.0, 0.0]]))
    assert 3.0 * np.cos(polar[0]) ** 2 - 2.0 == pytest.approx(0.0, abs=2e-6)


def test_004_the_angular_term_is_no_constant_and_the_printed_intercept_no_moment() -> None:
    direction = np.eye(3)
    moment = np.array([65.0, 0.0, 0.0])
    term = np.exp(p004.eq_14_angular_term(direction, moment))
    np.testing.assert_allclose(term, [130.0, 65.0, 65.0], rtol=1e-12)
    # Table 1 has b of 9.057 to 9.353, ln(nT): 86 to 116 A m^2 of a minor semi-axis.
    for printed, by_print, meant in ((9.353, 716.0, 115.5), (9.057, 532.0, 85.9)):
        assert p004.eq_16_intercept_as_printed(np.log(by_print)) == pytest.approx(printed, abs=2e-3)
        intercept = p004.eq_16_intercept(np.log(meant)) + np.log(1e9)
        assert intercept == pytest.approx(printed, abs=2e-3)


def test_004_the_directions_of_eq_19_lead_from_the_beacons_to_the_target() -> None:
    beacons = np.array([[0.0, 0.0, 0.0], [6.2, 0.54, 0.0], [3.2, 4.28, 0.0]])
    place = np.array([[1.2, 2.4, 0.5], [0.6, 1.8, 0.5]])
    direction = p004.eq_19_direction(place, beacons)
    along = beacons + p004.distances(place, beacons)[..., None] * direction
    np.testing.assert_allclose(along, place[:, None] * np.ones((3, 1)), rtol=0, atol=1e-12)
    polar = np.arccos(direction[..., 2])
    azimuth = np.arctan2(direction[..., 1], direction[..., 0])
    np.testing.assert_allclose(p004.eq_02_direction(polar, azimuth), direction, atol=1e-12)


def test_004_eq_20_has_the_printed_elements_and_eq_23_inverts_it() -> None:
    angles = np.random.default_rng(5).uniform(-1.5, 1.5, (50, 3)) * [1.0, 2.0, 2.0]
    (sp, sg, sl), (cp, cg, cl) = np.sin(angles.T), np.cos(angles.T)
    rows = [
        [cg * cp, cg * sp * sl - sg * cl, cg * sp * cl + sg * sl],
        [sg * cp, sg * sp * sl + cg * cl, sg * sp * cl - cg * sl],
        [-sp, cp * sl, cp * cl],
    ]
    matrix = p004.eq_20_attitude(angles)
    np.testing.assert_allclose(matrix, np.moveaxis(np.array(rows), -1, 0), rtol=0, atol=1e-14)
    np.testing.assert_allclose(p004.eq_23_angles(matrix), angles, rtol=0, atol=1e-9)
    quotients = np.stack([matrix[:, 1, 0] / matrix[:, 0, 0], matrix[:, 2, 1] / matrix[:, 2, 2]], 1)
    wrong = np.abs(np.arctan(quotients) - angles[:, 1:]) > 1.0
    np.testing.assert_array_equal(wrong, np.abs(angles[:, 1:]) > 0.5 * np.pi)


def test_004_the_angles_of_eq_23_are_those_of_the_world_in_the_sensors_axes() -> None:
    yaw, turn = Rotation.from_euler("z", 30.0, degrees=True), Rotation.random(rng=3)
    found = p004.eq_23_angles(yaw.inv().as_matrix()) / DEGREE  # sensor_from_world, Eq 18
    np.testing.assert_allclose(found, [0.0, -30.0, 0.0], atol=1e-9)
    of_sensor = p004.eq_23_angles(turn.as_matrix())
    inverse = p004.eq_23_angles(turn.inv().as_matrix())
    assert np.max(np.abs(inverse + of_sensor)) > 0.1  # not the same with the other sign


def test_004_eq_21_as_printed_is_no_rotation_where_directions_err() -> None:
    rng = np.random.default_rng(6)
    true = Rotation.random(30, rng=rng).as_matrix()
    world = p004.eq_02_direction(*rng.uniform([0.2, -3.0], [1.3, 3.0], (30, 4, 2)).T.swapaxes(1, 2))
    seen = p004.eq_18_pseudo_direction_as_printed(true[:, None], world)
    seen = seen + 0.02 * rng.standard_normal(seen.shape)

    def bent(matrix: np.ndarray) -> np.ndarray:
        gram = np.swapaxes(matrix, 1, 2) @ matrix
        return np.max(np.abs(gram - np.eye(3)), axis=(1, 2))

    assert np.median(bent(p004.eq_21_attitude_as_printed(seen, world))) > 0.02
    nearest = p004.eq_21_attitude(seen, world)
    assert np.max(bent(nearest)) < 1e-12
    separate = Rotation.from_matrix(nearest @ true).magnitude() / DEGREE
    assert np.max(separate) < 10.0


def test_004_rings_make_up_a_conducting_sphere_only_with_lenz_sign() -> None:
    """Rings of one turn, R = 2 pi rho / (conductivity dA), through a sphere in a slow field."""
    radius, conductivity, omega = 0.2, 1e6, 1e-3
    x, weight = np.polynomial.legendre.leggauss(40)
    height = radius * x[:, None]
    widest = np.sqrt(radius**2 - height**2)
    rho = 0.5 * widest * (x + 1.0)
    section = weight[:, None] * weight * radius * 0.5 * widest
    ring = (1.0, np.pi * rho**2, 2.0 * np.pi * rho / (conductivity * section), 1j * omega)
    sphere = sphere_polarizability(radius, 1.0, conductivity, omega)
    assert np.sum(p004.eq_24_ring_moment(*ring)).imag == pytest.approx(sphere.imag, rel=1e-6)
    assert np.sum(p004.eq_24_moment_of_closed_rings(*ring)).imag > 0.0


def test_004_closed_rings_count_once_and_turns_in_series_twice() -> None:
    """The same copper as one ring, in two of half the section: each closed, or both in series."""
    area, resistance, rate = 0.1, 1e-3, 1.0
    one = p004.eq_24_ring_moment(1.0, area, resistance, rate)
    closed = -p004.eq_24_moment_of_closed_rings(2.0, area, 2.0 * resistance, rate)  # R_m of one
    series = p004.eq_24_ring_moment(2.0, area, 4.0 * resistance, rate)  # R_m of both
    assert closed == pytest.approx(one, rel=1e-12)
    assert series == pytest.approx(one, rel=1e-12)
    once = -p004.eq_24_moment_of_closed_rings(2.0, area, 4.0 * resistance, rate)
    assert once == pytest.approx(0.5 * one, rel=1e-12)


def test_004_the_fingerprint_is_the_mean_square_over_time_of_all_tones() -> None:
    rng = np.random.default_rng(7)
    phasor = rng.standard_normal((2, 3)) + 1j * rng.standard_normal((2, 3))
    turn = np.exp(2j * np.pi * np.arange(400)[:, None] / 400.0 * [20.0, 30.0])
    field = np.real(turn[:, :, None] * phasor).sum(axis=1)
    rms = np.sqrt(np.mean(np.sum(field**2, axis=1)))
    assert p004.eq_25_fingerprint(phasor) == pytest.approx(rms, rel=1e-12)


def test_004_ranges_by_fingerprints_are_exact_where_the_line_is_and_as_printed_nowhere() -> None:
    rng = np.random.default_rng(8)
    beacons = np.array([[0.0, 0.0, 0.0], [6.2, 0.54, 0.0], [3.2, 4.28, 0.0]])
    points, place = rng.uniform([1.0, 1.0, 0.4], [5.0, 3.5, 0.6], (4, 3)), np.array([2.6, 2.2, 0.5])
    slope, intercept = np.full(3, -3.0), np.array([9.353, 9.217, 9.057])  # ln(nT), Table 1
    reach = p004.distances(points, beacons)
    known = np.exp(p004.eq_15_log_amplitude(reach, slope, intercept))
    seen = np.exp(p004.eq_15_log_amplitude(p004.distances(place, beacons), slope, intercept))
    ranges = p004.eq_28_range(reach, seen, known, slope)
    true = p004.distances(place, beacons)
    np.testing.assert_allclose(ranges, true * np.ones((4, 1)), rtol=1e-12)
    assert p004.eq_29_misfit(place, beacons, ranges) == pytest.approx(0.0, abs=1e-20)
    printed = p004.eq_28_range_as_printed(known, known, slope, intercept)
    np.testing.assert_allclose(printed, 21.8 * np.ones((4, 3)), rtol=0.1)  # to itself
    # Nor with exact distances: from beacons they are none from fingerprints.
    assert p004.eq_29_misfit_as_printed(place, points, np.abs(ranges - reach)) > 0.01  # m^2


def test_004_eq_28_as_printed_is_22_m_times_a_ratio_of_ranges() -> None:
    beacons = np.array([[0.0, 0.0, 0.0], [6.2, 0.54, 0.0], [3.2, 4.28, 0.0]])
    slope, intercept = np.full(3, -3.0), np.array([9.353, 9.217, 9.057])  # ln(nT), Table 1
    reach = p004.distances(np.array([[1.5, 2.0, 0.5], [1.0, 1.5, 0.5]]), beacons)
    at, known = np.exp(p004.eq_15_log_amplitude(reach, slope, intercept))
    printed = p004.eq_28_range_as_printed(at, known, slope, intercept)
    expected = np.exp(-intercept / slope) * reach[1] / reach[0]
    np.testing.assert_allclose(printed, expected, rtol=1e-12)
    np.testing.assert_allclose(np.exp(-intercept / slope), [22.6, 21.6, 20.5], rtol=5e-3)


def test_004_the_mean_over_fingerprints_meets_one_exactly() -> None:
    place = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    result = p004.eq_27_position(np.array([[0.2, 0.1, 0.4]]), place)
    np.testing.assert_allclose(result, [[10.0 / 17.5, 5.0 / 17.5, 0.0]], rtol=1e-12)
    met = p004.eq_27_position(np.array([[0.2, 0.0, 0.4]]), place)
    np.testing.assert_array_equal(met, place[:, 1])


def test_004_errors_are_means_of_sizes() -> None:
    error = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, -1.0]])
    assert p004.eq_30_mean_position_error(error, np.zeros((2, 3))) == pytest.approx(3.0)
    np.testing.assert_allclose(p004.eq_31_mean_angle_error(error), [7.0 / 3.0, 1.0 / 3.0])
