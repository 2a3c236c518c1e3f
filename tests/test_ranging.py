"""One well from another, by a magnet that turns: model, wells, job."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rotating_magnet_ranging as scenario
from conftest import Refuse, run_command
from scipy.spatial.transform import Rotation

from magfusion.estimation.ranging.ranging import Ranged, _moved, find_range
from magfusion.estimation.ranging.ranging_data import RangingWindows
from magfusion.estimation.ranging.ranging_model import RangingModel
from magfusion.estimation.ranging.ranging_windows import ranging_log
from magfusion.estimation.ranging.relative_wells import Wells
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import Array

QUICK = scenario.Case("quick", 8.0, 4.0, 8.0, 0.04, 0.1, 10.0, 0.005, 5.0, 0.5)
PLAIN = scenario.Config(steel=False, layers=False)


@pytest.fixture(scope="module")
def scene() -> scenario.Scene:
    return scenario.draw(QUICK, PLAIN, 3)


def _windows(scene: scenario.Scene, site: Site) -> RangingWindows:
    return ranging_log(scene.log, site, QUICK.window).windows


def _state(model: RangingModel, rng: np.random.Generator) -> Array:
    """Return a state far from the truth, of one problem."""
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix().ravel()
    place = np.array([1.0, 6.0, 5.0])
    return np.concatenate([rotation, place, 0.1 * rng.standard_normal(len(model.names))])[None]


@pytest.mark.parametrize("cased", [False, True])
def test_the_derivatives_are_those_of_differences(cased: bool, scene: scenario.Scene) -> None:
    site = replace(scenario.declared_site(cased=cased), log_conductivity_sigma=0.5)
    model = RangingModel(site, _windows(scene, site))
    rng = np.random.default_rng(1)
    state = _state(model, rng)
    _, jacobian = model.residuals(state)
    for k in range(jacobian.shape[-1]):
        step = np.zeros((1, jacobian.shape[-1]))
        step[0, k] = 1e-5
        sides = [model.residuals(_moved(state, sign * step))[0] for sign in (1.0, -1.0)]
        slope = (sides[0] - sides[1]) / 2e-5
        error = np.linalg.norm(slope - jacobian[..., k]) / np.linalg.norm(slope)
        assert error < 2e-4, (*["rotation"] * 3, *["position"] * 3, *model.names)[k]


@pytest.mark.slow
def test_the_cost_of_a_followed_angle_falls_along_its_gradient(scene: scenario.Scene) -> None:
    """Its phases are projected out, with the gradient of what is left."""
    site = scenario.declared_site(cased=True)
    model = RangingModel(site, replace(_windows(scene, site), angle_known=False))
    state = _state(model, np.random.default_rng(2))
    error, jacobian = model.residuals(state)
    gradient = 2.0 * np.einsum("kd,kdn->n", error, jacobian)
    for k in range(len(gradient)):
        step = np.zeros((1, len(gradient)))
        step[0, k] = 1e-5
        costs = [np.sum(model.residuals(_moved(state, s * step))[0] ** 2) for s in (1.0, -1.0)]
        assert (costs[0] - costs[1]) / 2e-5 == pytest.approx(
            gradient[k], rel=1e-3, abs=1e-5 * np.max(np.abs(gradient))
        )


@pytest.mark.slow
def test_the_pose_is_found_within_its_sigmas_by_an_angle_that_is_followed(
    scene: scenario.Scene,
) -> None:
    reported = ranging_log(
        replace(scene.log, rotation=None), scenario.declared_site(cased=False), QUICK.window
    )
    result = find_range(scenario.declared_site(cased=False), reported.windows)
    error = scenario.pose_error(scene, reported.windows, result, measured=False)
    assert result.converged
    assert scenario.nees(error, result, measured=False) < 22.5  # one in a thousand, of six


@pytest.fixture(scope="module")
def ranged(scene: scenario.Scene) -> tuple[Ranged, RangingWindows]:
    site = scenario.declared_site(cased=False)
    windows = _windows(scene, site)
    return find_range(site, windows), windows


@pytest.mark.slow
def test_wells_are_those_of_the_poses_and_their_sigmas_of_differences(
    scene: scenario.Scene, ranged: tuple[Ranged, RangingWindows]
) -> None:
    result, windows = ranged
    axis = np.array([1.0, 0.0, 0.0])
    assert result.converged
    error = scenario.pose_error(scene, windows, result)
    assert scenario.nees(error, result, measured=True) < 22.5  # one in a thousand
    for own in scene.transits:
        one = Wells(result, windows, axis).wells_at(own.sensor_depth)
        true = scene.wells.truth_of(own)
        assert abs(one.distance - true[0]) < 4.0 * one.distance_sigma
        rotated = np.angle(np.exp(1j * (one.direction - true[1])))
        assert abs(rotated) < 4.0 * one.direction_sigma

    def words(step: Array) -> Array:
        state = np.concatenate(
            [result.world_from_body.ravel(), result.position_world, result.values]
        )
        moved = _moved(state[None], step[None])[0]
        other = replace(
            result,
            world_from_body=moved[:9].reshape(3, 3),
            position_world=moved[9:12],
            values=moved[12:],
        )
        wells = Wells(other, windows, axis)
        one, separate = wells.wells_at(2.0), wells.divergence()
        return np.array([one.distance, one.direction, one.depth, separate.right, separate.up])

    n = len(result.cov)
    steps = 1e-6 * np.eye(n)
    slope = np.stack([(words(s) - words(-s)) / 2e-6 for s in steps], axis=1)
    sigma = np.sqrt(np.diagonal(slope @ result.cov @ slope.T))
    wells = Wells(result, windows, axis)
    one, separate = wells.wells_at(2.0), wells.divergence()
    reported = [
        one.distance_sigma,
        one.direction_sigma,
        one.depth_sigma,
        separate.right_sigma,
        separate.up_sigma,
    ]
    np.testing.assert_allclose(reported, sigma, rtol=1e-4)


def test_a_screw_is_a_turn_about_the_magnet() -> None:
    """A step along what is open leads as far as one likes without an error of distance."""
    rng = np.random.default_rng(5)
    rotation, place = Rotation.random(random_state=rng).as_matrix(), rng.normal(0.0, 5.0, 3)
    axis, angle = np.array([1.0, 0.0, 0.0]), 2.0
    step = angle * np.concatenate([rotation.T @ axis, rotation.T @ np.cross(axis, place)])
    moved = _moved(np.concatenate([rotation.ravel(), place])[None], step[None])[0]
    about = Rotation.from_rotvec(angle * axis).as_matrix()
    np.testing.assert_allclose(moved[:9].reshape(3, 3), about @ rotation, atol=1e-12)
    np.testing.assert_allclose(moved[9:], about @ place, atol=1e-12)


def _written(scene: scenario.Scene, directory: Path) -> Path:
    write_log(scene.log, directory / "log")
    save_site(scenario.declared_site(cased=False), directory / "log" / "site.yaml")
    return directory / "log"


@pytest.mark.slow
def test_the_job_says_it_in_the_words_of_a_driller(scene: scenario.Scene, tmp_path: Path) -> None:
    log = _written(scene, tmp_path)
    run_command("range", log, "-o", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"
    for k, own in enumerate(scene.transits, start=1):
        distance, direction, depth = scene.wells.truth_of(own)
        assert report[f"place_{k}_distance_m"] == pytest.approx(distance, abs=0.05)
        assert report[f"place_{k}_high_side_deg"] == pytest.approx(
            np.rad2deg(direction) % 360.0, abs=1.0
        )
        assert report[f"place_{k}_abreast_depth_m"] == pytest.approx(depth, abs=0.05)
    assert (tmp_path / "out" / "range.parquet").is_file()


@pytest.mark.parametrize(
    ("lacking", "findings"),
    [("depth", "measured depth of the magnet"), ("rotor", "one beacon with rotor")],
)
def test_what_ranging_lacks_is_said(
    lacking: str, findings: str, scene: scenario.Scene, tmp_path: Path, refuse: Refuse
) -> None:
    log = _written(scene, tmp_path)
    if lacking == "depth":
        (log / "depth.parquet").unlink()
    else:
        site = scenario.declared_site(cased=False)
        plain = replace(site.beacons[0], rotor=None)
        save_site(replace(site, beacons=(plain,)), log / "site.yaml")
    assert findings in refuse("range", log, "-o", tmp_path / "out")


def test_a_casing_is_for_ranging_alone(
    scene: scenario.Scene, tmp_path: Path, refuse: Refuse
) -> None:
    log = _written(scene, tmp_path)
    save_site(scenario.declared_site(cased=True), log / "site.yaml")
    assert "only magfusion range" in refuse("fix", log, "-o", tmp_path / "out")


def test_without_inertial_samples_directions_are_the_tools(scene: scenario.Scene) -> None:
    log = replace(scene.log, imu=ImuSamples.empty(), inertial=False)
    reported = ranging_log(log, scenario.declared_site(cased=False), QUICK.window)
    assert not reported.high_side
    assert reported.inclination is None


@pytest.mark.slow
def test_published_accuracy_is_bettered_by_a_factor_of_five_and_no_error_is_beyond_its_sigma() -> (
    None
):
    """The scenario's rule, but for its lower bound of the NEES: of few draws it scatters."""
    pytest.importorskip("empymod")  # the layers of the scenario
    rows = [scenario.run_one(scenario.CROSSING, scenario.Config(), seed) for seed in range(1, 7)]
    result = scenario.judge_ranging(rows)
    assert result.rms_share <= scenario.PUBLISHED / scenario.BETTER
    assert result.nees <= scenario.MAX_NEES


