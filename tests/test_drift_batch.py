"""A batch in the worlds of `magfusion drift` is as honest as the estimators online."""

import drift_batch
import pytest


@pytest.mark.slow
def test_a_batch_claims_what_it_errs() -> None:
    config = drift_batch.Config(hours=0.4)
    row = drift_batch.run_world(config, 0)
    assert row.converged
    # Of one world; epochs share what drifts, so that few of them are independent.
    assert 2.0 < row.nees < 10.0
    assert row.position_m < 0.01
    assert "mean" in drift_batch.report(config, [row])
