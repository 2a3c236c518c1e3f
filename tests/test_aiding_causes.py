"""Gross mistakes of aiding sensors: units, signs, axes, known points, noise."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from aiding_site import aided_site
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import MOTION, State, states_of
from magfusion.estimation.integrity.aiding_causes import (
    AidingComparison,
    aiding_diagnosis,
    compared,
)
from magfusion.estimation.integrity.fault_isolation import Diagnosis
from magfusion.estimation.measurements.aiding_samples import aiding_measurements
from magfusion.estimation.measurements.relative_pose import RelativePose
from magfusion.model.aiding import AidingSamples, AidingSensor, AidingSigma, sensor_named
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.units import DEGREE, Array

LEVER = np.array([0.3, -0.2, 0.1])
ROOM = np.array([[0.5, 0.5, 0.8], [5.5, 4.5, 1.8]])
COV = np.diag(np.repeat([0.002, 0.005, 0.005, 0.01, 0.001], 3) ** 2)
POINTS = np.array([[6.0, 1.0, 2.0], [-3.0, 4.0, 0.5]])
WHEELS = AidingSensor(
    "wheels", "velocity", 0.01, constraint_sigma=None, sigmas=AidingSigma(scale=np.array(0.02))
)
OF_OFFSET = AidingSigma(offset=np.array(0.3))
SENSORS = (
    WHEELS,
    AidingSensor("visual", "velocity", 0.02, position_body=LEVER),
    *(
        AidingSensor(name, "range", 0.05, point_world=point, sigmas=OF_OFFSET)
        for name, point in zip(("anchor", "other"), POINTS, strict=True)
    ),
    AidingSensor("prism", "position", 0.01, position_body=LEVER),
    AidingSensor("level", "height", 0.02, sigmas=OF_OFFSET),
    AidingSensor(
        "air",
        "pressure",
        0.5,
        scale=np.array(-1.2 * 9.80665),
        offset=np.array(101325.0),
        sigmas=AidingSigma(offset=np.array(100.0)),
    ),
    AidingSensor("keyframes", "relative_pose", 0.005, rate_hz=2.0, rotation_sigma=0.2 * DEGREE),
    AidingSensor("compass", "heading", 0.5 * DEGREE, sigmas=AidingSigma(offset=np.array(0.02))),
)
NED = Rotation.from_euler("xyz", [180.0, 0.0, 90.0], degrees=True).as_matrix()
FLU = np.diag([1.0, -1.0, -1.0])


@cache
def _simulated() -> SimulatedLog:
    config = SimulationConfig(ROOM, 30.0, motion="walk", perturb=False)
    return simulate_log(aided_site(*SENSORS), config, np.random.default_rng(2))


def _diagnosed(site: Site, aiding: dict[str, AidingSamples]) -> Diagnosis | None:
    """Return what samples and the true motion show."""
    simulated, seen = _simulated(), dict[str, AidingComparison]()
    at, calibration = simulated.motion, initial_calibration(site, 0.0)
    parts = aiding_measurements(aiding, site, simulated.log.imu, (2.5, 29.0), None)
    for time, measured in parts:
        if isinstance(measured, RelativePose):
            bias = np.zeros((len(time), 6))
            measured = measured.over_interval(simulated.log.imu, 0.0, time, bias, site)
        motion = at.world_from_body(time).as_matrix(), at.position_world(time)
        each = zip(time.tolist(), *motion, at.velocity_world(time), strict=True)
        rest = np.zeros(3), np.zeros(3), calibration, COV
        states = states_of([State(*one, *rest) for one in each])
        cov, sensor = np.tile(COV, (len(time), 1, 1)), sensor_named(site.aiding, measured.sensor)
        assert cov.shape[1] == MOTION
        seen[sensor.name] = compared(measured, time, states, cov, sensor)
    return aiding_diagnosis(site, seen)


def _recorded(name: str, factor: Array | float, offset: float = 0.0) -> dict[str, AidingSamples]:
    """Return the log's samples, those of a sensor times a factor or a matrix."""
    every = _simulated().log.aiding
    own, value = every[name], every[name].value.copy()
    if isinstance(factor, np.ndarray):
        value = value @ factor.T
    elif own.quantity == "relative_pose":
        value[:, 1:4] *= factor
    else:
        value = factor * value + offset
    return {**every, name: replace(own, value=value)}


def test_nothing_is_wrong_with_what_is_as_declared() -> None:
    assert _diagnosed(aided_site(*SENSORS), dict(_simulated().log.aiding)) is None


