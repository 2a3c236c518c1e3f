"""The published real measurements (paper 004, Table 1), through real files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest
import table1_real_fields as table1
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.survey import Survey, read_survey, write_survey
from magfusion.model.physics.dipole import dipole_field
from magfusion.papers.p004_fingerprints.equations import distances
from magfusion.papers.p004_fingerprints.rssi import fit_lines, ranges_from_lines, trilaterate


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> table1.Result:
    return table1.run(table1.Config(tmp_path_factory.mktemp("table1")))


def test_the_rows_give_another_mean_position_error_than_the_paper_prints(
    result: table1.Result,
) -> None:
    assert result.printed_rows_position == pytest.approx(0.0950, abs=5e-5)  # m
    assert abs(result.printed_rows_position - table1.PRINTED_POSITION_ERROR) > 0.01  # m


def test_the_rows_give_the_printed_attitude_errors_truncated(result: table1.Result) -> None:
    truncated = np.floor(np.array(result.printed_rows_attitude_deg) * 100.0) / 100.0
    np.testing.assert_allclose(truncated, table1.PRINTED_ATTITUDE_ERROR_DEG, rtol=1e-12)


def test_the_models_locate_as_well_as_expected(
    result: table1.Result,
) -> None:
    assert result.printed_lines_position == pytest.approx(0.204, abs=0.003)  # m
    assert result.refit_lines_position == pytest.approx(0.112, abs=0.003)  # m
    assert result.dipole_position == pytest.approx(0.113, abs=0.003)  # m
    assert result.refit_lines_log_rms == pytest.approx(0.0315, abs=3e-4)
    assert result.dipole_log_rms == pytest.approx(0.0387, abs=3e-4)
    assert result.dipole_height == pytest.approx(-0.27, abs=0.01)  # m


def test_the_printed_lines_do_not_fit_the_amplitudes_beside_them() -> None:
    """Section 3.2 fits them to the amplitudes at the targets; they are off by a constant each."""
    slope, intercept = table1.LINE_SLOPE, table1.LINE_INTERCEPT_LN_NT
    reach = distances(table1.TABLE[:, :3], table1.BEACONS_WORLD)
    off = table1.TABLE[:, 3:6] - (slope * np.log(reach) + intercept)
    np.testing.assert_allclose(np.mean(off, axis=0), [-0.20, 0.04, 0.14], atol=0.005)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(0.153, abs=0.001)  # refitted: 0.0315


def test_csv_and_parquet_carry_the_same_survey(result: table1.Result, tmp_path: Path) -> None:
    other = table1.run(table1.Config(tmp_path, file_name="survey.csv"))
    assert other.dipole_position == pytest.approx(result.dipole_position, rel=1e-6)
    assert other.refit_lines_position == pytest.approx(result.refit_lines_position, rel=1e-6)


def test_the_dipole_amplitude_is_the_rms_of_two_quadrature_dipoles() -> None:
    rng = np.random.default_rng(1)
    position_world = rng.uniform(-3.0, 3.0, (20, 3)) + np.array([3.0, 2.0, 4.0])
    model = table1.CommonDipole(float(np.log(70.0)), -0.2)
    offset = position_world[:, None] - table1.BEACONS_WORLD - [0.0, 0.0, -0.2]
    fields = [dipole_field(offset, 70.0 * np.eye(3)[axis]) for axis in (0, 1)]
    rms = np.sqrt(sum(np.sum(field**2, axis=-1) for field in fields) / 2.0)
    result = np.exp(model.log_amplitude(position_world))
    np.testing.assert_allclose(result, rms, rtol=1e-12)


def test_lines_through_an_inverse_cube_law_locate_exactly() -> None:
    rng = np.random.default_rng(2)
    beacons = np.array([[0.0, 0.0, 0.0], [6.0, 0.5, 0.1], [3.0, 4.0, -0.1], [1.0, 3.0, 2.5]])
    points = rng.uniform([0.5, 0.5, 0.5], [5.0, 4.0, 1.5], (9, 3))
    amplitude = 1e-5 * distances(points, beacons) ** -3.0  # T
    amplitude[0, 1] = np.nan
    lines = fit_lines(distances(points, beacons), amplitude)
    np.testing.assert_allclose(lines.slope, -3.0, rtol=1e-9)
    np.testing.assert_allclose(np.exp(lines.intercept), 1e-5, rtol=1e-9)
    result = trilaterate(ranges_from_lines(lines, amplitude[1]), beacons, np.array([3.0, 2.0, 1.0]))
    np.testing.assert_allclose(result, points[1], atol=1e-8)  # m


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_phasor_survey_with_missing_channels_survives_a_file(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(3)
    phasor = 1e-7 * (rng.standard_normal((4, 2, 3)) + 1j * rng.standard_normal((4, 2, 3)))
    sigma = np.full((4, 2), 3e-10)
    phasor[2, 1], sigma[2, 1] = np.nan, np.nan
    survey = Survey(
        point=np.array([3, 5, 8, 9]),
        position_world=rng.standard_normal((4, 3)),
        world_from_body=Rotation.random(4, random_state=rng).as_matrix(),
        channels=(("A", 0), ("A", 1)),
        sigma=sigma,
        phasor_sensor=phasor,
    )
    path = tmp_path / f"survey{suffix}"
    write_survey(survey, path)
    again = read_survey(path)
    assert again.channels == survey.channels
    assert again.amplitude is None
    assert again.phasor_sensor is not None
    np.testing.assert_array_equal(again.point, survey.point)
    np.testing.assert_allclose(again.phasor_sensor, phasor, rtol=1e-12)
    np.testing.assert_allclose(again.sigma, sigma, rtol=1e-12)
    np.testing.assert_allclose(again.position_world, survey.position_world, rtol=1e-12)
    np.testing.assert_allclose(again.world_from_body, survey.world_from_body, atol=1e-12)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def _table(tmp_path: Path) -> pa.Table:
    write_survey(table1.build(table1.Config(tmp_path)), tmp_path / "good.csv")
    return pa.csv.read_csv(tmp_path / "good.csv")


@pytest.mark.parametrize(
    ("column", "row", "value", "message"),
    [
        ("amplitude", 4, -1.0, "column amplitude, row 4: found -1.0; write a positive number"),
        ("sigma", 0, float("nan"), "column sigma, row 0: found nan; write a finite number"),
        ("position_x", 1, 0.7, "row 1: found 1; write the same pose in all rows of a point"),
        ("qw", 2, 0.5, "columns qw to qz, row 2: found 0.5; write unit length"),
        ("tone", 3, -1.0, "column tone, row 3: found -1; write an integer from 0"),
        ("point", 3, 1.0, "write one row per point and channel"),
    ],
)
def test_a_bad_value_is_refused_with_its_place(
    tmp_path: Path, column: str, row: int, value: float, message: str
) -> None:
    table = _table(tmp_path)
    values = [float(v) for v in table[column].to_pylist()]
    values[row] = value
    path = tmp_path / "bad.csv"
    index = table.column_names.index(column)
    pa.csv.write_csv(table.set_column(index, column, pa.array(values)), path)
    with pytest.raises(InputError, match=f"bad.csv: .*{message}"):
        read_survey(path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("absent.csv", None, "there is no such file"),
        ("empty.csv", "point,beacon\n", "holds no rows"),
        ("noise.parquet", "not a table", "is no readable survey"),
        ("short.csv", "point,beacon\n1,A\n", "column position_x is missing"),
    ],
)
def test_a_bad_file_is_refused_in_one_sentence(
    tmp_path: Path, name: str, text: str | None, message: str
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_survey(tmp_path / name)


def test_a_survey_holds_either_phasors_or_amplitudes() -> None:
    survey = table1.build(table1.Config(Path()))
    with pytest.raises(ValueError, match="either phasors or amplitudes"):
        replace(survey, amplitude=None)
