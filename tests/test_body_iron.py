"""Iron and magnets on the body: how large they are, the remedy, and what they explain."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mistake_remedy import follow_remedy
from spoiled_log import Recorded, field, good

from magfusion.errors import EstimationError
from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.data_checks.body_iron import IRON_SPAN, calibrated, fitted_iron
from magfusion.estimation.data_checks.data_quality import recorded
from magfusion.estimation.data_checks.gyro_field_consistency import left_handed_field
from magfusion.estimation.data_checks.still_means import still_means
from magfusion.estimation.integrity.judge import judge_result
from magfusion.files.site import load_site, save_site
from magfusion.jobs.magnetometer_trust import calibrated as calibrate_magnetometer
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

MAGNET = np.array([2e-5, 0.0, -1e-5])  # T, sensor axes
SOFT = 0.05 * np.array([[0.6, 0.8, -0.3], [0.8, -1.0, 0.5], [-0.3, 0.5, 0.4]])  # without a trace


def magnet(seed: int = 0) -> Recorded:
    return field(lambda v: v + MAGNET)(good("walk", seed))


def iron(seed: int = 0) -> Recorded:
    return field(lambda v: v @ (np.eye(3) + SOFT).T + 0.3 * MAGNET)(good("walk", seed))


def finding(one: Recorded) -> Finding:
    (found,) = (f for f in recorded(one.log, one.site) if f.code == "body_iron")
    return found


@pytest.mark.parametrize("seed", range(3))
def test_the_offset_of_a_magnet_is_found_and_no_matrix(seed: int) -> None:
    one = magnet(seed)
    site = calibrated(still_means(one.log, one.site, IRON_SPAN), one.site)
    np.testing.assert_array_equal(
        site.platform.magnetometer.matrix, one.site.platform.magnetometer.matrix
    )
    error = site.platform.magnetometer.offset - one.site.platform.magnetometer.offset - MAGNET
    assert np.linalg.norm(error) < 2e-6  # T


def test_a_matrix_declared_to_be_exact_is_kept() -> None:
    one = magnet()
    sensor = one.site.platform.magnetometer
    exact = replace(sensor, sigma=replace(sensor.sigma, matrix=np.zeros((3, 3))))
    site = replace(one.site, platform=one.site.platform.with_magnetometers((exact,)))
    offset = calibrated(still_means(one.log, site, IRON_SPAN), site).platform.magnetometer.offset
    assert np.linalg.norm(offset - sensor.offset - MAGNET) < 2e-6  # T


def test_of_soft_iron_the_matrix_is_found_too() -> None:
    """But for a common scale, which no rotation shows."""
    one = iron()
    site = calibrated(still_means(one.log, one.site, IRON_SPAN), one.site)
    before: Array = one.site.platform.magnetometer.matrix
    matrix = np.linalg.solve(before, site.platform.magnetometer.matrix) - np.eye(3)
    np.testing.assert_allclose(matrix - np.trace(matrix) / 3.0 * np.eye(3), SOFT, rtol=0, atol=0.02)


@pytest.mark.parametrize("one", [magnet(), iron()], ids=["magnet", "iron"])
def test_the_remedy_followed_leaves_nothing_to_report(one: Recorded, tmp_path: Path) -> None:
    save_site(one.site, tmp_path / "site.yaml")
    remedy = finding(one).remedy
    assert remedy
    follow_remedy(tmp_path / "site.yaml", remedy, tmp_path / "other.yaml")
    other = replace(one, site=load_site(tmp_path / "other.yaml"))
    codes = {f.code for f in recorded(other.log, other.site)}
    assert not codes & {"body_iron", "gyro_field", "earth_field", "mounting"}


def test_what_a_magnet_explains_is_not_reported_beside_it() -> None:
    one = magnet()
    found = finding(one)
    codes = [f.code for f in recorded(one.log, one.site)]
    assert found.explained
    assert not set(found.explained) & set(codes)


def test_without_rotation_no_iron_is_fitted() -> None:
    one = field(lambda v: v + MAGNET)(good("static"))
    assert fitted_iron(still_means(one.log, one.site, IRON_SPAN)) is None


def calibration_failure(one: Recorded) -> str:
    """Return why a calibration fails: without a solution, or by its verdict."""
    try:
        _, trust = calibrate_magnetometer(one.log, one.site)
    except EstimationError as failure:
        return str(failure)
    assert trust.verdict is Verdict.FAILED
    return " ".join(reason.text for reason in trust.reasons)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_a_reversed_axis_of_the_magnetometer_is_named_with_hard_iron(
    axis: int, offset: float
) -> None:
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    one = field(lambda v: v * signs + offset * MAGNET)(good("turn", 0))
    sensor = one.site.platform.magnetometer
    assert left_handed_field(good("turn", 0).log, one.site) is None
    assert left_handed_field(field(lambda v: v + MAGNET)(good("turn", 0)).log, one.site) is None
    place = int(np.argmax(np.abs(sensor.body_from_sensor[:, axis])))
    finding = left_handed_field(one.log, one.site)
    assert finding is not None
    assert f"the sign of {'xyz'[place]} (body axes) reversed" in finding.text
    assert any("axes are left-handed" in f.text for f in recorded(one.log, one.site))
    assert "axes are left-handed" in calibration_failure(one)


def test_a_calibration_that_fails_names_the_saturation() -> None:
    one = field(lambda v: np.clip(v, -2e-5, 2e-5))(good("turn", 0))
    assert re.search(r"magnetometer: axis \w is saturated at", calibration_failure(one))


@pytest.mark.slow
def test_a_magnet_is_the_only_reason_and_widens_no_pose() -> None:
    """The static field is compared with the Earth's without it."""
    sigma = []
    for one in (magnet(), good("walk", 0)):
        result, trust = judge_result(smooth(one.log, one.site), one.log)
        assert {f.code for f in trust.reasons} <= {"body_iron"}
        assert result.states.pose_cov is not None
        sigma.append(np.sqrt(np.mean(result.states.pose_cov[:, :3, :3].trace(axis1=1, axis2=2))))
    assert sigma[0] == pytest.approx(sigma[1], rel=0.1)
