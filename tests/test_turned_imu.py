"""A corrected mounting may be an IMU that is turned: the poses then differ by a rigid motion."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.correction import (
    Correction,
    Trial,
    best_trial,
    corrections,
)
from magfusion.estimation.integrity.fault_isolation import Diagnosis
from magfusion.model.imu_intrinsics import ImuIntrinsics
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.simulation.demo_site import demo_site
from magfusion.units import DEGREE


def mounted(site: Site, body_from_sensor: np.ndarray, position_body: np.ndarray) -> Site:
    magnetometer = replace(
        site.platform.magnetometer, body_from_sensor=body_from_sensor, position_body=position_body
    )
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


def diagnosis(site: Site) -> Diagnosis:
    return Diagnosis(Finding("mounting", "It is turned."), site, ratio=100.0)


def test_its_spread_has_the_motion_of_the_body_about_the_magnetometer() -> None:
    rng = np.random.default_rng(2)
    turn = Rotation.from_rotvec([2.0 * DEGREE, -3.0 * DEGREE, 1.0 * DEGREE])
    before, place = Rotation.random(random_state=rng).as_matrix(), np.array([0.05, -0.04, 0.08])
    after, moved = turn.as_matrix() @ before, place + np.array([0.01, 0.0, -0.006])
    declared = mounted(demo_site(), before, place)
    (correction,) = corrections(declared, (), (), diagnosis(mounted(declared, after, moved)))
    (frame,) = correction.rivals
    assert frame.is_frame
    # The magnetometer has one pose in the world; the body follows by either mounting.
    world_from_sensor, sensor_world = Rotation.random(random_state=rng).as_matrix(), np.ones(3)
    poses = []
    for mounting, position in ((before, place), (after, moved)):
        world_from_body = world_from_sensor @ mounting.T
        poses.append((world_from_body, sensor_world - world_from_body @ position))
    (one, at), (other, there) = poses
    step = np.concatenate([Rotation.from_matrix(other.T @ one).as_rotvec(), other.T @ (at - there)])
    assert np.allclose(frame.spread[0], 0.5 * np.outer(step, step), rtol=0.0, atol=1e-9)


def test_either_frame_has_the_other_in_its_spread_by_their_odds() -> None:
    """A quarter turn: of the magnetometer in its mounting, or of the IMU."""
    axes = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    declared = demo_site()
    sensor = declared.platform.magnetometer
    turned = replace(
        declared,
        platform=replace(declared.platform, imu_intrinsics=ImuIntrinsics(axes.T, axes.T)),
    )
    remounted = mounted(declared, axes.T @ sensor.body_from_sensor, sensor.position_body)
    known, other = diagnosis(remounted), diagnosis(turned)
    spreads = []
    for first, second, odds in ((known, other, 0.1), (other, known, 0.9)):
        both = first._replace(rival=second, rival_probability=odds)
        (correction,) = corrections(declared, (), (), both)
        assert correction.alternative is not None
        assert correction.alternative.site is second.site
        (frame,) = correction.rivals
        spreads.append(frame.spread[0])
    for spread, odds in zip(spreads, (0.1, 0.9), strict=True):
        assert abs(np.sqrt(spread[2, 2]) - np.sqrt(odds) * np.pi / 2.0) < 1e-6  # rad
    # The lever arm turns about the magnetometer: by as much in either frame.
    shift = np.linalg.norm(sensor.position_body[:2]) * np.sqrt(2.0)
    for spread, odds in zip(spreads, (0.1, 0.9), strict=True):
        assert abs(np.sqrt(np.trace(spread[3:, 3:])) - np.sqrt(odds) * shift) < 1e-9  # m


def test_the_other_frame_is_tried_where_the_first_is_contradicted() -> None:
    text = Finding("mounting", "It is turned.")
    other = Correction(text, demo_site())
    first = Correction(text, demo_site(), clear=True, alternative=other)
    unrelated = Correction(Finding("lever_arm", "It is long."), demo_site())

    names = {id(first): "first", id(other): "other", id(unrelated): "unrelated"}

    def by(explained: dict[str, tuple[bool, bool]]) -> str | None:
        def tried(correction: Correction) -> Trial[str]:
            name = names[id(correction)]
            return Trial(name, *explained[name], None)

        return best_trial([first, unrelated], tried)

    whole, much, nothing = (True, True), (False, True), (False, False)
    assert by({"first": whole}) == "first"
    assert by({"first": nothing, "other": whole}) == "other"
    assert by({"first": much, "other": whole}) == "other"
    assert by({"first": much, "other": much}) == "first"
    assert by({"first": nothing, "other": nothing}) is None
