"""A stranger's recording, from tables of other names and units to a trajectory that is trusted."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from conftest import run_command

from magfusion.files.log import read_log
from magfusion.jobs.inputs import read_estimate
from magfusion.jobs.simulate import run_simulate
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig
from magfusion.units import DEGREE, STANDARD_GRAVITY


def _write(path: Path, columns: dict[str, np.ndarray]) -> None:
    pa.csv.write_csv(pa.table(columns), path)


def _columns(path: Path, stem: str, factor: float) -> np.ndarray:
    table = pa.parquet.read_table(path)
    return np.column_stack([table[f"{stem}_{axis}"].to_numpy() for axis in "xyz"]) / factor


def _in_names(names: tuple[str, ...], values: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names, values.T, strict=True))


@pytest.mark.slow
def test_a_strangers_recording_leads_to_a_trusted_trajectory(tmp_path: Path) -> None:
    """Of 200 Hz and 1 kHz, in ms since its epoch, deg/s, g and nT."""
    built = tmp_path / "made"
    config = SimulationConfig(DEMO_BOX_WORLD, duration=30.0, magnetometer_rate_hz=1000.0)
    run_simulate(demo_site(), config, built, seed=4)
    stamps = {
        stream: pa.parquet.read_table(built / f"{stream}.parquet")["time_ns"].to_numpy()
        for stream in ("imu", "magnetometer", "truth")
    }
    epoch = read_log(built).epoch_ns
    _write(
        tmp_path / "imu.csv",
        {"t": (stamps["imu"] - epoch) / 1e6}
        | _in_names(("GyrX", "GyrY", "GyrZ"), _columns(built / "imu.parquet", "gyro", DEGREE))
        | _in_names(
            ("AccX", "AccY", "AccZ"), _columns(built / "imu.parquet", "accel", STANDARD_GRAVITY)
        ),
    )
    field = _columns(built / "magnetometer.parquet", "field", 1e-9)
    _write(
        tmp_path / "mag.csv",
        {"time [ms]": (stamps["magnetometer"] - epoch) / 1e6}
        | _in_names(("Bx [nT]", "By [nT]", "Bz [nT]"), field),
    )
    run_command(
        *("import", "--imu", tmp_path / "imu.csv", tmp_path / "mag.csv", "-o", tmp_path / "log"),
        *("--map", "imu.time=t[ms]", "--map", "imu.gyro=GyrX,GyrY,GyrZ[deg/s]"),
        *("--map", "imu.accel=AccX,AccY,AccZ[g]", "--site", built / "site.yaml"),
    )
    assert json.loads((tmp_path / "log" / "report.json").read_text())["verdict"] == "trustworthy"
    site = built / "site.yaml"
    run_command("smooth", tmp_path / "log", "--site", site, "-o", tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"
    truth = pa.parquet.read_table(built / "truth.parquet")
    estimate = read_estimate(tmp_path / "run")
    error = [
        estimate.position_world[:, k]
        - np.interp(
            estimate.time, (stamps["truth"] - epoch) * 1e-9, truth[f"position_{axis}"].to_numpy()
        )
        for k, axis in enumerate("xyz")
    ]
    assert np.sqrt(np.mean(np.sum(np.square(error), axis=0))) < 0.05  # m; the survey's own error
