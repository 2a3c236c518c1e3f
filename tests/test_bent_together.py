"""A rejected beacon is the explanation only where it leaves the others in agreement."""

from dataclasses import replace

import numpy as np
import pytest
from small_problem import small_log

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.integrity.residual_blocks import fields
from magfusion.estimation.integrity.test_result import Case
from magfusion.model.trust import Verdict

WEIGHT = 0.05  # of a rejected channel
FALSE, BENT = 12.0, 2.2  # sigmas


@pytest.mark.parametrize("others_bent", [False, True])
def test_a_rejected_beacon_counts_only_where_the_others_are_bent_as_well(
    *, others_bent: bool
) -> None:
    """As by a cart of steel that passes, which bends every field and one of them most."""
    small = small_log(1, epochs=80, sigma=2e-9, perturb=False)
    log = small.log
    result = smooth(log, replace(small.site, model_error=1e-3))
    pose_cov, time = result.states.pose_cov, result.fields.time
    assert pose_cov is not None
    rng = np.random.default_rng(1)
    raw = 0.5 * rng.standard_normal(result.residual.shape)
    passes = (time > 14.0) & (time < 22.0)
    if others_bent:
        raw[passes, 1:] = BENT * rng.standard_normal((1, *raw.shape[1:]))[:, 1:]
    raw[passes, 0] = FALSE
    weighed = raw.copy()
    weighed[passes, 0] *= np.sqrt(WEIGHT)
    tested = fields(Case(result, log, None, pose_cov), raw, weighed)
    assert tested.factor is not None
    inside, far = (tested.factor[result.epoch[rows]] for rows in (passes, time < 10.0))
    own = np.mean(raw[passes] ** 2)
    assert np.max(far) < 0.1 * own
    if others_bent:
        assert np.median(inside) > 0.5 * own
        assert any(finding.verdict is Verdict.DOUBTFUL for finding in tested.findings)
    else:
        assert np.median(inside) < 0.2 * own
