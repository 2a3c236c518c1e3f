"""Strange but right inertial data are used; wrong units are told by what contradicts them."""

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_quality import recorded
from magfusion.files.plausible import check_imu
from magfusion.model.samples import ImuSamples, Log
from magfusion.units import DEGREE, STANDARD_GRAVITY, Array

RATE_HZ, DURATION = 200.0, 24.0
TIME = np.arange(int(RATE_HZ * DURATION)) / RATE_HZ
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def samples(gyro_body: Array, accel_body: Array) -> ImuSamples:
    rng, shape = np.random.default_rng(3), (len(TIME), 3)
    gyro = np.broadcast_to(gyro_body, shape) + 2e-3 * rng.normal(size=shape)
    accel = np.broadcast_to(accel_body, shape) + 2e-2 * rng.normal(size=shape)
    return ImuSamples(TIME, gyro, accel)


def rolling(rate: float) -> tuple[Array, Array]:
    """Return rates and gravity of a body that turns about a level axis (rad/s)."""
    angle = rate * TIME
    across = np.stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)], axis=1)
    return np.array([rate, 0.0, 0.0]), STANDARD_GRAVITY * across


def reported(imu: ImuSamples) -> set[str]:
    return {one.code for one in recorded(Log("odd", 0, "test", imu), None)}


def vibrating() -> Array:
    shake = 60.0 * np.sin(2.0 * np.pi * 37.0 * TIME)[:, None] * [1.0, 0.6, 0.3]
    return UP + shake


RIGHT = {
    "a centrifuge of three g": samples(np.array([0.0, 0.0, 5.4]), UP + np.array([28.0, 0.0, 0.0])),
    "600 deg/s about a level axis": samples(*rolling(600.0 * DEGREE)),
    "4000 deg/s about the vertical": samples(np.array([0.0, 0.0, 4000.0 * DEGREE]), UP),
    "a drilling tool": samples(np.array([0.0, 0.0, 20.0]), vibrating()),
    "two seconds of free fall": samples(
        np.zeros(3), np.where((TIME > 10.0) & (TIME < 12.0), 0.0, 1.0)[:, None] * UP
    ),
}


@pytest.mark.parametrize("name", RIGHT)
def test_nothing_is_said_of_strange_motion(name: str) -> None:
    check_imu(RIGHT[name], "imu")
    assert (
        reported(RIGHT[name])
        & {
            *(
                "accel_units",
                "gyro_units",
                "gyro_sign",
                "gravity_missing",
                "saturated",
                "imu_spikes",
            ),
        }
        == set()
    )


def test_deg_s_is_told_from_missing_gravity() -> None:
    """Too slow for its size to tell the unit: gravity does, which seems to turn in all ways."""
    rate, force = rolling(20.0 * DEGREE)
    wrong = samples(rate / DEGREE, force)
    check_imu(wrong, "imu")
    assert "gyro_units" in reported(wrong)
    assert "gravity_missing" not in reported(wrong)
    assert reported(samples(rate, force)) & {"gyro_units", "gravity_missing"} == set()
    fast, turning = rolling(150.0 * DEGREE)
    assert "gyro_sign" in reported(samples(-fast, turning))


def test_rates_that_gravity_contradicts_are_in_deg_s() -> None:
    rate, force = rolling(70.0 * DEGREE)
    with pytest.raises(InputError, match="deg/s"):
        check_imu(samples(rate / DEGREE, force), "imu")


def test_free_fall_throughout_is_a_cause_of_missing_gravity() -> None:
    result = [
        one
        for one in recorded(Log("odd", 0, "test", samples(np.zeros(3), np.zeros(3))), None)
        if one.code == "gravity_missing"
    ]
    assert "free fall" in result[0].text
