"""Test of a log's calibration and biases against their declared values."""

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.data_checks.statistics import (
    MIN_INFORMATION_RATIO,
    TEST_BUDGET,
    TOLERATED,
    holm,
    log_p_chi_square,
    sigmas,
)
from magfusion.estimation.integrity.fault_candidates import (
    RARE,
    TILT,
    TYPICAL_TILT,
    FaultCandidate,
    survey_tilt,
)
from magfusion.estimation.integrity.fixed_parameter_test import MIN_EVIDENCE
from magfusion.estimation.integrity.released_fault import ReleasedFault
from magfusion.estimation.integrity.test_result import NOTHING, Case, TestResult
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    Block,
    Parameter,
    difference,
)
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

ABSURD = 50.0  # sigmas of a bias that no sensor has: the data do not match the declaration


def calibration_change(case: Case) -> TestResult:
    """Test the change of the calibration from its declared values."""
    result = case.result
    if not result.blocks:
        return NOTHING
    change, cov = _change_of(result)
    of_kind: dict[Parameter, list[Block]] = {}
    for block in result.blocks:
        of_kind.setdefault(block.parameter, []).append(block)
    joint = {kind: distance(change, cov, blocks) for kind, blocks in of_kind.items()}
    whole = distance(change, cov, list(result.blocks))
    # For each block, each kind of parameter, and all together.
    tests = [(block.parameter, distance(change, cov, [block])) for block in result.blocks]
    excess = _too_far([*tests, *joint.items(), (None, whole)])
    if not excess:
        return NOTHING
    findings = [
        _finding(kind, blocks, *joint[kind], change)
        for kind, blocks in of_kind.items()
        if kind in excess
    ]
    factor = np.full(len(case.pose_cov), max(excess.values()))
    tilt = _tilt(case, change, cov)
    if tilt is not None:
        return TestResult((_of_tilt(tilt),), factor=factor, causes=(tilt,))
    return TestResult(tuple(findings or [_of_all(*whole)]), factor=factor)


def _tilt(case: Case, change: Array, cov: Array) -> ReleasedFault | None:
    """Return the tilt of the survey if it explains the change of the calibration; else None."""
    site, blocks = case.result.declared.site, case.result.blocks
    surveyed = tuple(b for b in blocks if b.parameter in (BEACON_POSITION, BEACON_ROTATION))
    if not site.platform.inertial or len(surveyed) < max(2 * len(site.beacons), 1):
        return None
    tilt = survey_tilt(site, surveyed, len(change))
    whiten = _whitening(cov)
    residual, by_tilt = whiten.T @ change, whiten.T @ tilt
    information, turn = np.linalg.eigh(by_tilt.T @ by_tilt)
    if information[0] < 1.0:  # a typical tilt moves nothing by its sigma
        return None
    along = turn.T @ by_tilt.T @ residual
    gain = float(np.sum(along**2 / information))
    count = len(case.pose_cov)
    cause = ReleasedFault(
        FaultCandidate("the vertical of the survey", surveyed, tilt, TILT, RARE),
        step=tilt @ turn @ (along / information),
        direction=tilt @ turn,
        information=information,
        along=along,
        chi_square=gain,
        freedom=2,
        moved=np.zeros((count, 6)),  # the result has moved the beacons
        distance=np.zeros(count),
    )
    explains_all = float(residual @ residual) - gain < TOLERATED * len(residual)
    return cause if explains_all and cause.posterior_gain > MIN_EVIDENCE else None


def _whitening(cov: Array) -> Array:
    """Return the directions with information, (n, k), by which a change has unit covariance."""
    value, vector = np.linalg.eigh(0.5 * (cov + cov.T))
    known = value > MIN_INFORMATION_RATIO
    return np.asarray(vector[:, known] / np.sqrt(value[known]))


def _of_tilt(cause: ReleasedFault) -> Finding:
    size = np.linalg.lstsq(cause.fault.combine, cause.step, rcond=None)[0]
    tilt_deg = -np.rad2deg(TYPICAL_TILT * size)  # the step takes it back
    significance = float(sigmas(cause.log_p))
    return Finding(
        TILT,
        "The log moves all beacons together, as gravity contradicts the vertical of the survey: it"
        f" is tilted by {tilt_deg[0]:+.2g} deg about x and {tilt_deg[1]:+.2g} deg about y"
        f" ({significance:.0f} sigma). Rotate positions and attitudes of all beacons back: world z"
        " is the plumb line.",
        Verdict.DOUBTFUL,
        significance,
    )


def _too_far(
    tests: list[tuple[Parameter | None, tuple[float, int, float]]],
) -> dict[Parameter | None, float]:
    """Return the kinds of parameter whose tests fail, with the largest chi square per freedom."""
    informative = holm([log_p for _, (_, _, log_p) in tests], TEST_BUDGET)
    excess: dict[Parameter | None, float] = {}
    for (kind, (square, freedom, _)), yes in zip(tests, informative, strict=True):
        if yes and square > TOLERATED * freedom:
            excess[kind] = max(square / freedom, excess.get(kind, 0.0))
    return excess


