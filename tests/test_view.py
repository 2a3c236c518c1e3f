"""Recordings say what they were given, read back with rerun's own reader."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import Chunk, RrdReader
from scipy.spatial.transform import Rotation

from magfusion.errors import EstimationError, InputError
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.errors import TrajectoryErrors, trajectory_errors
from magfusion.results.recording import COVERAGE, open_viewer, write_recording
from magfusion.results.recording_layout import about_zero, readable_range
from magfusion.results.recording_plots import MAX_ROWS
from magfusion.results.shapes import beads, coverage_shell, ellipsoids
from magfusion.simulation.demo_site import demo_site

SITE = demo_site()
N = 200


def _moving(time: np.ndarray) -> Trajectory:
    angles = np.stack([0.11 * time, 0.2 * np.sin(0.3 * time), 0.1 * np.cos(0.4 * time)], axis=1)
    position = [3.0 + np.sin(0.1 * time), 2.5 + np.cos(0.2 * time), 1.0 + 0.1 * np.sin(time)]
    turn = Rotation.from_euler("ZYX", angles)
    return Trajectory(time, turn.as_matrix(), np.stack(position, axis=1))


TRUTH = _moving(np.concatenate([np.arange(0.0, 15.0, 0.01), np.arange(25.0, 40.0, 0.01)]))


def _estimate() -> Trajectory:
    rng = np.random.default_rng(1)
    true = _moving(0.2 * np.arange(N))
    turn = Rotation.from_matrix(true.world_from_body)
    off = Rotation.from_rotvec(0.01 * rng.standard_normal((N, 3)))
    return replace(
        true,
        world_from_body=(turn * off).as_matrix(),
        position_world=true.position_world + 0.02 * rng.standard_normal((N, 3)),
        gyro_bias_body=1e-3 * rng.standard_normal((N, 3)),
        accel_bias_body=1e-2 * rng.standard_normal((N, 3)),
        pose_cov=np.tile(np.diag([1e-4, 1e-4, 1e-4, 1e-4, 4e-4, 9e-4]), (N, 1, 1)),
    )


def _errors() -> TrajectoryErrors:
    return trajectory_errors(_estimate(), TRUTH)


def _innovations() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(2)
    time = 0.2 * np.arange(N)
    series = {b.name: (time, np.sqrt(rng.chisquare(6, N) / 6.0)) for b in SITE.beacons}
    series["A"][1][10:20] = np.nan
    return series


@pytest.fixture(scope="module")
def chunks(tmp_path_factory: pytest.TempPathFactory) -> list[Chunk]:
    path = tmp_path_factory.mktemp("view") / "run.rrd"
    write_recording(
        path, SITE, _estimate(), truth=TRUTH, errors=_errors(), innovations=_innovations()
    )
    reader = RrdReader(path)
    assert [entry.application_id for entry in reader.recordings()] == ["magfusion"]
    assert len(reader.blueprints()) == 1
    return reader.stream().to_chunks()


def _column(chunks: list[Chunk], entity: str, component: str, static: bool) -> pa.RecordBatch:
    result = [
        chunk.to_record_batch()
        for chunk in chunks
        if chunk.entity_path == f"/{entity}" and chunk.is_static is static
    ]
    return next(batch for batch in result if component in batch.schema.names)


def _series(chunks: list[Chunk], entity: str, component: str) -> tuple[np.ndarray, np.ndarray]:
    batch = _column(chunks, entity, component, static=False)
    nanoseconds = batch.column("time").cast(pa.int64()).to_numpy()
    return 1e-9 * nanoseconds, np.array(batch.column(component).to_pylist())


def _static(chunks: list[Chunk], entity: str, component: str) -> list:
    return _column(chunks, entity, component, static=True).column(component).to_pylist()[0]


def test_the_body_moves_as_the_estimate_does(chunks: list[Chunk]) -> None:
    estimate = _estimate()
    time, position = _series(chunks, "world/estimate/body", "Transform3D:translation")
    _, xyzw = _series(chunks, "world/estimate/body", "Transform3D:quaternion")
    np.testing.assert_allclose(time, estimate.time, atol=1e-9)  # s, the timeline's step
    np.testing.assert_allclose(position[:, 0], estimate.position_world, rtol=1e-6)
    turn = Rotation.from_quat(xyzw[:, 0]).as_matrix()
    np.testing.assert_allclose(turn, estimate.world_from_body, atol=1e-6)  # single precision


def test_error_plots_show_errors_and_three_sigma_in_their_units(chunks: list[Chunk]) -> None:
    errors = _errors()
    for kind, unit, error, sigma in (
        ("position_error_mm", 1e3, errors.position_world, errors.position_sigma_world),
        ("attitude_error_deg", 180.0 / np.pi, errors.attitude_body, errors.attitude_sigma_body),
    ):
        assert sigma is not None
        for i, axis in enumerate("xyz"):
            place = f"plots/{kind}/{axis}"
            _, drawn = _series(chunks, f"{place}/error", "Scalars:scalars")
            _, band = _series(chunks, f"{place}/three_sigma", "Scalars:scalars")
            finite = np.isfinite(drawn[:, 0])
            np.testing.assert_allclose(drawn[finite, 0], unit * error[:, i], rtol=1e-9)
            expected = 3.0 * unit * np.stack([sigma[:, i], -sigma[:, i]], axis=1)
            np.testing.assert_allclose(band[finite], expected, rtol=1e-9)


def test_no_line_is_drawn_across_the_gap_of_the_truth(chunks: list[Chunk]) -> None:
    time, drawn = _series(chunks, "plots/position_error_mm/x/error", "Scalars:scalars")
    breaks = time[np.isnan(drawn[:, 0])]
    assert len(breaks) == 1
    assert 14.7 < breaks[0] < 25.0  # s
    strips = _static(chunks, "world/truth/path", "LineStrips3D:strips")
    assert len(strips) == 2
    np.testing.assert_allclose(strips[0][-1], TRUTH.position_world[1499], rtol=1e-6)
    np.testing.assert_allclose(strips[1][0], TRUTH.position_world[1500], rtol=1e-6)


def test_beacons_stand_where_the_site_has_them(chunks: list[Chunk]) -> None:
    for beacon in SITE.beacons:
        place = f"world/beacons/{beacon.name}"
        [position] = _static(chunks, place, "Transform3D:translation")
        np.testing.assert_allclose(position, beacon.position_world, rtol=1e-6)
        [xyzw] = _static(chunks, place, "Transform3D:quaternion")
        turn = Rotation.from_quat(xyzw).as_matrix()
        np.testing.assert_allclose(turn, beacon.world_from_beacon, atol=1e-6)
        [label] = _static(chunks, f"{place}/centre", "Points3D:labels")
        assert label == f"{beacon.name} {beacon.frequency_hz:g} Hz"
        arrows = np.array(_static(chunks, f"{place}/moments", "Arrows3D:vectors"))
        along = arrows / np.linalg.norm(arrows, axis=1)[:, None]
        np.testing.assert_allclose(along, np.eye(3)[:2], atol=1e-6)


def test_missing_innovations_are_left_out_and_biases_are_drawn(chunks: list[Chunk]) -> None:
    time, rms = _innovations()["A"]
    drawn_time, drawn = _series(chunks, "plots/innovations/beacons/A", "Scalars:scalars")
    shown = np.isfinite(drawn[:, 0])
    kept = np.isfinite(rms)
    np.testing.assert_allclose(drawn_time[shown], time[kept], atol=1e-9)  # s
    np.testing.assert_allclose(drawn[shown, 0], rms[kept], rtol=1e-9)
    _, bias = _series(chunks, "plots/gyro_bias_deg_s/y", "Scalars:scalars")
    gyro_bias = _estimate().gyro_bias_body
    assert gyro_bias is not None
    np.testing.assert_allclose(bias[:, 0], np.rad2deg(gyro_bias[:, 1]), rtol=1e-9)


def test_a_long_log_is_decimated_and_keeps_its_ends(tmp_path: Path) -> None:
    long = _moving(0.01 * np.arange(20_000))
    write_recording(tmp_path / "long.rrd", SITE, long)
    read = RrdReader(tmp_path / "long.rrd").stream().to_chunks()
    time, x = _series(read, "plots/position_m/x", "Scalars:scalars")
    assert len(time) == MAX_ROWS
    np.testing.assert_allclose(time[[0, -1]], long.time[[0, -1]], atol=1e-9)  # s
    np.testing.assert_allclose(x[-1, 0], long.position_world[-1, 0], rtol=1e-9)
    assert not any(chunk.entity_path.startswith("/world/truth") for chunk in read)


def test_a_recording_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    time = np.arange(3.0)
    with pytest.raises(KeyError, match="nobody"):
        write_recording(
            tmp_path / "run.rrd", SITE, _estimate(), innovations={"nobody": (time, time)}
        )
    assert list(tmp_path.iterdir()) == []


def test_beacon_names_need_not_be_words(tmp_path: Path) -> None:
    odd = replace(SITE.beacons[0], name="north / 1")
    site = replace(SITE, beacons=(odd, *SITE.beacons[1:]))
    write_recording(tmp_path / "run.rrd", site, _estimate())
    read = RrdReader(tmp_path / "run.rrd").stream().to_chunks()
    assert any("north" in c.entity_path and c.entity_path.count("/") == 5 for c in read)


def test_the_coverage_shell_is_where_the_field_has_its_rms_level() -> None:
    beacon = SITE.beacons[1]
    phase = 2.0 * np.pi * np.arange(100) / 100.0
    for strip in coverage_shell(beacon, COVERAGE):
        in_phase, quadrature = (dipole_field(strip, c.moment_beacon) for c in beacon.coils)
        field = np.cos(phase)[:, None, None] * in_phase + np.sin(phase)[:, None, None] * quadrature
        rms = np.sqrt(np.mean(np.sum(field**2, axis=-1), axis=0))
        np.testing.assert_allclose(rms, COVERAGE, rtol=1e-9)


def test_ellipsoid_axes_rebuild_the_covariance() -> None:
    rng = np.random.default_rng(3)
    root = rng.standard_normal((5, 3, 3))
    cov_body = root @ np.swapaxes(root, 1, 2)
    turn = Rotation.random(5, random_state=rng).as_matrix()
    half, world = ellipsoids(turn, cov_body)
    rebuilt = np.einsum("nik,nk,njk->nij", world, half**2, world)
    expected = turn @ cov_body @ np.swapaxes(turn, 1, 2)
    np.testing.assert_allclose(rebuilt, expected, atol=1e-12)


def test_beads_are_spaced_along_the_path_not_in_time() -> None:
    slow_then_fast = np.concatenate([np.linspace(0.0, 1.0, 1000), np.linspace(1.0, 5.0, 400)])
    places = beads(slow_then_fast[:, None] * np.array([1.0, 0.0, 0.0]), 0.1)
    assert np.diff(places[:, 0]).max() < 0.12  # m, spacing and one sample
    assert len(places) == pytest.approx(51, abs=1)


def test_a_recording_that_is_not_there_is_not_opened(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        open_viewer(tmp_path / "run.rrd")


def _labels(low: float, high: float) -> int:
    """Return how many multiples of a power of ten are in a range, at most eight apart."""
    step = 10.0 ** np.ceil(np.log10((high - low) / 8.0))
    return int(np.floor(high / step) - np.ceil(low / step)) + 1


def test_an_axis_has_two_labels_and_holds_what_is_drawn() -> None:
    rng = np.random.default_rng(4)
    for _ in range(300):
        size, middle = 10.0 ** rng.uniform(-6.0, 4.0), rng.choice([0.0, 0.1, 30.0])
        values = size * (middle + rng.standard_normal(20))
        values[3] = np.nan
        shown = readable_range(values)
        assert shown is not None
        low, high = shown
        assert low < np.nanmin(values) < np.nanmax(values) < high
        assert _labels(low, high) >= 2
        symmetric = about_zero(values)
        assert symmetric is not None
        assert symmetric[0] == pytest.approx(-symmetric[1])
        assert _labels(*symmetric) >= 3
    assert readable_range(np.full(3, 2.0)) is None
    assert readable_range(np.full(3, np.nan)) is None


def test_the_verdict_stands_above_all_with_the_figures(tmp_path: Path) -> None:
    doubt = Finding("gravity", "Gravity is not of the declared size.", Verdict.DOUBTFUL)
    write_recording(
        tmp_path / "run.rrd", SITE, _estimate(), errors=_errors(), trust=Trust((doubt,))
    )
    read = RrdReader(tmp_path / "run.rrd").stream().to_chunks()
    [text] = _static(read, "verdict", "TextDocument:text")
    heading, _, figures, reason = text.splitlines()
    assert heading == "## ⚠ DOUBTFUL"
    ate = 1e3 * _errors().ate
    sigma = 1e3 * np.sqrt(np.trace(_estimate().pose_cov[0, 3:, 3:]))
    assert f"{N} poses in 39.8 s; error {ate:.2g} mm" in figures
    assert f"sigma {sigma:.2g} mm" in figures
    assert doubt.text in reason


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a display is always there")
def test_without_a_display_the_remedy_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    path = tmp_path / "run.rrd"
    path.touch()
    with pytest.raises(EstimationError, match="serve it to a browser"):
        open_viewer(path)
