"""What a false beacon costs a smoothed log: the counting, and one walk as it is."""

from dataclasses import replace

import integrity_smooth
import numpy as np
import pytest


def test_what_is_trusted_and_far_off_is_counted() -> None:
    good = integrity_smooth.SmoothOutcome(
        share=0.1,
        ramp=0.0,
        error_m=1.1e-3,
        fault_free_m=1e-3,
        plain_m=1e-3,
        nees=5.0,
        verdict="trustworthy",
        fault_free_verdict="trustworthy",
    )
    off = replace(good, error_m=2e-3, nees=30.0)
    findings = replace(off, verdict="doubtful", fault_free_verdict="doubtful")
    result = integrity_smooth.figures([good, off, findings])
    assert (result.beyond_trusted, result.silent, result.doubtful_without_fault) == (1, 1, 1)
    assert result.ratio_worst_trusted == pytest.approx(2.0)
    assert result.cost_of_robustness == pytest.approx(0.0)
    expensive = integrity_smooth.figures([replace(good, fault_free_m=1.05e-3)])
    assert expensive.cost_of_robustness == pytest.approx(0.05)


@pytest.mark.slow
def test_a_false_beacon_costs_little_or_is_said() -> None:
    one = integrity_smooth.try_walk(integrity_smooth.Config(), np.random.default_rng(0))
    assert abs(one.share) > 0.01
    assert one.verdict != "trustworthy" or one.ratio < 1.5
    assert one.fault_free_verdict == "trustworthy"
    assert one.fault_free_m < 1.1 * one.plain_m