@pytest.mark.parametrize(
    ("name", "factor", "offset", "unit"),
    [
        ("wheels", 3.6, 0.0, 1.0 / 3.6),
        ("wheels", -1.0, 0.0, -1.0),
        ("visual", 1e3, 0.0, 1e-3),
        ("anchor", 1e3, 0.0, 1e-3),
        ("level", -1.0, 0.0, -1.0),
        ("level", 1e3, 0.0, 1e-3),
        ("level", -1e3, 0.0, -1e-3),
        ("air", 1e-2, 0.0, 1e2),
        ("prism", 1e3, 0.0, 1e-3),
        ("keyframes", 1e3, 0.0, 1e-3),
        ("compass", DEGREE, 0.0, 1.0 / DEGREE),
        ("compass", -1.0, 0.0, -1.0),
        ("compass", -1.0, 0.5 * np.pi, -1.0),
    ],
)
def test_a_unit_or_sign_is_named_and_undone(
    name: str, factor: float, offset: float, unit: float
) -> None:
    site, aiding = aided_site(*SENSORS), _recorded(name, factor, offset)
    known = _diagnosed(site, aiding)
    assert known is not None
    assert known.site is not None
    assert known.finding.code == "aiding_units"
    assert known.finding.text.startswith(f"{name} contradicts")
    assert known.finding.remedy
    assert sensor_named(known.site.aiding, name).unit == pytest.approx(unit, rel=1e-5)
    assert _diagnosed(known.site, aiding) is None


@pytest.mark.parametrize(
    ("name", "axes", "key"),
    [("prism", NED, "world_from_sensor"), ("visual", FLU, "body_from_sensor")],
)
def test_axes_of_another_convention_are_named_and_undone(name: str, axes: Array, key: str) -> None:
    aiding = _recorded(name, axes)
    known = _diagnosed(aided_site(*SENSORS), aiding)
    assert known is not None
    assert known.site is not None
    assert known.finding.code == "aiding_mounting"
    corrected = getattr(sensor_named(known.site.aiding, name), key)
    np.testing.assert_allclose(corrected, axes.T, atol=1e-12)
    assert _diagnosed(known.site, aiding) is None


@pytest.mark.parametrize(
    ("moved", "words"),
    [
        ([12.0, 1.0, 2.0], "from the declared one"),
        ([6.0, -1.0, 2.0], "mirrored: y"),
        ([-6.0, 1.0, 2.0], "mirrored: x"),
        (POINTS[1].tolist(), "to the point of other"),
    ],
)
def test_a_wrong_point_of_ranges_is_named_and_undone(moved: list[float], words: str) -> None:
    wrong = replace(SENSORS[2], point_world=np.array(moved))
    others = tuple(
        replace(s, point_world=POINTS[0]) if s.name == "other" and "other" in words else s
        for s in SENSORS
    )
    site = aided_site(*(wrong if s.name == "anchor" else s for s in others))
    known = _diagnosed(site, dict(_simulated().log.aiding))
    assert known is not None
    assert known.site is not None
    assert known.finding.code == "aiding_point"
    assert words in known.finding.text
    right = sensor_named(known.site.aiding, "anchor").point_world
    np.testing.assert_allclose(right, POINTS[0], atol=0.2)
    assert _diagnosed(known.site, dict(_simulated().log.aiding)) is None


@pytest.mark.parametrize("name", ["visual", "anchor", "prism", "level", "air", "compass"])
def test_noise_that_is_declared_too_small_is_named(name: str) -> None:
    sensors = tuple(replace(s, sigma=0.1 * s.sigma) if s.name == name else s for s in SENSORS)
    known = _diagnosed(aided_site(*sensors), dict(_simulated().log.aiding))
    assert known is not None
    assert known.site is not None
    assert known.finding.code == "aiding_noise"
    (true,) = (s.sigma for s in SENSORS if s.name == name)
    assert sensor_named(known.site.aiding, name).sigma == pytest.approx(true, rel=0.25)


@pytest.mark.parametrize("quantity", ["anchor", "prism", "visual", "compass", "level"])
def test_a_clock_or_a_lever_arm_is_no_noise(quantity: str) -> None:
    def wrong(sensor: AidingSensor, late: float, moved: float) -> AidingSensor:
        lever = sensor.position_body + moved * np.array([1.0, 0.0, 0.8])
        return replace(sensor, time_offset=np.array(late), position_body=lever)

    for late, moved in ((0.2, 0.0), (0.0, 0.2)):
        sensors = (wrong(s, late, moved) if s.name == quantity else s for s in SENSORS)
        assert _diagnosed(aided_site(*sensors), dict(_simulated().log.aiding)) is None
