"""Tests of an online state's IMU: its biases against their declaration, and gravity."""

import numpy as np

from magfusion.estimation.data_checks.static_field import DOUBT
from magfusion.estimation.data_checks.statistics import DETECTION_SIGMAS
from magfusion.estimation.graph.preintegration import bias_walks
from magfusion.estimation.graph.state import State
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.running import DecayingSums
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict

MIN_SPAN = 1.0  # s; of inertial data, before gravity is tested
BEYOND_HELP = 0.2  # rad; a bias that tilts the vertical more makes inflation useless
START_SPAN = 6.0  # s; of the data before the first state, over which a bias walks, too
TURN_INTERVAL = 1.0  # s; of a gyro bias, before the fields correct it


def judge_biases(site: Site, state: State, elapsed: float) -> Judgement:
    """Test the biases against their declared sigmas and random walks since the start (s).

    The walks are those of the estimators, in which even a bias of sigma zero moves.
    """
    if not site.platform.inertial:
        return Judgement()
    imu = site.platform.imu
    gyro_walk, accel_walk = bias_walks(imu)
    result, inflation, turn = [], 1.0, 0.0
    for code, name, bias, sigma, walk, unit in (
        ("accel_bias", "accelerometer", state.accel_bias_body, imu.accel_bias_sigma,
         accel_walk, "m/s^2"),
        ("gyro_bias", "gyro", state.gyro_bias_body, imu.gyro_bias_sigma, gyro_walk, "rad/s"),
    ):  # fmt: skip
        score = np.abs(bias) / np.hypot(sigma, walk * np.sqrt(START_SPAN + elapsed))
        axis = int(score.argmax())
        worst = float(score[axis])
        if worst < DOUBT:
            continue
        size = float(np.linalg.norm(bias))
        off = size / site.gravity if code == "accel_bias" else size * TURN_INTERVAL
        verdict = (
            Verdict.FAILED if worst > DETECTION_SIGMAS and off > BEYOND_HELP else Verdict.DOUBTFUL
        )
        text = (
            f"The bias of the {name}'s {'xyz'[axis]} axis is {bias[axis]:.3g} {unit},"
            f" {worst:.0f} times what is declared: axes, signs or units of the IMU, its"
            " mounting to the magnetometer, or a declared sigma that is too small."
        )
        result.append(Finding("imu_bias", text, verdict, worst / DOUBT))
        inflation, turn = max(inflation, worst**2), max(turn, off)
    return Judgement(tuple(result), inflation=inflation, turn=turn)


def judge_gravity(site: Site, residual: DecayingSums, memory: float) -> Judgement:
    """Test the residual of the mean specific force: no platform falls for seconds.

    `residual`: mean specific force minus gravity, world axes (m/s^2), weighted by time. `memory`:
    its time constant (s).
    """
    span = residual.weight  # s of data, without the gaps of the IMU
    if span < MIN_SPAN or not site.platform.inertial:
        return Judgement()
    remaining = float(np.linalg.norm(residual.mean))
    motion, imu = site.platform.motion, site.platform.imu
    sigma = np.hypot(np.sqrt(2.0) * motion.speed_sigma / span, imu.accel_bias_sigma)
    score = remaining / sigma
    if score < DOUBT:
        return Judgement()
    angle = remaining / site.gravity
    verdict = Verdict.FAILED if angle > 2.0 * BEYOND_HELP else Verdict.DOUBTFUL
    text = (
        f"The mean specific force of the last {memory:g} s deviates by {remaining:.2g} m/s^2"
        " from gravity at the estimated attitude: axes or signs of the IMU, its mounting to"
        " the magnetometer, or gravity removed from its data."
    )
    return Judgement((Finding("gravity_direction", text, verdict, score / DOUBT),), turn=angle)