def _change_of(result: Smoothed) -> tuple[Array, Array]:
    """Return the change of the calibration in declared sigmas, and its covariance."""
    spread = prior_sqrt_covariance(result.declared.site, result.blocks)
    change = difference(result.declared, result.calibration, result.blocks)
    cov = spread @ spread.T - result.calibration_cov
    moved = result.calibration_response  # considered parameters disturb the change as well
    cov = cov + 2.0 * moved @ moved.T
    scale = np.sqrt(np.diagonal(spread @ spread.T))
    return change / scale, cov / scale[:, None] / scale


def _of_all(square: float, freedom: int, log_p: float) -> Finding:
    """Return the finding that the calibration moved too far as a whole."""
    return Finding(
        "prior",
        "Together, the calibration parameters deviate from their declared values by more than their"
        f" sigmas allow: a chi square of {square:.3g} on {freedom}. Increase the declared sigmas by"
        f" a factor of {np.sqrt(square / freedom):.2g}.",
        Verdict.DOUBTFUL,
        float(sigmas(log_p)),
    )


def distance(change: Array, cov: Array, blocks: list[Block]) -> tuple[float, int, float]:
    """Return chi square of some blocks' change, its degrees of freedom and log probability.

    `change` (dimension,): in sigmas of the prior. `cov` (dimension, dimension): of the change;
    directions below `MIN_INFORMATION_RATIO` are ignored.
    """
    rows = np.concatenate([np.arange(len(change))[block.columns] for block in blocks])
    whiten = _whitening(cov[np.ix_(rows, rows)])
    freedom = whiten.shape[1]
    if not freedom:
        return 0.0, 1, 0.0
    square = float(np.sum((whiten.T @ change[rows]) ** 2))
    return square, freedom, float(log_p_chi_square(square, freedom))


def _finding(
    kind: Parameter, blocks: list[Block], square: float, freedom: int, log_p: float, change: Array
) -> Finding:
    unit = kind.display_unit
    moved = {b.name: float(np.max(np.abs(change[b.columns]))) for b in blocks}
    maximum = sorted(blocks, key=lambda b: -moved[b.name])[:3]
    amounts = ", ".join(f"{b.name} by {moved[b.name]:.1f} sigma" for b in maximum)
    declared = float(np.max([np.max(b.sigma) for b in blocks])) / unit.size
    times = float(np.sqrt(max(square / freedom, max(moved.values()) ** 2 / 4.0)))
    sigma = f"{declared:.3g} {unit.text}".rstrip(), f"{times * declared:.2g} {unit.text}".rstrip()
    return Finding(
        "prior",
        f"The log moves {amounts} from the declared values, more than their sigmas allow (a chi"
        f" square of {square:.3g} on {freedom}). Declare a sigma of {sigma[1]} instead of"
        f" {sigma[0]} for {kind.kind.replace('_', ' ')}, or measure it again.",
        Verdict.DOUBTFUL,
        float(sigmas(log_p)),
    )


def bias_change(case: Case) -> TestResult:
    """Test the biases of the IMU against the declared sigmas."""
    states, imu = case.result.states, case.result.declared.site.platform.imu
    assert states.accel_bias_body is not None
    assert states.gyro_bias_body is not None
    kinds = (
        ("accelerometer", states.accel_bias_body[0], imu.accel_bias_sigma, "m/s^2", "accel"),
        ("gyroscope", states.gyro_bias_body[0], imu.gyro_bias_sigma, "rad/s", "gyro"),
    )
    distances = [bias / max(sigma, 1e-9) for _, bias, sigma, _, _ in kinds]
    log_p = [float(log_p_chi_square(np.sum(d**2), 3)) for d in distances]
    findings, excess = [], 1.0
    for (name, bias, sigma, unit, key), d, p, yes in zip(
        kinds, distances, log_p, holm(log_p, TEST_BUDGET), strict=True
    ):
        if not yes:
            continue
        worst = int(np.argmax(np.abs(d)))
        excess = max(excess, float(np.sum(d**2)) / 3.0)
        findings.append(
            Finding(
                "imu_bias",
                f"The bias of the {name} is {bias[worst]:+.3g} {unit} on {'xyz'[worst]},"
                f" {abs(d[worst]):.0f} times the declared {key}_bias_sigma of {sigma:.2g}. The data"
                " are in another unit or frame than declared, or the sensor is uncalibrated."
                f" Calibrate it, or declare {key}_bias_sigma: {float(np.max(np.abs(bias))):.2g}.",
                Verdict.FAILED if float(np.max(np.abs(d))) > ABSURD else Verdict.DOUBTFUL,
                float(sigmas(p)),
            )
        )
    return TestResult(tuple(findings), factor=np.full(len(states), excess)) if findings else NOTHING
