"""The witnesses of a smoothed log: clean ones are trusted, and whatever is wrong is named first."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from small_problem import small_log

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.data_checks.statistics import (
    effective_number,
    holm,
    log_p_chi_square,
    sigmas,
)
from magfusion.estimation.integrity.fault_candidates import CODE, fault_candidates, fixed_blocks
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.integrity.score import scores_of
from magfusion.model.parameters import LOG_MOMENT, SENSOR_POSITION, SENSOR_ROTATION
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, Site
from magfusion.model.trust import CODES, Trust, Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.units import Array

COVERED = 15.0  # mean NEES of a result that has been made honest; six is expected of a clean one


@cache
def a_log(seed: int, *, perturb: bool = True) -> tuple[Log, Site]:
    # Weak noise in long windows: of a small log each of them must tell much.
    small = small_log(seed, epochs=60, sigma=2e-9, perturb=perturb)
    return small.log, replace(small.site, model_error=1e-3)


def verdict_on(log: Log, site: Site) -> tuple[Smoothed, Smoothed, Trust]:
    result = smooth(log, site, SmootherSettings(loss="cauchy"))
    return (result, *judge_result(result, log))


def nees(result: Smoothed, log: Log) -> float:
    assert log.truth is not None
    errors = trajectory_errors(result.states, log.truth, max_gap=1.0)
    assert errors.nees is not None
    return float(np.mean(errors.nees))


def with_magnetometer(site: Site, **changed: Array) -> Site:
    magnetometer = replace(site.platform.magnetometer, **changed)
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


def lever_arm_off(site: Site) -> Site:
    lever = site.platform.magnetometer.position_body
    return with_magnetometer(site, position_body=lever + np.array([0.2, 0.0, 0.0]))


def mounting_off(site: Site) -> Site:
    turn = Rotation.from_rotvec(np.deg2rad([6.0, 0.0, 8.0])).as_matrix()
    mounting = site.platform.magnetometer.body_from_sensor
    return with_magnetometer(site, body_from_sensor=mounting @ turn)


def beacon_moved(site: Site) -> Site:
    first, *others = site.beacons
    place = first.position_world + np.array([0.05, 0.0, 0.0])
    return replace(site, beacons=(replace(first, position_world=place), *others))


def moments_rms(site: Site) -> Site:
    def smaller(beacon: Beacon) -> Beacon:
        weaker = (replace(c, moment_beacon=c.moment_beacon / np.sqrt(2.0)) for c in beacon.coils)
        return replace(beacon, coils=tuple(weaker))

    return replace(site, beacons=tuple(smaller(b) for b in site.beacons))


def survey_overconfident(site: Site) -> Site:
    """Declare 1 cm of beacons that are 5 cm off, each somewhere else."""
    rng, beacons = np.random.default_rng(3), []
    for beacon in site.beacons:
        sigma = replace(beacon.sigma, position_world=np.full(3, 0.01))
        place = beacon.position_world + 0.05 * rng.standard_normal(3)
        beacons.append(replace(beacon, position_world=place, sigma=sigma))
    return replace(site, beacons=tuple(beacons))


WRONG: dict[str, tuple[Callable[[Site], Site], str, str]] = {
    "lever arm 20 cm off": (lever_arm_off, "lever_arm", "lever arm"),
    "mounting 10 degrees off": (mounting_off, "mounting", "mounting"),
    "a beacon moved by 5 cm": (beacon_moved, "beacon_pose", "beacon A"),
    "moments given as rms": (moments_rms, "field_scale", "1.4"),
    "a survey declared too good": (survey_overconfident, "prior", "position"),
}


@pytest.mark.parametrize("seed", [1, 3])
def test_a_clean_log_is_trusted_and_its_covariance_left_alone(seed: int) -> None:
    log, site = a_log(seed)
    result, honest, trust = verdict_on(log, site)
    assert trust.verdict is Verdict.TRUSTWORTHY, trust.reasons
    np.testing.assert_array_equal(honest.states.pose_cov, result.states.pose_cov)
    assert result.converged
    assert nees(honest, log) < 12.0


@pytest.mark.slow
@pytest.mark.parametrize(("mistake", "code", "word"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_named_first_and_covered(
    mistake: Callable[[Site], Site], code: str, word: str
) -> None:
    log, site = a_log(1, perturb=False)
    result, honest, trust = verdict_on(log, mistake(site))
    assert trust.verdict is not Verdict.TRUSTWORTHY
    first = trust.reasons[0]
    assert first.code == code
    assert word in first.text
    assert nees(result, log) > 9.0  # or nothing would have to be said
    assert nees(honest, log) < COVERED


def test_a_false_bias_of_the_imu_is_said() -> None:
    log, site = a_log(1, perturb=False)
    imu = replace(log.imu, gyro_body=log.imu.gyro_body + np.array([0.0, 0.1, 0.0]))
    _, _, trust = verdict_on(replace(log, imu=imu), site)
    findings = next(f for f in trust.reasons if f.code == "imu_bias")
    assert "the gyro's y +0.1" in findings.text


def test_a_disturbed_beacon_is_said_with_its_time() -> None:
    log, site = a_log(2)
    assert log.fields is not None
    phasor, now = log.fields.phasor_sensor.copy(), log.fields.time > log.fields.time[40]
    phasor[now, 1] *= 1.1
    false = replace(log, fields=replace(log.fields, phasor_sensor=phasor))
    _, honest, trust = verdict_on(false, site)
    first = trust.reasons[0]
    assert first.code == "changed"
    assert f"the strength of beacon {site.beacons[1].name} by" in first.text
    assert nees(honest, log) < COVERED


def test_at_rest_the_lever_arm_is_listed_as_unverified() -> None:
    log, site = a_log(1)
    assert log.fields is not None
    assert log.truth is not None
    n, world_from_body = len(log.imu), log.truth.world_from_body[0]
    force = np.array([0.0, 0.0, site.gravity]) @ world_from_body
    rng, model = np.random.default_rng(5), site.platform.imu
    rate = np.sqrt(1.0 / np.median(np.diff(log.imu.time)))
    imu = replace(
        log.imu,
        gyro_body=model.gyro_noise * rate * rng.standard_normal((n, 3)),
        accel_body=force + model.accel_noise * rate * rng.standard_normal((n, 3)),
    )
    noise = 2e-9 * rng.standard_normal((2, *log.fields.phasor_sensor.shape))
    stationary = np.repeat(log.fields.phasor_sensor[:1], len(log.fields), axis=0)
    fields = replace(log.fields, phasor_sensor=stationary + noise[0] + 1j * noise[1])
    result, _, trust = verdict_on(replace(log, imu=imu, fields=fields, truth=None), site)
    listed = {one.name: one for one in trust.unverified}
    assert "sensor.position" in listed
    lever = listed["sensor.position"]
    sigma = result.declared.site.platform.magnetometer.sigma.position_body
    assert lever.position_m == pytest.approx(np.linalg.norm(sigma), rel=0.1)
    assert lever.sigma == "0.1 cm"


@pytest.mark.slow
def test_the_score_foretells_what_solving_again_finds() -> None:
    """A step of the score is where the solution goes once the parameter is estimated."""
    log, site = a_log(4, perturb=False)
    off = with_magnetometer(
        site, position_body=site.platform.magnetometer.position_body + np.array([0.01, 0.0, 0.0])
    )
    fixed = smooth(log, off, SmootherSettings(estimate=()))
    scores = scores_of(fixed, log.imu)
    assert scores is not None
    score = scores.fixed
    lever = next(b for b in score.fixed if b.parameter == SENSOR_POSITION)
    rows = np.arange(len(score.information))[lever.columns]
    information = score.information[np.ix_(rows, rows)]
    step = lever.sigma * np.linalg.solve(information, score.gradient[rows])
    sigma = site.platform.magnetometer.sigma
    wide = replace(sigma, position_body=np.full(3, 10.0))
    magnetometer = replace(off.platform.magnetometer, sigma=wide)
    free_parameters = replace(off, platform=replace(off.platform, magnetometer=magnetometer))
    released = smooth(log, free_parameters, SmootherSettings(estimate=("extrinsics",)))
    result = released.calibration.site.platform.magnetometer.position_body
    change = result - off.platform.magnetometer.position_body
    # The mounting was free as well there, and moves little.
    np.testing.assert_allclose(step, change, atol=2e-3)
    spread = lever.sigma[0] * np.sqrt(np.linalg.inv(information)[0, 0])
    assert step[0] == pytest.approx(-0.01, abs=max(3e-3, 4.0 * spread))


def test_everything_that_is_held_is_asked() -> None:
    _, site = a_log(1)
    fixed = fixed_blocks(site, (), static=False)
    kinds = {block.parameter for block in fixed}
    assert {LOG_MOMENT, SENSOR_POSITION, SENSOR_ROTATION} <= kinds
    assert sum(b.parameter == LOG_MOMENT for b in fixed) == len(site.beacons)
    requested = list(fault_candidates(site, fixed))
    assert len({s.name for s in requested}) >= len(fixed)
    fewer = fixed_blocks(site, fixed[:3], static=False)
    assert {b.key for b in fewer} == {b.key for b in fixed[3:]}


def test_probabilities_far_out_are_finite_and_right() -> None:
    assert float(log_p_chi_square(30.0, 6)) == pytest.approx(chi2.logsf(30.0, 6))
    # Of two degrees of freedom the logarithm is exactly minus half the value.
    np.testing.assert_allclose(log_p_chi_square(np.array([2e3, 1e6]), 2), [-1e3, -5e5], rtol=1e-9)
    assert float(log_p_chi_square(1199.9, 9)) > float(log_p_chi_square(1200.1, 9)) > -700.0
    assert float(sigmas(np.log(0.0026997960632))) == pytest.approx(3.0)
    assert float(sigmas(-5e5)) == pytest.approx(1e3, rel=1e-3)


def test_holm_keeps_the_budget_of_all_tests_together() -> None:
    rng = np.random.default_rng(8)
    alarms = [np.any(holm(np.log(rng.uniform(size=40)), 0.1)) for _ in range(2000)]
    assert np.mean(alarms) == pytest.approx(0.1, abs=4.0 * np.sqrt(0.1 * 0.9 / 2000))
    assert holm(np.log([0.001, 0.5, 0.002]), 0.005).tolist() == [True, False, True]


def test_the_effective_number_counts_what_is_independent() -> None:
    rng = np.random.default_rng(9)
    white = rng.standard_normal(4000)
    assert effective_number(white) == pytest.approx(4000, rel=0.05)
    slow = np.convolve(white, np.ones(20), mode="valid")
    # Of a triangular correlation over 20 samples: one in about 13.
    assert effective_number(slow) == pytest.approx(len(slow) / 13.4, rel=0.25)


@pytest.mark.parametrize(("rows", "lasting"), [(30, 0.85), (60, 0.9), (80, 0.5)])
def test_the_effective_number_is_what_the_mean_square_of_short_series_scatters_by(
    rows: int, lasting: float
) -> None:
    """Of n independent numbers the mean square has a variance of 2 / n; few rows have fewer lags.

    Parameters
    ----------
    lasting : float
        Correlation of a row with the next.
    """
    rng, series = np.random.default_rng(10), 20_000
    noise = rng.standard_normal((rows, series))
    for k in range(1, rows):
        noise[k] = lasting * noise[k - 1] + np.sqrt(1.0 - lasting**2) * noise[k]
    scatter = np.var(np.mean(noise**2, axis=0))
    # A variance of squares from so many: 2 %, as long as their distribution has no long tail.
    assert effective_number(noise) == pytest.approx(2.0 / scatter, rel=0.06)


def test_every_code_of_a_held_parameter_is_documented() -> None:
    assert set(CODE.values()) <= set(CODES)
