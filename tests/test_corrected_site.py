"""A corrected site predicts what the moved parameters of the declared one do."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.change_detection import CHANGED, step_of
from magfusion.estimation.integrity.corrected_site import (
    NO_GRAVITY,
    corrected_site,
    with_bias_walk,
    with_intrinsics,
)
from magfusion.estimation.integrity.correction import Correction, released
from magfusion.estimation.integrity.fault_candidates import (
    EPOCH_SHIFT,
    SAMPLE_RATE,
    TILT,
    TYPICAL_SHIFT,
    TYPICAL_TILT,
    FaultCandidate,
    fault_candidates,
    fixed_blocks,
)
from magfusion.estimation.integrity.released_fault import ReleasedFault
from magfusion.files.site_changes import changed_keys
from magfusion.model.parameters import initial_calibration, placed, predict_channels, retract
from magfusion.model.parameters.inertial import (
    ACCEL_BIAS,
    GRAVITY,
    GYRO_ALIGNMENT,
    GYRO_BIAS,
    GYRO_G_SENSITIVITY,
    GYRO_SCALE,
    Bias,
)
from magfusion.model.site import Location
from magfusion.model.trust import Finding
from magfusion.simulation.demo_site import demo_site

SITE = demo_site()
FIXED = fixed_blocks(SITE, (), static=True)
KINDS = ("position", "rotation", "log_moment", "phase", "matrix")


@pytest.mark.parametrize("kind", KINDS)
def test_one_parameter_moves_fields_as_a_step_of_the_calibration_does(kind: str) -> None:
    rng = np.random.default_rng(3)
    time, place = np.zeros(4), rng.uniform([1.0, 0.5, 0.0], [3.0, 2.5, 2.0], (4, 3))
    turn = Rotation.random(4, rng=rng).as_matrix()
    chosen = [
        f for f in fault_candidates(SITE, FIXED) if len(f.blocks) == 1 and f.blocks[0].kind == kind
    ]
    assert chosen
    for fault in chosen:
        block = fault.blocks[0]
        step = np.zeros(FIXED[-1].columns.stop)
        step[block.columns] = rng.standard_normal(len(block.sigma))
        moved = retract(
            initial_calibration(SITE, 0.0),
            placed([block]),
            block.sigma * step[block.columns],
        )
        by_site = initial_calibration(corrected_site(SITE, fault, step), 0.0)
        expected = predict_channels(moved, time, turn, place)
        np.testing.assert_allclose(predict_channels(by_site, time, turn, place), expected)


def test_each_fault_has_a_name_of_its_own() -> None:
    """A fault is recognised by its name in the solution that is corrected for another."""
    names = [fault.name for fault in fault_candidates(SITE, FIXED)]
    assert len(set(names)) == len(names)


def test_a_tilt_turns_places_and_attitudes_together() -> None:
    fault = next(one for one in fault_candidates(SITE, FIXED) if one.code == TILT)
    tilted = corrected_site(SITE, fault, fault.combine @ (np.deg2rad([2.0, -1.0]) / TYPICAL_TILT))
    turn = Rotation.from_rotvec(np.deg2rad([2.0, -1.0, 0.0])).as_matrix()
    for before, after in zip(SITE.beacons, tilted.beacons, strict=True):
        np.testing.assert_allclose(after.position_world, turn @ before.position_world, atol=1e-9)
        np.testing.assert_allclose(
            after.world_from_beacon, turn @ before.world_from_beacon, atol=1e-9
        )


def test_a_released_parameter_is_as_uncertain_as_it_was_wrong() -> None:
    """Unless the user has its group fixed; a survey's common errors are not released at all."""
    lever, tilt = (
        next(one for one in fault_candidates(SITE, FIXED) if one.finding_code == code)
        for code in ("lever_arm", TILT)
    )
    (block,) = lever.blocks
    step = np.zeros(FIXED[-1].columns.stop)
    step[block.columns] = [3.0, 0.0, -4.0]  # cm
    finding = Finding("lever_arm", "")
    moved = Correction(finding, corrected_site(SITE, lever, step), lever, step=step)
    known, free = released(moved, SITE, ("phase",)), released(moved, SITE, None)
    assert known.site is moved.site
    assert not known.released
    assert free.released == (block,)
    sensor = free.site.platform.magnetometer
    np.testing.assert_allclose(sensor.sigma.position_body, 0.05, rtol=1e-9)  # m
    np.testing.assert_array_equal(
        sensor.position_body, moved.site.platform.magnetometer.position_body
    )
    tilted = Correction(finding, corrected_site(SITE, tilt, step), tilt, step=step)
    assert released(tilted, SITE, None) is tilted


