"""Steel near the path: its modes are fields of steel, and its evidence is a likelihood."""

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.integrity.steel_test import best_size
from magfusion.estimation.measurements import steel
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.parameters.parameter import PhasorView
from magfusion.model.samples import Log
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import Ambient
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.steel_worlds import draw_steel
from magfusion.units import AnyArray, Array

EPOCHS = 16


def _walk() -> Trajectory:
    """Return a circle at 1.2 m above the floor, with a turn about the vertical."""
    angle = np.linspace(0.0, 2.0 * np.pi, EPOCHS)
    place = np.array([3.0, 2.5, 1.2]) + np.stack(
        [1.5 * np.cos(angle), 1.2 * np.sin(angle), 0.2 * np.sin(2.0 * angle)], axis=1
    )
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros(EPOCHS), np.ones(EPOCHS)
    turn = np.stack([c, -s, o, s, c, o, o, o, i], axis=1).reshape(-1, 3, 3)
    return Trajectory(0.2 * np.arange(EPOCHS, dtype=float), turn, place)


def _sphere_field(source: AnyArray, centre: Array, point: Array, volume: float) -> AnyArray:
    """Return the field of a small sphere magnetised by a source field, shape (n, tones, 3)."""
    offset = point - centre
    distance = np.linalg.norm(offset, axis=1)[:, None, None]
    along = (offset / distance[:, 0])[:, None]
    inside = np.sum(along * source, axis=-1, keepdims=True)
    return np.asarray(volume * (3.0 * along * inside - source) / (4.0 * np.pi * distance**3))


@pytest.mark.parametrize("far", [50.0, 2e3, 1e9, np.nan])
def test_a_path_of_kilometres_has_no_modes(far: float) -> None:
    """An estimate that has diverged costs no memory."""
    poses = _walk()
    place = poses.position_world.copy()
    place[-1] = far
    site = demo_site(coil_radius=None)
    assert steel.steel_modes(site, poses.time, replace(poses, position_world=place)) == ()
    assert len(steel.steel_modes(site, poses.time, poses)) == 1


