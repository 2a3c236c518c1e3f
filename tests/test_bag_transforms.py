"""A truth from transforms is composed along the tree of frames."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_bag import (
    POSITION,
    ROTATION,
    SENSORS,
    STAMPS,
    STORE,
    Make,
    N,
    header,
    write_bag,
    xyz,
)
from scipy.spatial.transform import Rotation
from test_bag_files import imported, recording

from magfusion.cli import main
from magfusion.files.foreign.bag_transforms import frame_chain
from magfusion.files.open import open_log
from magfusion.results.figures import Figures

KIND = "tf2_msgs/msg/TFMessage"
LEVER, TILT = np.array([0.1, 0.0, 0.2]), Rotation.from_euler("ZYX", [0.3, -0.2, 1.0])


@pytest.fixture(autouse=True)
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the check of imported logs, which has its own tests."""
    monkeypatch.setattr("magfusion.jobs.import_log.run_check", lambda _: Figures())


def _transform(k: int, parent: str, child: str, position: np.ndarray, turn: Rotation) -> Any:
    types = STORE.types
    return types["geometry_msgs/msg/TransformStamped"](
        types["std_msgs/msg/Header"](header(int(STAMPS[k])).stamp, parent),
        child,
        types["geometry_msgs/msg/Transform"](
            xyz("Vector3", position), xyz("Quaternion", turn.as_quat())
        ),
    )


Transforms = Callable[[int], list[tuple[str, str, np.ndarray, Rotation]]]


def _topic(transforms: Transforms) -> tuple[str, Make]:
    def message(k: int) -> Any:
        return STORE.types[KIND]([_transform(k, *one) for one in transforms(k)])

    return KIND, message


def _static(k: int) -> list[tuple[str, str, np.ndarray, Rotation]]:
    return [("base_link", "imu_link", LEVER, TILT)] if k == 0 else []


def _truth(path: Path, frames: str, topics: dict[str, tuple[str, Make]]) -> Any:
    bag = write_bag(path / "run", SENSORS | topics)
    log, figures = imported(path / "log", bag, map=(f"truth=/tf:{frames}",))
    assert log.truth is not None
    return log.truth, figures


def test_a_static_transform_is_composed_with_a_moving_one(tmp_path: Path) -> None:
    topics = {
        "/tf": _topic(lambda k: [("map", "base_link", POSITION[k], ROTATION[k])]),
        "/tf_static": _topic(_static),
    }
    truth, _ = _truth(tmp_path, "map->imu_link", topics)
    turn = ROTATION * TILT
    np.testing.assert_allclose(truth.time, (STAMPS - STAMPS[0]) * 1e-9, rtol=0, atol=1e-9)
    np.testing.assert_allclose(truth.position_world, POSITION + ROTATION.apply(LEVER), atol=1e-12)
    np.testing.assert_allclose(truth.world_from_body, turn.as_matrix(), atol=1e-12)


def test_a_transform_may_be_inverted_and_have_a_slash(tmp_path: Path) -> None:
    topics = {
        "/tf": _topic(lambda k: [("/imu_link", "/map", POSITION[k], ROTATION[k])]),
        "/tf_static": _topic(_static),
    }
    truth, _ = _truth(tmp_path, "map->base_link", topics)
    imu = ROTATION.inv()
    turn = imu * TILT.inv()
    position = -imu.apply(POSITION) - turn.apply(LEVER)
    np.testing.assert_allclose(truth.position_world, position, atol=1e-12)
    np.testing.assert_allclose(truth.world_from_body, turn.as_matrix(), atol=1e-12)


def test_a_slower_transform_is_interpolated_and_not_continued(tmp_path: Path) -> None:
    axis, speed, last = np.array([0.0, 0.0, 2.0]), np.array([1.0, -2.0, 0.5]), 32

    def drift(k: float) -> tuple[np.ndarray, Rotation]:  # uniform: interpolation is exact
        return 0.005 * k * speed, Rotation.from_rotvec(0.005 * k * axis)

    def moving(k: int) -> list[tuple[str, str, np.ndarray, Rotation]]:
        slow = [("map", "odom", *drift(k))] if k % 8 == 0 and k <= last else []
        return [("odom", "base_link", POSITION[k], ROTATION[k]), *slow]

    truth, figures = _truth(tmp_path, "map->base_link", {"/tf": _topic(moving)})
    assert len(truth) == last + 1
    assert figures["truth_dropped_without_a_pose"] == N - 1 - last
    for k, (position, turn) in enumerate(map(drift, range(last + 1))):
        expected = position + turn.apply(POSITION[k])
        np.testing.assert_allclose(truth.position_world[k], expected, atol=1e-9)  # m
        both = (turn * ROTATION[k]).as_matrix()
        np.testing.assert_allclose(truth.world_from_body[k], both, atol=1e-9)


def test_frames_of_two_trees_are_refused_with_the_transforms_that_there_are(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    topics = {
        "/tf": _topic(lambda k: [("world", "camera", POSITION[k], ROTATION[k])]),
        "/tf_static": _topic(_static),
    }
    bag, output = write_bag(tmp_path / "run", SENSORS | topics), tmp_path / "log"
    assert frame_chain([("world", "camera")], ("world", "world")) is None
    with pytest.raises(SystemExit) as ended:
        main(["import", str(bag), "--map", "truth=/tf:world->imu_link", "-o", str(output)])
    assert ended.value.code == 2
    error = capfd.readouterr().err
    assert "no transform world->imu_link (found world->camera, base_link->imu_link)" in error
    assert not output.exists()


def test_the_shared_bag_of_two_steps_has_a_truth(tmp_path: Path) -> None:
    bag = recording("tf_in_two_steps")
    base, _ = imported(tmp_path / "base", bag, map=("truth=/tf:map->base_link",))
    imu, _ = imported(tmp_path / "imu", bag, map=("truth=/tf:map->imu_link",))
    assert base.truth is not None
    assert imu.truth is not None
    assert len(imu.truth) == 300
    lever = imu.truth.position_world - base.truth.position_world
    np.testing.assert_allclose(np.linalg.norm(lever, axis=1), np.sqrt(0.05), atol=1e-9)  # m
    assert len(open_log(bag).imu) == 1200
