"""The mounting of a magnetometer from the static transforms of a bag."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse, run_command
from example_bag import FIELD, IMU, Make, field_message, imu_message, write_bag
from scipy.spatial.transform import Rotation
from test_bag_transforms import KIND, STORE, _transform

from magfusion.files.site import load_site

IMU_PLACE, MAG_PLACE = np.array([0.1, 0.0, 0.2]), np.array([-0.3, 0.05, 0.4])  # m, of the base
IMU_TURN = Rotation.from_euler("ZYX", [90.0, 0.0, 180.0], degrees=True)
MAG_TURN = Rotation.from_euler("ZYX", [-30.0, 10.0, 5.0], degrees=True)


def _in_frame(make: Make, frame: str) -> Make:
    def message(k: int) -> Any:
        made = make(k)
        return replace(made, header=replace(made.header, frame_id=frame))

    return message


def _bag(path: Path, transforms: list[tuple[str, str, np.ndarray, Rotation]], **names: str) -> Path:
    topics: dict[str, tuple[str, Make]] = {
        "/imu/data": (IMU, _in_frame(imu_message, names.get("imu", "imu_link"))),
        "/mag": (FIELD, _in_frame(field_message, names.get("mag", "mag_link"))),
    }
    if transforms:
        static = STORE.types[KIND]([_transform(0, *one) for one in transforms])
        topics["/tf_static"] = KIND, lambda _: static
    return write_bag(path / "run", topics)


TREE = [
    ("base_link", "imu_link", IMU_PLACE, IMU_TURN),
    ("base_link", "mast", np.array([0.0, 0.0, 0.1]), Rotation.identity()),
    ("mast", "mag_link", MAG_PLACE - [0.0, 0.0, 0.1], MAG_TURN),
]


def test_the_chain_gives_lever_arm_and_mounting(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "site.yaml"
    run_command("init", "--bag", _bag(tmp_path, TREE), "-o", site)
    assert "imu_link -> base_link -> mast -> mag_link" in capfd.readouterr().out
    sensor = load_site(site, without=True).platform.magnetometer
    body_from_base = IMU_TURN.inv()
    lever = body_from_base.apply(MAG_PLACE - IMU_PLACE)
    np.testing.assert_allclose(sensor.position_body, lever, atol=1e-6)  # m
    expected = (body_from_base * MAG_TURN).as_matrix()
    np.testing.assert_allclose(sensor.body_from_sensor, expected, atol=1e-7)


def test_a_given_lever_arm_takes_precedence(tmp_path: Path) -> None:
    site = tmp_path / "site.yaml"
    run_command("init", "--bag", _bag(tmp_path, TREE), "--lever", "1,2,3", "-o", site)
    sensor = load_site(site, without=True).platform.magnetometer
    np.testing.assert_array_equal(sensor.position_body, [1.0, 2.0, 3.0])


def test_sensors_in_one_frame_are_not_apart(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bag, site = _bag(tmp_path, [], mag="imu_link"), tmp_path / "site.yaml"
    run_command("init", "--bag", bag, "-o", site)
    assert "imu_link is the frame of both" in capfd.readouterr().out
    sensor = load_site(site, without=True).platform.magnetometer
    np.testing.assert_array_equal(sensor.position_body, np.zeros(3))


@pytest.mark.parametrize(
    ("transforms", "names", "sentence"),
    [
        (TREE[:2], {}, "no chain of transforms from imu_link .IMU. to mag_link"),
        ([], {}, "found none.; give --lever and --mounting"),
        (
            [*TREE, ("tower", "mag_link", MAG_PLACE, MAG_TURN)],
            {},
            r"gives mag_link several parents \(mast, tower\)",
        ),
        (TREE, {"mag": ""}, "the messages of /mag name no frame"),
    ],
)
def test_a_chain_that_is_none_is_refused(
    tmp_path: Path,
    refuse: Refuse,
    transforms: list[tuple[str, str, np.ndarray, Rotation]],
    names: dict[str, str],
    sentence: str,
) -> None:
    site = tmp_path / "site.yaml"
    text = refuse("init", "--bag", _bag(tmp_path, transforms, **names), "-o", site)
    assert re.search(sentence, text)
    assert not site.exists()
