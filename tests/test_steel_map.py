"""Map of steel from the log itself: used only where it predicts beacons that it does not know."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from conftest import Refuse, run_command
from small_problem import small_log

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.integrity.steel_map import SteelMap, explained_without_map
from magfusion.estimation.integrity.steel_test import SteelEstimate
from magfusion.estimation.measurements.steel import (
    UNIT,
    SteelBasis,
    SteelModes,
    Voxels,
    steel_modes,
)
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.model.field import predict
from magfusion.model.parameters import Block, initial_calibration
from magfusion.model.site import Beacon, Site
from magfusion.model.steel_field import SteelField
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import Ambient
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.steel_worlds import draw_steel
from magfusion.units import Array

SHARED_STEEL = Path(__file__).parents[1].parent / "shared" / "logs" / "steel"


def _map(ratio: float) -> SteelMap:
    """Return a map of one voxel in one mode, of two tones."""
    moment = np.full((1, 2, 3, 1), 1e-3)
    tensor = np.ones((1, 6, 1))
    basis = SteelBasis(Voxels(np.zeros((1, 3)), np.ones(1)), moment, moment, tensor, 0.0)
    return _of_basis(basis, np.array([2.0]), ratio)


def _of_basis(basis: SteelBasis, mean: Array, ratio: float) -> SteelMap:
    modes, size = SteelModes(basis, np.zeros(0), {}, {}, np.zeros(0)), len(mean)
    block = Block(modes, "site", slice(0, size), np.full(size, UNIT))
    empty = np.zeros((1, 6, size)), np.zeros((0, size))
    score = Score((block,), np.eye(size), np.zeros(size), np.zeros((size, 0)), *empty)
    steel = SteelEstimate(0.02, np.zeros(3), 0.3, 900.0, np.zeros((1, 6, 6)))
    return SteelMap(steel, mean, 0.25 * np.eye(size), score, {"A": ratio, "B": ratio})


def test_the_remedy_replaces_the_model_errors_of_a_refined_site() -> None:
    """Each beacon then has one of its own, which the world's does not change."""
    site = replace(demo_site(coil_radius=None), model_error=0.005)
    beacons = tuple(replace(beacon, model_error=0.003) for beacon in site.beacons)
    refined = replace(site, beacons=beacons)
    plain, own = (_map(0.9).steel.finding(known) for known in (site, refined))
    assert "declare world.model_error 0.02." in plain.text
    assert "declare world.model_error 0.02 and omit that of the beacons." in own.text
    assert plain.remedy == {"world.model_error": 0.02}
    changed = {f"beacons[{i}].model_error": None for i in range(len(beacons))}
    assert own.remedy == plain.remedy | changed


@pytest.mark.parametrize("quadrature", [True, False])
def test_a_site_with_the_map_predicts_what_its_modes_add(quadrature: bool) -> None:
    """Of beacons whose coils share a tone, and of coils with a tone each."""
    site, rng = demo_site(coil_radius=None), np.random.default_rng(4)
    if not quadrature:
        site = replace(site, beacons=tuple(map(_tone_each, site.beacons)))
    poses = Trajectory(
        np.arange(30.0),
        np.broadcast_to(np.eye(3), (30, 3, 3)),
        rng.uniform([2.0, 1.5, 0.8], [4.0, 3.5, 1.6], (30, 3)),
    )
    (block,) = steel_modes(site, poses.time, poses, (40, 4))
    assert isinstance(block.parameter, SteelModes)
    basis = block.parameter.basis
    mean = rng.normal(size=block.parameter.columns)
    known = _of_basis(basis, mean, 0.5).on(site)
    place = poses.world_from_body, poses.position_world
    added = np.concatenate(
        [
            predict(now, site.platform.magnetometer, *place)
            - predict(before, site.platform.magnetometer, *place)
            for now, before in zip(known.beacons, site.beacons, strict=True)
        ],
        axis=1,
    )
    wanted = basis.phasors(initial_calibration(site, 0.0), poses.time, *place) @ (UNIT * mean)
    np.testing.assert_allclose(added, wanted, rtol=1e-6, atol=1e-9 * np.max(np.abs(wanted)))
    again = _of_basis(basis, mean, 0.5).on(known)
    twice = predict(again.beacons[0], site.platform.magnetometer, *place)
    once = predict(known.beacons[0], site.platform.magnetometer, *place)
    np.testing.assert_allclose(
        twice - once, added[:, : once.shape[1]], rtol=1e-6, atol=1e-9 * np.max(np.abs(wanted))
    )


def _tone_each(beacon: Beacon) -> Beacon:
    coils = (
        replace(coil, phase=0.0, frequency_hz=beacon.frequency_hz + k)
        for k, coil in enumerate(beacon.coils)
    )
    return replace(beacon, coils=tuple(coils))


