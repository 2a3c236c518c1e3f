"""The reach of one beacon: the law of its range, the acceptance figure, and the tensor method."""

import json
import sys
from pathlib import Path

import coverage_radius
import numpy as np
import pytest
from coverage_radius import CASES, RANGES, Config, RadiusOutcome, coefficients


@pytest.fixture(scope="module")
def outcomes() -> RadiusOutcome:
    return coverage_radius.run(Config(runs=6000, raw_runs=300))


def test_a_minute_at_twenty_metres_errs_as_expected(
    outcomes: RadiusOutcome,
) -> None:
    minute = next(c for c in outcomes.curves if c.samples == 12_000)
    assert minute.eq7[RANGES.index(20.0)] == pytest.approx(1.64, rel=0.06)  # deg^2
    assert outcomes.raw.phasors[0] == pytest.approx(1.64, rel=0.06)


def test_simulated_samples_and_the_law_of_the_noise_agree(outcomes: RadiusOutcome) -> None:
    raw = outcomes.raw
    for samples, phasors, sigma in zip(raw.samples, raw.phasors, raw.relative_error, strict=True):
        assert samples / phasors == pytest.approx(1.0, abs=3.0 * sigma)
        assert sigma < 0.08


def test_the_curves_follow_the_law_where_the_error_is_small(outcomes: RadiusOutcome) -> None:
    for curve in outcomes.curves:
        law = np.array(curve.law_eq7)
        small = law < 10.0  # deg^2; the law is of first order in the noise
        np.testing.assert_allclose(np.array(curve.eq7)[small], law[small], rtol=0.08)


def test_the_error_follows_the_sixth_power_without_a_knee(outcomes: RadiusOutcome) -> None:
    for curve in outcomes.curves[1:]:  # one second of samples is small at two ranges only
        small = np.array(curve.law_eq7) < 30.0  # deg^2; the law is of first order
        slope = np.polyfit(np.log(RANGES)[small], np.log(curve.eq7)[small], 1)[0]
        assert slope == pytest.approx(6.0, abs=0.1)
        assert max(np.array(RANGES)[small]) >= 30.0


def test_far_away_the_direction_comes_near_a_random_one(outcomes: RadiusOutcome) -> None:
    rng, true = np.random.default_rng(2), coverage_radius.direction(45.0)
    result = coverage_radius.eq_07_direction(rng.standard_normal((100_000, 3)))
    random = float(np.mean(coverage_radius.between_deg(result, true) ** 2))
    assert 0.85 * random < outcomes.curves[0].eq7[-1] < random


def test_one_degree_takes_the_samples_that_are_expected(
    outcomes: RadiusOutcome,
) -> None:
    needed = {c.moment: (c.samples_at_20m, c.samples_at_14m) for c in outcomes.curves}
    assert needed[65.0] == pytest.approx((61_000, 7200), rel=0.02)
    assert needed[115.0] == pytest.approx((19_000, 2300), rel=0.03)


@pytest.mark.parametrize(
    ("polar_deg", "eq7", "tensor"),
    [
        (5.0, 0.228, 0.224),
        (35.3, 0.460, 0.227),
        (54.7, 1.13, 0.208),
        (75.0, 6.4, 0.176),
        (80.0, 14.5, 0.170),
    ],
)
def test_coefficients_are_as_expected(polar_deg: float, eq7: float, tensor: float) -> None:
    assert coefficients(polar_deg) == pytest.approx((eq7, tensor), rel=0.05)


def test_simulated_directions_obey_the_coefficients_of_either_method(
    outcomes: RadiusOutcome,
) -> None:
    noise = coverage_radius.relative_noise(Config(), 115.0, 12_000, 20.0) / coverage_radius.DEGREE
    for row in outcomes.at_twenty[:-1]:  # nearer the plane second order adds to Eq 7
        law = np.array([row.coefficient_eq7, row.coefficient_tensor]) * noise**2
        np.testing.assert_allclose([row.eq7, row.tensor], law, rtol=0.07)


@pytest.mark.slow
def test_the_scenario_draws_and_ends_with_one_json_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "argv", ["coverage_radius.py", "--quick", "-o", str(tmp_path)])
    coverage_radius.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(json.loads(lines[-1])["curves"]) == len(CASES)
    assert sum(line.split()[:1] == ["tensor"] for line in lines[:-1]) == len(CASES)
    assert (tmp_path / "coverage_radius.png").stat().st_size > 10_000