def test_what_snapshots_estimate_is_estimated_from_the_whole_log() -> None:
    """A beacon at another place; what they choose among usual mistakes is certain."""
    first, *others = SITE.beacons
    place = first.position_world + np.array([0.3, 0.0, -0.4])
    moved = replace(first, position_world=place)
    site = replace(SITE, beacons=(moved, *others))
    estimate = Correction(Finding("beacon_pose", ""), site, is_estimate=True)
    result = released(estimate, SITE, None)
    assert [(block.kind, block.owner) for block in result.released] == [("position", first.name)]
    sigma = result.site.beacons[0].sigma
    np.testing.assert_allclose(sigma.position_world, 0.5, rtol=1e-9)  # m
    np.testing.assert_array_equal(sigma.rotation_beacon, first.sigma.rotation_beacon)
    # Of two beacons that are off, what is common is as uncertain as each of them was wrong.
    second, *rest = others
    low = replace(second, position_world=second.position_world - np.array([0.0, 0.3, 0.4]))
    both = released(estimate._replace(site=replace(site, beacons=(moved, low, *rest))), SITE, None)
    assert [block.owner for block in both.released] == [first.name, second.name]
    for beacon in both.site.beacons[:2]:
        np.testing.assert_allclose(beacon.sigma.position_world, 0.5 * np.sqrt(2.0), rtol=1e-9)  # m
    chosen = estimate._replace(is_estimate=False)
    assert released(chosen, SITE, None) is chosen


def test_errors_of_an_imu_add_to_those_that_are_declared() -> None:
    """A gyro of two errors, one after the other: both are taken off."""
    rng = np.random.default_rng(5)
    rate, force = rng.standard_normal((2, 20, 3))
    site = with_intrinsics(SITE, g_sensitivity=1e-3 * rng.standard_normal((3, 3)))
    for kind in (GYRO_SCALE, GYRO_ALIGNMENT, GYRO_G_SENSITIVITY):
        fault = next(
            one for one in fault_candidates(SITE, FIXED) if one.blocks[0].parameter == kind
        )
        step = np.zeros(FIXED[-1].columns.stop)
        step[fault.blocks[0].columns] = rng.standard_normal(fault.blocks[0].parameter.size)
        site = corrected_site(site, fault, step)
    known = site.platform.imu_intrinsics
    assert known is not None
    measured = rate @ known.gyro_matrix.T + force @ known.gyro_g_sensitivity.T
    np.testing.assert_allclose(site.platform.corrected_imu(measured, force)[0], rate, atol=1e-12)


def test_a_key_that_goes_is_told_too() -> None:
    """A corrected Earth field replaces the location's, of which a file may have but one."""
    place = Location(50.9, 13.3, 400.0, "2026-11-26")
    declared = replace(SITE, location=place, earth_field_world=None)
    changed = changed_keys(declared, replace(SITE, location=None))
    assert "world.earth_field_t" in changed
    assert changed["world.location"] is None


def test_a_bias_beyond_its_sigma_is_declared_to_be_so_uncertain() -> None:
    fault = next(
        one for one in fault_candidates(SITE, FIXED) if one.blocks[0].parameter is GYRO_BIAS
    )
    step = fault.combine @ np.array([1.0, -4.0, 0.0])  # of 0.01 rad/s
    corrected = corrected_site(SITE, fault, step)
    assert changed_keys(SITE, corrected) == {"platform.imu.gyro_bias_sigma": pytest.approx(0.04)}


@pytest.mark.parametrize(
    ("kind", "size", "key"),
    [(GYRO_BIAS, 0.014, "gyro_bias_walk"), (ACCEL_BIAS, 0.22, "accel_bias_walk")],
)
def test_a_bias_that_steps_may_change_by_so_much_in_a_second(
    kind: Bias, size: float, key: str
) -> None:
    (block,) = placed([step_of(kind, "imu", 20.0)])
    step = np.array([0.6, 0.0, -0.8]) * size / block.sigma
    fault = FaultCandidate("the bias", (block,), np.eye(3), CHANGED)
    known = np.eye(3), np.ones(3), step, 100.0, 3
    cause = ReleasedFault(fault, step, *known, np.zeros((1, 6)), np.zeros(1))
    changed = changed_keys(SITE, with_bias_walk(SITE, cause))
    assert changed == {f"platform.imu.{key}": pytest.approx(size)}  # per sqrt(s)


def test_drifts_of_all_beacons_alike_are_the_magnetometers_clock() -> None:
    fault = next(one for one in fault_candidates(SITE, FIXED) if one.code == SAMPLE_RATE)
    assert {block.owner for block in fault.blocks} == {beacon.name for beacon in SITE.beacons}
    corrected = corrected_site(SITE, fault, fault.combine @ np.array([20.0]))  # of 1 ppm
    changed = changed_keys(SITE, corrected)
    assert changed == {"platform.magnetometer.clock_rate_ppm": pytest.approx(20.0)}


def test_gravity_that_was_removed_is_declared_as_nearly_none() -> None:
    fault = next(one for one in fault_candidates(SITE, FIXED) if one.blocks[0].parameter is GRAVITY)
    corrected = corrected_site(SITE, fault, fault.combine @ np.array([-981.0]))  # of 0.01 m/s^2
    assert changed_keys(SITE, corrected) == {"world.gravity_m_s2": NO_GRAVITY}


def test_a_shift_of_the_epoch_turns_each_tone_by_its_frequency() -> None:
    fault = next(one for one in fault_candidates(SITE, FIXED) if one.code == EPOCH_SHIFT)
    delay = 0.4e-3  # s
    shifted = corrected_site(SITE, fault, fault.combine @ [delay / TYPICAL_SHIFT])
    for before, after in zip(SITE.beacons, shifted.beacons, strict=True):
        for coil, later in zip(before.coils, after.coils, strict=True):
            frequency_hz = coil.frequency_hz or before.frequency_hz
            turned = 2.0 * np.pi * frequency_hz * delay
            np.testing.assert_allclose(later.phase - coil.phase, turned, rtol=1e-9)