def test_a_map_that_predicts_no_other_beacon_is_not_used() -> None:
    """The finding is a remark with the map, and the reason for doubt without it."""
    site = replace(demo_site(coil_radius=None), model_error=0.005)
    good, bad = _map(0.95), _map(1.05)
    assert good.is_used
    assert good.finding(site).verdict is Verdict.TRUSTWORTHY
    assert not bad.is_used
    assert "--map-steel" not in bad.finding(site).text  # which made this map
    known = bad.finding(site)
    assert known.verdict is Verdict.DOUBTFUL
    assert known.remedy == {"world.model_error": 0.02}


def test_the_polarisability_is_that_of_the_amplitudes() -> None:
    """Two sigma of the mode in the mean, half a sigma unsure."""
    mean, sigma = _map(0.5).polarisability
    unit = UNIT * np.sqrt(3.0) * 1e-3  # m^3, of three equal components
    np.testing.assert_allclose(mean, 2.0 * unit, rtol=1e-9)
    np.testing.assert_allclose(sigma, 0.5 * unit, rtol=1e-9)


def _surveyed_exactly(site: Site) -> Site:
    """Return a site whose errors are not drawn."""
    beacons = tuple(
        replace(
            beacon,
            sigma=replace(
                beacon.sigma,
                position_world=np.zeros(3),
                rotation_beacon=np.zeros(3),
                log_moment=np.zeros(2),
            ),
        )
        for beacon in site.beacons
    )
    sensor, none = site.platform.magnetometer, np.zeros(3)
    known = replace(sensor.sigma, matrix=np.zeros((3, 3)), rotation_sensor=none, position_body=none)
    platform = replace(site.platform, magnetometer=replace(sensor, sigma=known))
    return replace(site, beacons=beacons, platform=platform)


def _walks(kind: str, place: Path, *others: str) -> dict[str, Any]:
    """Return the report of a walk of a minute among steel of a kind, mapped.

    Others: ``second`` is another walk there, ``moved`` one without the steel.
    """
    site = replace(demo_site(coil_radius=None), model_error=0.005)
    rng = np.random.default_rng(0)
    beacons = np.array([beacon.position_world for beacon in site.beacons])
    steel = draw_steel(kind, rng, DEMO_BOX_WORLD, beacons)
    for name in ("log", *others):
        config = SimulationConfig(
            DEMO_BOX_WORLD,
            duration=60.0,
            imu_rate_hz=100.0,
            magnetometer_rate_hz=160.0,
            ambient=Ambient(rails=None if name == "moved" else steel),
        )
        write_log(simulate_log(_surveyed_exactly(site), config, rng).log, place / name)
        save_site(site, place / name / "site.yaml")
    return _report(place / "run", "smooth", place / "log", "--map-steel")


def _report(place: Path, *command: object) -> dict[str, Any]:
    run_command(*command, "-o", place)
    report: dict[str, Any] = json.loads((place / "report.json").read_text())
    return report


@pytest.mark.slow
def test_a_mesh_is_mapped_and_the_sigmas_are_right(tmp_path: Path) -> None:
    """Of the log, and of the next one by `smooth` and by the filter, which take the map."""
    report = _walks("mesh", tmp_path, "second", "moved")
    assert report["verdict"] == "trustworthy"
    assert report["steel_map_used"]
    assert report["attitude_rmse_deg"] < 0.06
    assert report["ate_m"] < 0.004
    assert 1.0 < report["nees_mean"] < 12.6  # 95 % of chi square of six
    voxels = pyarrow.parquet.read_table(tmp_path / "run" / "steel.parquet").to_pandas()
    assert np.all(voxels.polarisability_sigma_m3 > 0.0)
    site = "--site", tmp_path / "run" / "site.yaml"
    ratio = {}
    for name, command in (("smooth", ("smooth",)), ("ekf", ("navigate", "--estimator", "ekf"))):
        plain = _report(tmp_path / f"{name}_plain", *command, tmp_path / "second")
        mapped = _report(tmp_path / name, *command, tmp_path / "second", *site)
        assert mapped["verdict"] == "trustworthy"
        assert not any(remark["code"] == "steel_moved" for remark in mapped["remarks"])
        assert 1.0 < mapped["nees_mean"] < 12.6
        ratio[name] = mapped["ate_m"] / plain["ate_m"]
    assert ratio["smooth"] < 1.0
    assert ratio["ekf"] < 0.8
    plain = _report(tmp_path / "moved_plain", "smooth", tmp_path / "moved")
    mapped = _report(tmp_path / "moved_mapped", "smooth", tmp_path / "moved", *site)
    assert any(remark["code"] == "steel_moved" for remark in mapped["remarks"])
    assert mapped["ate_m"] < 1.1 * plain["ate_m"]


