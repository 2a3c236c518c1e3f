"""A corrected mounting may be an IMU that is turned: the poses then differ by a rigid motion."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.correction import Correction, with_rival_frame
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.simulation.demo_site import demo_site
from magfusion.units import DEGREE


def mounted(site: Site, body_from_sensor: np.ndarray, position_body: np.ndarray) -> Site:
    magnetometer = replace(
        site.platform.magnetometer, body_from_sensor=body_from_sensor, position_body=position_body
    )
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


def test_its_spread_has_the_motion_of_the_body_about_the_magnetometer() -> None:
    rng = np.random.default_rng(2)
    turn = Rotation.from_rotvec([2.0 * DEGREE, -3.0 * DEGREE, 1.0 * DEGREE])
    before, place = Rotation.random(random_state=rng).as_matrix(), np.array([0.05, -0.04, 0.08])
    after, moved = turn.as_matrix() @ before, place + np.array([0.01, 0.0, -0.006])
    declared = mounted(demo_site(), before, place)
    correction = Correction(Finding("mounting", "It is turned."), mounted(declared, after, moved))
    spread = with_rival_frame(declared, correction)
    assert spread is not None
    # The magnetometer has one pose in the world; the body follows by either mounting.
    world_from_sensor, sensor_world = Rotation.random(random_state=rng).as_matrix(), np.ones(3)
    poses = []
    for mounting, position in ((before, place), (after, moved)):
        world_from_body = world_from_sensor @ mounting.T
        poses.append((world_from_body, sensor_world - world_from_body @ position))
    (one, at), (other, there) = poses
    step = np.concatenate([Rotation.from_matrix(other.T @ one).as_rotvec(), other.T @ (at - there)])
    assert np.allclose(spread[0], 0.5 * np.outer(step, step), rtol=0.0, atol=1e-9)
