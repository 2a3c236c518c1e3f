"""Attitude from the vector of one field: exact, as uncertain as it says, and honest about folds."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.attitude_table import AttitudeDatabase, read_database, write_database
from magfusion.papers.p001_magnetometer.matching import (
    attitude_with_gravity,
    fold_side,
    match_roll,
    match_roll_pitch,
    predict_field,
    wrap,
)
from magfusion.papers.p001_magnetometer.matching_database import (
    build_database,
    match_interpolated,
    match_nearest,
    prepare,
)
from magfusion.units import DEGREE

FIELD_WORLD = np.array([-4e-6, 2.7e-5, -4.7e-5])  # T
YAW = 1.4  # rad
SIGMA = 3e-7  # T


def attitudes(count: int, seed: int = 1, pitch: tuple[float, float] = (-40.0, 25.0)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = (-180.0, pitch[0], 0.0), (180.0, pitch[1], 0.0)
    rpy = rng.uniform(low, high, (count, 3)) * DEGREE
    rpy[:, 2] = YAW
    return rpy


def matrices(rpy: np.ndarray) -> np.ndarray:
    return Rotation.from_euler("xyz", rpy).as_matrix()


def grid(step_deg: float, pitch: tuple[float, float] = (-60.0, 45.0)) -> AttitudeDatabase:
    angles = (np.arange(-180.0, 180.0, step_deg), np.arange(pitch[0], pitch[1], step_deg), [0.0])
    rpy = np.stack(np.meshgrid(*angles), axis=-1).reshape(-1, 3) * DEGREE
    rpy[:, 2] = YAW
    return AttitudeDatabase(predict_field(rpy, FIELD_WORLD), rpy, "roll-pitch", "grid")


def circle(step_deg: float) -> AttitudeDatabase:
    roll = np.arange(-180.0, 180.0, step_deg) * DEGREE
    rpy = np.stack([roll, np.full_like(roll, 0.2), np.full_like(roll, YAW)], axis=1)
    return AttitudeDatabase(predict_field(rpy, FIELD_WORLD), rpy, "roll", "circle")


def test_the_prediction_is_the_field_in_body_axes() -> None:
    rpy = attitudes(20)
    expected = np.einsum("nij,i->nj", matrices(rpy), FIELD_WORLD)
    np.testing.assert_allclose(predict_field(rpy, FIELD_WORLD), expected, rtol=0, atol=1e-18)


def test_without_noise_the_closed_forms_are_exact() -> None:
    rpy = attitudes(200)
    field_body = predict_field(rpy, FIELD_WORLD)
    both = match_roll_pitch(field_body, YAW, FIELD_WORLD, 1e-12)
    np.testing.assert_allclose(wrap(both.rpy[:, 0] - rpy), 0.0, rtol=0, atol=1e-9)
    roll = match_roll(predict_field(circle(7.0).rpy, FIELD_WORLD), 0.2, YAW, FIELD_WORLD, 1e-12)
    np.testing.assert_allclose(wrap(roll.rpy[:, 0] - circle(7.0).rpy), 0.0, rtol=0, atol=1e-12)


def test_roll_and_pitch_are_those_of_least_distance() -> None:
    rng = np.random.default_rng(2)
    rpy = attitudes(5)
    noisy = predict_field(rpy, FIELD_WORLD) + rng.normal(0.0, 10.0 * SIGMA, (5, 3))
    result = match_roll_pitch(noisy, YAW, FIELD_WORLD, SIGMA)
    for axis in (0, 1):
        for shift in (-1e-3, 1e-3):
            moved = result.rpy[:, 0].copy()
            moved[:, axis] += shift
            distance = np.linalg.norm(predict_field(moved, FIELD_WORLD) - noisy, axis=1)
            assert np.all(distance > result.residual[:, 0])


@pytest.mark.parametrize("kind", ["roll", "roll-pitch"])
def test_the_scatter_is_as_large_as_is_claimed(kind: str) -> None:
    one = np.array([0.7, 0.2, YAW])
    draws = 20_000
    noise = np.random.default_rng(3).normal(0.0, SIGMA, (draws, 3))
    noisy = predict_field(one, FIELD_WORLD) + noise
    if kind == "roll":
        result = match_roll(noisy, 0.2, YAW, FIELD_WORLD, SIGMA)
    else:
        result = match_roll_pitch(noisy, YAW, FIELD_WORLD, SIGMA)
    measured = np.std(result.rpy[:, 0], axis=0)
    np.testing.assert_allclose(measured, np.mean(result.sigma[:, 0], axis=0), rtol=0.03, atol=1e-12)


def test_both_solutions_of_the_pitch_are_returned_and_explain_the_field() -> None:
    yaw = 0.5 * np.pi + 0.1
    # Nose down by 30 to 89 degrees, on both sides of the fold.
    pitch = np.concatenate([np.linspace(32.0, 50.0, 20), np.linspace(68.0, 87.0, 20)]) * DEGREE
    rpy = np.stack([np.linspace(-3.0, 3.0, 40), pitch, np.full(40, yaw)], axis=1)
    field_body = predict_field(rpy, FIELD_WORLD)
    result = match_roll_pitch(field_body, yaw, FIELD_WORLD, 1e-9)
    assert np.all(result.ambiguous)
    assert np.nanmax(result.residual) < 1e-17  # T
    error = np.abs(wrap(result.rpy - rpy[:, None])).max(axis=2)
    np.testing.assert_allclose(error.min(axis=1), 0.0, rtol=0, atol=1e-7)
    assert np.all(np.argmin(error, axis=1) == np.repeat([0, 1], 20))
    side = fold_side(result.rpy[..., 1], yaw, FIELD_WORLD)
    np.testing.assert_allclose(side[:, 0], -side[:, 1], rtol=1e-6, atol=0)


def test_at_the_fold_nothing_is_determined_and_beyond_it_nothing_is_ambiguous() -> None:
    fold = float(np.arctan2(4.7e-5, 2.7e-5))  # nose down, heading along world y
    rpy = np.array([[0.3, fold + 1e-4, 0.5 * np.pi], [0.3, -0.3, 0.5 * np.pi]])
    result = match_roll_pitch(predict_field(rpy, FIELD_WORLD), rpy[:, 2], FIELD_WORLD, SIGMA)
    assert result.determined[:, 0].tolist() == [False, True]
    assert result.ambiguous.tolist() == [True, False]


def test_the_family_of_attitudes_over_yaw_explains_one_vector() -> None:
    field_body = predict_field(np.array([0.4, -0.2, 0.9]), FIELD_WORLD)
    yaw = np.linspace(-np.pi, np.pi, 73)
    family = match_roll_pitch(field_body, yaw, FIELD_WORLD, 1e-9)
    whole = family.determined[:, 0]
    assert whole.sum() > 30
    assert np.max(family.residual[whole, 0]) < 1e-17  # T
    rotated = Rotation.from_matrix(matrices(family.rpy[whole, 0]))
    assert (rotated[0].inv() * rotated).magnitude().max() > 2.0  # rad


@pytest.mark.parametrize(
    ("match", "reported"),
    [
        (lambda h: match_roll(h, 0.0, 0.0, np.array([5e-5, 1e-7, 0.0]), SIGMA), "axis of roll"),
        (lambda h: match_roll_pitch(h, 0.0, np.array([0.0, 5e-5, 0.0]), SIGMA), "axis of pitch"),
        (
            lambda h: attitude_with_gravity(h, h, np.array([0.0, 1e-7, 5e-5]), 1.0, 1.0),
            "vertical",
        ),
    ],
)
def test_an_angle_about_the_field_is_refused(match: object, reported: str) -> None:
    assert callable(match)
    with pytest.raises(InputError, match=reported):
        match(np.array([[1e-5, 2e-5, 4e-5]]))


def test_with_gravity_all_three_angles_are_exact() -> None:
    true = Rotation.random(50, random_state=np.random.default_rng(4))
    field_body = true.apply(FIELD_WORLD, inverse=True)
    force_body = true.apply([0.0, 0.0, 9.8], inverse=True)
    result = attitude_with_gravity(field_body, force_body, FIELD_WORLD, 0.01, 0.02)
    np.testing.assert_allclose(result, true.as_matrix(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("database", [grid(5.0), circle(5.0)], ids=["roll-pitch", "roll"])
def test_every_entry_finds_itself(database: AttitudeDatabase) -> None:
    index = prepare(database)
    np.testing.assert_allclose(index.field_world, FIELD_WORLD, rtol=1e-12, atol=0)
    nearest = match_nearest(index, database.field_body, SIGMA)
    np.testing.assert_array_equal(nearest.rpy[:, 0], database.rpy)
    assert np.all(nearest.residual[:, 0] == 0.0)
    rpy = database.rpy[np.abs(database.rpy[:, 1]) < 0.5]
    inner = match_interpolated(index, predict_field(rpy, FIELD_WORLD), SIGMA)
    np.testing.assert_allclose(wrap(inner.rpy[:, 0] - rpy), 0.0, rtol=0, atol=0.3 * DEGREE)


def test_a_field_that_the_database_does_not_know_is_not_determined() -> None:
    index = prepare(grid(5.0, pitch=(-20.0, 20.0)))
    rpy = np.array([[0.1, 0.1, YAW], [0.1, -1.0, YAW]])
    result = match_nearest(index, predict_field(rpy, FIELD_WORLD), 1e-9)
    assert result.determined[:, 0].tolist() == [True, False]


def distort(field_body: np.ndarray) -> np.ndarray:
    """Soft iron of a vehicle, which no model of a uniform field knows."""
    size = np.linalg.norm(field_body, axis=-1, keepdims=True)
    return field_body + 0.08 * field_body[..., [1, 0, 2]] ** 2 / size


def test_a_database_pays_where_the_platform_distorts_the_field() -> None:
    plain = grid(5.0)
    bent = AttitudeDatabase(distort(plain.field_body), plain.rpy, "roll-pitch", "vehicle")
    index, rpy = prepare(bent), attitudes(300)
    field_body = distort(predict_field(rpy, FIELD_WORLD))
    by_table = match_interpolated(index, field_body, SIGMA).rpy[:, 0] - rpy
    by_model = match_roll_pitch(field_body, YAW, FIELD_WORLD, SIGMA).rpy[:, 0] - rpy
    rms = [np.sqrt(np.mean(wrap(error) ** 2)) / DEGREE for error in (by_table, by_model)]
    assert rms[0] < 0.1 * rms[1]


def test_building_averages_cells_and_is_limited_by_them() -> None:
    rng = np.random.default_rng(5)
    rpy = attitudes(20_000)
    noisy = predict_field(rpy, FIELD_WORLD) + rng.normal(0.0, SIGMA, (20_000, 3))
    built = build_database(noisy, matrices(rpy), "log", step=5.0 * DEGREE)
    assert built.database.angles == "roll-pitch"
    assert built.beyond_fold == 0
    assert 72 * 13 <= len(built.database) <= 72 * 14
    assert prepare(built.database).sigma < 0.35 * SIGMA


def test_a_turn_about_a_vertical_axis_is_a_database_of_roll() -> None:
    roll = np.linspace(-np.pi, np.pi, 2000, endpoint=False)
    downwards = Rotation.from_rotvec([0.0, 0.5 * np.pi, 0.0])
    turn = (downwards * Rotation.from_rotvec(np.outer(roll, [1.0, 0.0, 0.0]))).as_matrix()
    field_body = np.einsum("nij,i->nj", turn, FIELD_WORLD)
    database = build_database(field_body, turn, "table").database
    assert database.angles == "roll"
    result = match_interpolated(prepare(database), field_body, SIGMA)
    np.testing.assert_allclose(wrap(result.rpy[:, 0, 0] - roll), 0.0, rtol=0, atol=1e-4)


def test_building_keeps_to_one_side_of_the_fold_and_a_database_of_both_is_refused() -> None:
    rpy = attitudes(5000, pitch=(-30.0, 88.0))
    field_body = predict_field(rpy, FIELD_WORLD)
    built = build_database(field_body, matrices(rpy), "log", step=3.0 * DEGREE)
    assert 500 < built.beyond_fold < 1500
    assert prepare(built.database).side == -1
    with pytest.raises(InputError, match="both sides"):
        prepare(AttitudeDatabase(field_body, rpy, "roll-pitch", "log"))


@pytest.mark.parametrize(
    ("angles", "reported"), [(None, "gravity"), ("roll", "axis of roll rotates")]
)
def test_three_angles_of_one_vector_are_refused_with_what_is_lacking(
    angles: str | None, reported: str
) -> None:
    turn = Rotation.random(500, random_state=np.random.default_rng(6)).as_matrix()
    field_body = np.einsum("nij,i->nj", turn, FIELD_WORLD)
    with pytest.raises(InputError, match=reported) as refused:
        build_database(field_body, turn, "log", angles)
    assert "\n" not in str(refused.value)


def test_too_few_attitudes_are_refused() -> None:
    rpy = np.repeat(attitudes(3), 100, axis=0)
    with pytest.raises(InputError, match="requires 12"):
        build_database(predict_field(rpy, FIELD_WORLD), matrices(rpy), "log")


@pytest.mark.parametrize("database", [grid(10.0), circle(10.0)], ids=["roll-pitch", "roll"])
def test_a_database_is_read_as_it_was_written(database: AttitudeDatabase, tmp_path: Path) -> None:
    path = tmp_path / "attitudes.parquet"
    write_database(database, path)
    read = read_database(path)
    assert (read.angles, read.source) == (database.angles, database.source)
    np.testing.assert_array_equal(read.field_body, database.field_body)
    np.testing.assert_allclose(read.rpy, database.rpy, rtol=0, atol=1e-15)
    prepare(read)


def test_a_database_of_a_degree_stays_small(tmp_path: Path) -> None:
    database = grid(1.0, pitch=(-35.0, 45.0))
    write_database(database, tmp_path / "attitudes.parquet")
    assert len(database) == 28_800
    assert (tmp_path / "attitudes.parquet").stat().st_size < 2e6


def _spoil(table: pa.Table, name: str, value: object) -> pa.Table:
    column = table[name].to_pylist()
    column[3] = value
    return table.set_column(table.column_names.index(name), name, pa.array(column))


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (lambda t: t.replace_schema_metadata({}), "is no attitude database"),
        (
            lambda t: t.replace_schema_metadata(
                {"magfusion_attitude_database": '{"version": 2, "angles": "roll", "source": ""}'}
            ),
            "another version",
        ),
        (lambda t: t.drop_columns(["field_y"]), "field_y is missing"),
        (lambda t: t.slice(0, 5), "5 entries"),
        (lambda t: _spoil(t, "roll_deg", float("nan")), "roll_deg, row 3"),
        (lambda t: _spoil(t, "roll_deg", 200.0), "at most 180"),
        (lambda t: _spoil(t, "field_x", None), "field_x, row 3"),
        (lambda t: t.set_column(0, "field_x", pa.array(["x"] * len(t))), "field_x holds"),
        (
            lambda t: t.set_column(0, "field_x", pa.array(np.full(len(t), 50.0))),
            "another unit",
        ),
    ],
)
def test_a_file_that_is_no_database_is_refused(
    change: object, reported: str, tmp_path: Path
) -> None:
    path = tmp_path / "attitudes.parquet"
    write_database(circle(10.0), path)
    assert callable(change)
    pa.parquet.write_table(change(pa.parquet.read_table(path)), path)
    with pytest.raises(InputError, match=reported) as refused:
        read_database(path)
    assert str(path) in str(refused.value)


def test_what_is_no_parquet_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.parquet").write_text("roll")
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        read_database(tmp_path / "text.parquet")
    with pytest.raises(InputError, match="no such file"):
        read_database(tmp_path / "absent.parquet")
