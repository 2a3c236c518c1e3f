"""Raw samples of several magnetometers: written, read, demodulated each alone, located together."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from test_several_magnetometers import only, two_magnetometers

from magfusion.errors import InputError
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.demodulation.separate_demodulation import demodulated_apart, of_site
from magfusion.estimation.demodulation.temperature_compensation import at_reference
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.fields import by_own_clocks, order_channels
from magfusion.files.log import read_log, write_log
from magfusion.files.site import save_site
from magfusion.jobs.check import CheckSettings, run_check
from magfusion.jobs.demodulate import DemodulateSettings, run_demodulate
from magfusion.jobs.fix import run_fix
from magfusion.jobs.inputs import Job
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.temperature import SensorTemperatureModel
from magfusion.receiver.windows import LockinSettings, default_settings
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log

BOX = np.array([[1.0, 1.0, 0.5], [4.0, 3.0, 1.5]])


@pytest.fixture(scope="module")
def site() -> Site:
    return two_magnetometers(demo_site(coil_radius=None))


@pytest.fixture(scope="module")
def walk(site: Site) -> SimulatedLog:
    config = SimulationConfig(box_world=BOX, duration=8.0)
    return simulate_log(site, config, np.random.default_rng(5))


@pytest.fixture
def directory(site: Site, walk: SimulatedLog, tmp_path: Path) -> Path:
    write_log(walk.log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    return tmp_path / "log"


def rewritten(directory: Path, **columns: pa.Array | None) -> None:
    """Change columns of the table of samples; those of None are left out."""
    table = parquet.read_table(directory / "magnetometer.parquet")
    for name, values in columns.items():
        if name in table.column_names:
            table = table.drop_columns([name])
        if values is not None:
            table = table.append_column(name, values)
    parquet.write_table(table, directory / "magnetometer.parquet")


def test_samples_are_read_as_they_were_written(walk: SimulatedLog, directory: Path) -> None:
    result = read_log(directory).waveforms
    assert list(result) == ["left", "right"]
    for name, wave in walk.log.waveforms.items():
        np.testing.assert_allclose(result[name].time, wave.time, rtol=0.0, atol=1e-9)
        np.testing.assert_array_equal(result[name].measured_sensor, wave.measured_sensor)


def test_noise_of_instruments_is_their_own(walk: SimulatedLog, site: Site) -> None:
    config = SimulationConfig(box_world=BOX, duration=8.0, noise_scale=1e-9)
    clean = simulate_log(site, config, np.random.default_rng(5)).log.waveforms
    noise = [
        (walk.log.waveforms[name].measured_sensor - clean[name].measured_sensor).ravel()
        for name in ("left", "right")
    ]
    assert abs(np.corrcoef(noise)[0, 1]) < 5.0 / np.sqrt(len(noise[0]))


def test_each_is_demodulated_as_the_only_one(walk: SimulatedLog, site: Site) -> None:
    lockin = replace(default_settings(site), origin=0.0)
    fields = demodulated_apart(walk.log, site).log.fields
    assert fields is not None
    for which, sensor in enumerate(site.platform.magnetometers):
        wave = walk.log.waveforms[sensor.name]
        shifted = replace(wave, time=wave.time + sensor.clock_offset)
        alone = replace(walk.log, waveform=shifted, waveforms={})
        expected, _ = phasors(alone, only(site, which), lockin)
        mine = fields.phasor_sensor[:, site.of_sensor(which)]
        np.testing.assert_array_equal(mine[np.isfinite(mine).all((1, 2))], expected.phasor_sensor)


def test_windows_of_both_are_one_epoch(walk: SimulatedLog, site: Site) -> None:
    fields = demodulated_apart(walk.log, site).log.fields
    assert fields is not None
    steps = np.diff(fields.time) / default_settings(site).step
    np.testing.assert_allclose(steps, 1.0, rtol=0.0, atol=1e-6)
    both = [np.all(fields.valid[:, site.of_sensor(k)], axis=1) for k in range(2)]
    assert np.mean(both[0] & both[1]) > 0.9


@pytest.mark.parametrize("begin", [0.0, 0.137, 5.0])
def test_a_grid_by_an_origin_begins_with_the_first_whole_window(begin: float) -> None:
    settings = LockinSettings(0.4, 0.2, origin=0.05)
    centre = settings.first_centre(begin)
    assert begin + 0.2 - 1e-6 <= centre < begin + 0.4
    assert np.isclose((centre - 0.05) / 0.2, round((centre - 0.05) / 0.2), rtol=0.0, atol=1e-9)


def test_phasors_by_own_clocks_come_back(walk: SimulatedLog, site: Site) -> None:
    fields = demodulated_apart(walk.log, site).log.fields
    assert fields is not None
    own = by_own_clocks(fields, site)
    assert len(own) > len(fields)
    result = order_channels(own, site)
    np.testing.assert_allclose(result.time, fields.time, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(result.phasor_sensor, fields.phasor_sensor, rtol=1e-9, atol=0.0)


def test_phasors_are_those_of_the_true_motion(walk: SimulatedLog) -> None:
    fields = demodulated_apart(walk.log, walk.true_site).log.fields
    assert fields is not None
    true = walk.motion.trajectory(fields.time)
    calibration = initial_calibration(walk.true_site, 0.0)
    calibration = replace(calibration, phase=np.tile(walk.drives.phase, 2), drift=walk.drives.drift)
    pose = true.time, true.world_from_body, true.position_world
    error = np.abs(fields.phasor_sensor - predict_channels(calibration, *pose))
    size = np.linalg.norm(fields.phasor_sensor, axis=2, keepdims=True)
    assert np.nanmedian(error / size) < 0.01


@pytest.mark.slow
def test_demodulate_then_fix_is_fix(directory: Path, tmp_path: Path) -> None:
    run_demodulate(DemodulateSettings(log=directory), tmp_path / "phasors")
    report = json.loads((tmp_path / "phasors" / "report.json").read_text())
    assert {"sigma_left_A_0_t", "sigma_right_A_0_t"} <= set(report)
    assert (tmp_path / "phasors" / "fields.parquet").is_file()
    assert not (tmp_path / "phasors" / "magnetometer.parquet").exists()
    for place, output in ((directory, "raw"), (tmp_path / "phasors", "two")):
        run_fix(Job(place, None, tmp_path / output))
    tables = [parquet.read_table(tmp_path / name / "fixes.parquet") for name in ("raw", "two")]
    names = [n for n in tables[0].column_names if n.startswith("position")]
    assert len(names) == 3
    first, second = (np.column_stack([t[n].to_numpy() for n in names]) for t in tables)
    # Stamps are rounded to 1 ns; a fix ends within a thousandth of its sigma of centimetres.
    np.testing.assert_allclose(first, second, rtol=0.0, atol=1e-5)
    findings = json.loads((tmp_path / "raw" / "report.json").read_text())
    assert "demodulated_apart" in json.dumps(findings)


def test_a_fix_of_both_is_near_the_truth(walk: SimulatedLog, site: Site) -> None:
    fields = demodulated_apart(walk.log, site).log.fields
    assert fields is not None
    fixes = fix_epochs(fields, initial_calibration(site, 0.0))
    true = walk.motion.trajectory(fixes.time)
    error = fixes.position_world[:, 0] - true.position_world
    cov = fixes.pose_cov[:, 0, 3:, 3:]
    body = np.einsum("nji,nj->ni", fixes.world_from_body[:, 0], error)
    nees = np.einsum("ni,nij,nj->n", body, np.linalg.inv(cov), body)
    assert np.median(np.linalg.norm(error, axis=1)) < 0.05
    assert np.median(nees) < 3.0 * 2.4  # of three degrees of freedom 2.4; epochs err alike


def test_of_one_without_samples_it_is_said(walk: SimulatedLog, site: Site) -> None:
    log = replace(walk.log, waveforms={"right": walk.log.waveforms["right"]})
    result = demodulated_apart(log, site)
    assert "There are no samples of magnetometer left." in result.findings[-1].text
    assert result.log.fields is not None
    assert not np.any(result.log.fields.valid[:, site.of_sensor(0)])


def test_a_site_of_one_takes_what_is_of_it(walk: SimulatedLog, site: Site) -> None:
    result = of_site(walk.log, only(site, 1))
    assert result.waveform is walk.log.waveforms["right"]
    named = replace(walk.log, waveforms={"right": walk.log.waveforms["right"]})
    other = demo_site(coil_radius=None)
    assert of_site(named, other).waveform is walk.log.waveforms["right"]


@pytest.mark.parametrize("names", [("middle", "right"), ("left", "right", "middle")])
def test_an_unknown_name_is_refused(walk: SimulatedLog, site: Site, names: tuple[str, ...]) -> None:
    wave = walk.log.waveforms["left"]
    log: Log = replace(walk.log, waveforms=dict.fromkeys(names, wave))
    with pytest.raises(InputError, match=r"magnetometer middle, which.*it has left, right"):
        of_site(log, site)


def test_samples_without_a_name_are_refused(directory: Path, tmp_path: Path) -> None:
    table = parquet.read_table(directory / "magnetometer.parquet")
    alone = table.filter(pa.compute.equal(table["magnetometer"], "left"))
    parquet.write_table(alone.drop_columns(["magnetometer"]), directory / "magnetometer.parquet")
    with pytest.raises(InputError, match="add a column magnetometer with its name"):
        run_demodulate(DemodulateSettings(log=directory), tmp_path / "out")


def test_a_sample_without_a_name_is_refused(directory: Path) -> None:
    table = parquet.read_table(directory / "magnetometer.parquet")
    names = table["magnetometer"].to_pylist()
    rewritten(directory, magnetometer=pa.array([None, *names[1:]], pa.string()))
    with pytest.raises(InputError, match=r"column magnetometer, row 0.*write one"):
        read_log(directory)


def test_currents_beside_are_refused(directory: Path) -> None:
    count = parquet.read_metadata(directory / "magnetometer.parquet").num_rows
    rewritten(directory, drive_A=pa.array(np.ones(count)))
    with pytest.raises(InputError, match="drive_A: with the samples of several"):
        read_log(directory)


def test_rests_of_several_are_refused(directory: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--at-rest integrates the samples of one"):
        run_demodulate(DemodulateSettings(log=directory, at_rest=True), tmp_path / "out")


def test_check_judges_each_by_its_name(directory: Path, walk: SimulatedLog) -> None:
    elapsed = walk.log.waveforms["right"]
    kept = (elapsed.time < 3.0) | (elapsed.time > 4.0)
    waves = {**walk.log.waveforms, "right": elapsed.rows(kept)}
    write_log(replace(walk.log, waveforms=waves), directory)
    result = run_check(CheckSettings(log=directory))
    assert result["left_gaps"] == 0
    assert result["right_gaps"] == 1
    assert np.isclose(float(str(result["right_gap_s"])), 1.0, rtol=0.0, atol=0.02)
    assert {"left_rate_hz", "right_rate_hz", "left_heard_A", "right_snr_D"} <= set(result)
    assert "imu_rate_hz" in result
    assert "Magnetometer right:" in json.dumps(dict(result))
    (directory / "site.yaml").unlink()
    assert run_check(CheckSettings(log=directory))["right_gaps"] == 1


def test_what_temperature_does_to_one_of_several_is_refused(site: Site) -> None:
    first = site.platform.magnetometers[0]
    warm = replace(
        first, temperature_model=SensorTemperatureModel(1e-3 * np.eye(3), np.zeros(3), 20.0)
    )
    sensors = (warm, *site.platform.further)
    site = replace(site, platform=site.platform.with_magnetometers(sensors))
    with pytest.raises(InputError, match=f"{first.name}: warming of several magnetometers"):
        at_reference(Log("warm", 0, "test", ImuSamples.empty()), site)