def test_the_field_of_a_sphere_is_a_sum_of_modes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a small sphere in the middle of a voxel, in the sensor's axes and the drive's phase."""
    monkeypatch.setattr(steel, "MAX_MOMENTS", np.inf)
    site, poses = demo_site(coil_radius=None), _walk()
    (block,) = steel.steel_modes(site, poses.time, poses, (10_000, steel.OWN))
    assert isinstance(block.parameter, steel.SteelModes)
    sensor, centres = site.platform.magnetometer, block.parameter.basis.voxels.centre_world
    place = poses.position_world + poses.world_from_body @ sensor.position_body
    away = np.min(np.linalg.norm(centres[:, None] - place, axis=2), axis=1)
    assert np.min(away) > steel.CLEAR
    centre = centres[[np.argmin(np.abs(away - 1.0))]]
    added = _sphere_field(steel.beacon_fields(site, centre), centre[0], place, 0.1)
    source = steel.beacon_fields(site, place)
    turn = np.swapaxes(poses.world_from_body @ sensor.body_from_sensor, 1, 2)
    calibration, first, rows, true = initial_calibration(site, 0.0), 0, [], []
    for beacon in site.beacons:
        tones = slice(first, first + len(beacon.tones))
        first, drive = tones.stop, np.exp(0.7j)
        seen, bent = (
            drive * np.einsum("nak,ntk->nta", turn, field[:, tones]) for field in (source, added)
        )
        view = PhasorView(calibration, beacon, poses.time, seen, None)
        columns = block.parameter.phasor_jacobian(view, "site")
        assert columns is not None
        size = np.linalg.norm(source[:, tones], axis=2)[..., None]
        rows.append((columns / size[..., None]).reshape(-1, columns.shape[-1]))
        true.append((bent / size).ravel())
    # Steel responds in phase: amplitudes are real.
    basis, wanted = (np.concatenate([*map(np.real, x), *map(np.imag, x)]) for x in (rows, true))
    fit = np.linalg.lstsq(basis, wanted, rcond=None)[0]
    assert np.linalg.norm(basis @ fit - wanted) < 0.01 * np.linalg.norm(wanted)


def test_the_gain_is_a_ratio_of_marginal_likelihoods() -> None:
    """Of white noise of unit variance against the same with amplitudes of known sizes."""
    rng = np.random.default_rng(3)
    columns, shared = 0.8 * rng.standard_normal((30, 6)), np.arange(6) < 4
    measured = rng.standard_normal(30) + columns @ rng.standard_normal(6)
    gain, sigma = best_size(columns.T @ columns, columns.T @ measured, shared)

    def likelihood(cov: Array) -> float:
        return -float(measured @ np.linalg.solve(cov, measured) + np.linalg.slogdet(cov)[1])

    alone = likelihood(np.eye(30))
    best = likelihood(np.eye(30) + (columns * sigma**2) @ columns.T) - alone
    assert gain < best < gain + 2.0 * np.log(48.0)
    assert len(np.unique(sigma)) <= 2


def test_noise_alone_is_no_steel() -> None:
    """Of white noise the mean evidence is below zero, and hardly ever enough to name a cause."""
    rng, gains = np.random.default_rng(5), []
    shared = np.arange(20) < 12
    for _ in range(40):
        columns = 2.0 * rng.standard_normal((100, 20))
        gains.append(
            best_size(columns.T @ columns, columns.T @ rng.standard_normal(100), shared)[0]
        )
    assert np.mean(gains) < 0.0
    assert np.max(gains) < 10.0


def test_modes_take_little_more_memory_than_the_distortions_of_their_voxels() -> None:
    rng = np.random.default_rng(0)
    place, tones, voxels = 10, 8, 1200
    tensors = rng.standard_normal((place, voxels, 3, 3))
    at_place, moment = (
        rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
        for shape in ((place, tones, 3), (voxels, tones, 3, 6))
    )
    tracemalloc.start()
    steel._modes(tensors, at_place, moment, 40)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.6 * (2 * place * tones * 3 * voxels * 6 * 8)


def test_modes_of_a_region_have_no_curl_and_act_as_those_of_a_path() -> None:
    site, poses, step = demo_site(coil_radius=None), _walk(), 1e-4
    (block,) = steel.region_modes(site)
    assert isinstance(block.parameter, steel.SteelModes)
    basis = block.parameter.basis
    assert block.parameter.columns == steel.REGION_SHARED + 4 * steel.REGION_OWN

    def slope(place: Array) -> AnyArray:
        """Return the derivative of the field at one place, shape (3, 3, tones, modes)."""
        ends = (basis.fields(place + sign * step * np.eye(3)) for sign in (1.0, -1.0))
        return np.asarray(np.subtract(*ends).swapaxes(1, 2) / (2.0 * step))

    for place in (np.array([3.0, 2.5, 1.2]), np.array([3.0, 2.5, 9.0])):
        own = slope(place)
        assert np.max(np.abs(own - own.swapaxes(0, 1))) < 1e-5 * np.max(np.abs(own))
    assert np.max(np.abs(np.trace(own))) < 0.1 * np.max(np.abs(own))  # outside of the voxels
    calibration = replace(initial_calibration(site, 0.0), phase=np.full(4, 0.3))
    pose = poses.world_from_body, poses.position_world
    expected = basis.phasors(calibration, poses.time, *pose)
    (along,) = steel.along_path(basis, site, poses.time, poses)
    seen = predict_channels(calibration, poses.time, *pose)
    for k, beacon in enumerate(site.beacons):
        view = PhasorView(calibration, beacon, poses.time, seen[:, [k]], None)
        columns = along.parameter.phasor_jacobian(view, "site")
        assert columns is not None
        np.testing.assert_allclose(columns, expected[:, [k]], atol=1e-6 * np.max(np.abs(expected)))


def _log(kind: str | None, duration: float) -> Log:
    """Return a walk in the demo's room with steel of a kind."""
    site, rng = demo_site(coil_radius=None), np.random.default_rng([40, 4])
    places = np.array([beacon.position_world for beacon in site.beacons])
    rails = None if kind is None else draw_steel(kind, rng, DEMO_BOX_WORLD, places)
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=duration,
        imu_rate_hz=100.0,
        magnetometer_rate_hz=160.0,
        ambient=Ambient() if rails is None else Ambient(rails=rails),
    )
    return simulate_log(site, config, rng).log


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "code"), [("spheres", "steel"), (None, "beacon_pose")])
def test_online_steel_and_a_displaced_beacon_are_named(
    kind: str | None, code: str, tmp_path: Path
) -> None:
    """The beacon is 8 cm from where the site has it."""
    site, log = replace(demo_site(coil_radius=None), model_error=0.003), _log(kind, 40.0)
    if kind is None:
        first, *others = site.beacons
        moved = replace(first, position_world=first.position_world + np.array([0.08, 0.0, 0.0]))
        site = replace(site, beacons=(moved, *others))
    write_log(replace(log, truth=None), tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    result = tmp_path / "result"
    run_command("navigate", tmp_path / "log", "-o", result, "--estimator", "ekf")
    report = json.loads((result / "report.json").read_text())
    assert report["reasons"][0]["code"] == code


@pytest.mark.slow
def test_spheres_are_named_steel_and_covered() -> None:
    """Of a walk in the demo's room, whose site declares less distortion."""
    site, log = demo_site(coil_radius=None), _log("spheres", 60.0)
    assert log.truth is not None
    result = smooth(replace(log, truth=None), replace(site, model_error=0.003))
    judged, trust = judge_result(result, log)
    first, nees = trust.reasons[0], trajectory_errors(judged.states, log.truth).nees
    assert first.code == "steel"
    assert first.remedy is not None
    assert list(first.remedy) == ["world.model_error"]
    assert nees is not None
    assert np.mean(nees) < 12.6  # 95 % of chi square of six
