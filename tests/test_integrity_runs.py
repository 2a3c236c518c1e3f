"""The integrity of runs: what is simulated is what is said, and the promise is kept in a few."""

import integrity_runs
import numpy as np
import pytest

from magfusion.model.trust import Risk


def test_the_error_of_the_field_is_smooth_in_space_and_of_the_declared_size() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0.0, 5.0, (400, 3))
    error = integrity_runs.error_in_space(points, 200, 5e-4, np.random.default_rng(2))
    assert np.std(error) == pytest.approx(5e-4, rel=0.05)
    near = integrity_runs.error_in_space(points + 1e-3, 200, 5e-4, np.random.default_rng(2))
    assert np.std(near - error) < 0.02 * np.std(error)  # a millimetre away it is the same


def test_a_fault_is_in_one_beacon_and_not_before_its_begin() -> None:
    config = integrity_runs.Config(duration=25.0)
    log, _, began, share, ramp = integrity_runs.simulated(config, np.random.default_rng(3))
    right = integrity_runs.Config(duration=25.0, largest=0.0)
    clean = integrity_runs.simulated(right, np.random.default_rng(3))[0]
    assert log.fields is not None
    assert clean.fields is not None
    ratio = log.fields.phasor_sensor / clean.fields.phasor_sensor - 1.0
    before = log.fields.time < began
    assert np.max(np.abs(ratio[before])) < 1e-9
    late = log.fields.time > began + ramp + 0.3
    false = np.median(np.abs(ratio[late]), axis=(0, 2))
    assert np.sum(false > 0.5 * abs(share)) == 1  # both coils of a beacon share its tone
    assert np.max(false) == pytest.approx(abs(share), rel=1e-6)


def test_what_is_asked_is_counted() -> None:
    good = integrity_runs.OnlineOutcome(0.1, 0.0, 50, 0, 0, 1.0, 1.5, 50, 1e-3, 1e-3)
    bad = integrity_runs.OnlineOutcome(0.1, 0.0, 50, 1, 3, None, 1.5, 40, 0.1, 1e-3)
    result = integrity_runs.figures([good, bad], Risk())
    assert result.unseen_runs == 1
    assert result.false_alarms == 1
    assert result.finite == pytest.approx(0.9)
    assert result.detected == pytest.approx(0.5)
    assert "3 epochs unseen" in integrity_runs.report([good, bad])


@pytest.mark.slow
def test_the_promise_is_kept_in_some_runs() -> None:
    result = integrity_runs.figures(integrity_runs.run(integrity_runs.Config(runs=12, seed=5)))
    assert result.unseen_runs == 0
    assert result.false_alarms <= 2
    assert result.median_ratio <= 4.0
    assert result.finite >= 0.99
    assert result.detected > 0.5