def test_a_depth_that_errs_shifts_a_window_along_the_slope(scene: scenario.Scene) -> None:
    """Two models of one log, one with depths a sigma aside: what is whitened differs by one."""
    site = scenario.declared_site(cased=False)
    plain = replace(_windows(scene, site), depth_sigma=0.5)
    state = _state(RangingModel(site, plain), np.random.default_rng(4))
    state[:, 12:] = 0.0
    windows = replace(plain, depth_sigma=0.5)
    model = RangingModel(replace(site, model_error=0.0), windows, about=state[0])
    moved = windows.magnet.copy()
    moved[5] += 1e-4
    other = RangingModel(
        replace(site, model_error=0.0), replace(windows, magnet=moved), about=state[0]
    )
    phasor = other.predicted(state)[0] - model.predicted(state)[0]
    assert np.linalg.norm(model.white(phasor)) == pytest.approx(1e-4 / 0.5, rel=0.02)


def test_a_long_magnet_is_its_parts(scene: scenario.Scene) -> None:
    site = scenario.declared_site(cased=False)
    rotor = site.beacons[0].rotor
    assert rotor is not None
    windows = _windows(scene, site)
    short = replace(site.beacons[0], rotor=replace(rotor, length=0.0))
    long = replace(site.beacons[0], rotor=replace(rotor, length=0.6))
    model = RangingModel(replace(site, beacons=(short,)), windows)
    state = _state(model, np.random.default_rng(4))
    parts = [
        RangingModel(
            replace(site, beacons=(short,)), replace(windows, magnet=windows.magnet + along)
        ).predicted(state)[0]
        for along in 0.6 * (np.arange(8) - 3.5) / 8.0
    ]
    whole = RangingModel(replace(site, beacons=(long,)), windows).predicted(state)[0]
    plain = model.predicted(state)[0]
    error = np.linalg.norm(whole - np.mean(parts, axis=0))
    assert error < 0.03 * np.linalg.norm(plain - np.mean(parts, axis=0))