@pytest.mark.slow
def test_racks_are_mapped_and_the_sigmas_hold(tmp_path: Path) -> None:
    """Long rods conduct the flux of a beacon to places where its field is weak."""
    mapped = _walks("racks", tmp_path)
    plain = _report(tmp_path / "plain", "smooth", tmp_path / "log")
    assert mapped["ate_m"] < 0.6 * plain["ate_m"]
    assert mapped["attitude_rmse_deg"] < 0.6 * plain["attitude_rmse_deg"]
    assert 0.5 < mapped["nees_mean"] < 12.6  # 95 % of chi square of six


@pytest.mark.slow
@pytest.mark.skipif(not SHARED_STEEL.is_dir(), reason="the shared logs are not here")
def test_a_log_of_rebar_by_another_program_is_mapped(tmp_path: Path) -> None:
    """Less than two thirds of the error without a map (10 mm, 0.33 degrees)."""
    run_command("smooth", SHARED_STEEL / "rebar_first", "-o", tmp_path / "run", "--map-steel")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["steel_map_used"]
    assert report["ate_m"] < 0.0067
    assert report["attitude_rmse_deg"] < 0.22
    assert 1.0 < report["nees_mean"] < 12.6


def test_a_log_without_steel_is_not_mapped(log: Path, tmp_path: Path) -> None:
    run_command("smooth", log, "-o", tmp_path / "run", "--map-steel")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"
    assert any(
        remark["text"].startswith("The steel is not mapped: the log shows none")
        for remark in report["remarks"]
    )


def test_one_log_without_steel_is_calibrated_without_a_map(log: Path, tmp_path: Path) -> None:
    report = _report(tmp_path / "site", "calibrate", "log", log, "--map-steel")
    assert report["steel_maps"] == [
        {"log": "log", "used": "no", "reason": "the log shows none"},
    ]
    assert not (tmp_path / "site" / "steel.parquet").exists()


def test_fixes_in_a_graph_do_not_test_a_map() -> None:
    """They contain it, and the graph has no fields that could contradict it."""
    small = small_log(10)
    steel = SteelField(np.array([[2.0, 1.0, -1.0]]), np.array([0.2]), np.full((1, 2, 3), 1e-3))
    beacons = tuple(replace(beacon, steel=steel) for beacon in small.site.beacons)
    result = smooth(
        small.log, replace(small.site, beacons=beacons), SmootherSettings(coupling="loose")
    )
    assert not explained_without_map(result)


def test_whole_rests_are_not_mapped(log: Path, refuse: Refuse) -> None:
    findings = refuse("smooth", log, "--map-steel", "--at-rest", "-o", "run")
    assert "--map-steel maps the steel along the path" in findings


@pytest.mark.slow
def test_logs_in_a_room_are_calibrated_with_its_map(tmp_path: Path) -> None:
    """Beacons are then where they are, which the steel would move otherwise."""
    site, rng = replace(demo_site(coil_radius=None), model_error=0.005), np.random.default_rng(1)
    beacons = np.array([beacon.position_world for beacon in site.beacons])
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=30.0,
        imu_rate_hz=100.0,
        magnetometer_rate_hz=160.0,
        ambient=Ambient(rails=draw_steel("mesh", rng, DEMO_BOX_WORLD, beacons)),
    )
    first = simulate_log(site, config, rng)
    same = replace(config, perturb=False)
    second = simulate_log(first.true_site, same, rng)
    logs = tmp_path / "first", tmp_path / "second"
    for place, built in zip(logs, (first, second), strict=True):
        write_log(built.log, place)
        save_site(site, place / "site.yaml")
    command = "calibrate", "log", *logs, "--workers", 1
    error = {}
    for name, options in (("plain", ()), ("mapped", ("--map-steel",))):
        report = _report(tmp_path / name, *command, *options)
        refined = load_site(tmp_path / name / "site.yaml")
        assert all((one.steel is not None) == (name == "mapped") for one in refined.beacons)
        error[name] = np.linalg.norm(
            [
                one.position_world - true.position_world
                for one, true in zip(refined.beacons, first.true_site.beacons, strict=True)
            ]
        )
    rows = report["steel_maps"]
    assert [row["log"] for row in rows] == ["first", "second"]
    assert rows[0]["used"] == "yes"
    assert rows[0]["error_ratio"] < 1.0
    assert (tmp_path / "mapped" / "steel.parquet").is_file()
    assert error["mapped"] < 0.75 * error["plain"]
    again = _report(tmp_path / "mapped", *command, "--map-steel")
    assert again["steel_maps"] == rows  # kept
