"""The score by one sweep along the chain is that of GTSAM's elimination."""

from dataclasses import replace

import numpy as np
import pytest
from small_problem import small_log

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.graph.state import states_in
from magfusion.estimation.integrity import change_detection, fixed_parameter_columns, score
from magfusion.estimation.integrity.fault_candidates import fixed_blocks
from magfusion.estimation.integrity.score import Score, answered, scores_of
from magfusion.estimation.measurements import phasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior import block_tridiagonal_system, schur_complement
from magfusion.model.parameters import placed
from magfusion.model.samples import ImuSamples


def _requested(result: Smoothed, imu: ImuSamples) -> tuple[Score, Score]:
    """Return the score of what is held, and with what may change in the middle."""
    middle = float(np.mean(result.fields.time))
    estimate = scores_of(result, imu, change_detection._blocks(result.declared.site, middle))
    assert estimate is not None
    return estimate.fixed, answered(result, estimate.every, imu)


@pytest.mark.parametrize("estimated", [True, False])
def test_a_sweep_gives_the_score_of_the_tree(
    monkeypatch: pytest.MonkeyPatch, *, estimated: bool
) -> None:
    small = small_log(3)
    settings = SmootherSettings(tune=False)
    if not estimated:
        settings = SmootherSettings(tune=False, estimate=())
    result = smooth(small.log, replace(small.site, model_error=1e-3), settings)
    assert bool(result.blocks) == estimated
    assert result.field_errors
    monkeypatch.setattr(score, "left_of_chain", lambda *_: None)
    trees = _requested(result, small.log.imu)
    monkeypatch.undo()
    monkeypatch.setattr(schur_complement, "STRETCH", 7)
    monkeypatch.setattr(fixed_parameter_columns, "STRETCH", 5)
    monkeypatch.setattr(block_tridiagonal_system, "SIDES", 1.0)  # one block at once
    for chain, tree in zip(_requested(result, small.log.imu), trees, strict=True):
        assert np.any(chain.information != tree.information)  # found otherwise
        unit = np.sqrt(np.diagonal(tree.information))
        scale = np.where(unit > 0.0, unit, 1.0)
        np.testing.assert_allclose(
            chain.information / scale / scale[:, None],
            tree.information / scale / scale[:, None],
            atol=1e-7,
        )
        np.testing.assert_allclose(chain.gradient / scale, tree.gradient / scale, atol=1e-7)
        largest = np.max(np.abs(tree.by_pose), axis=(0, 1))
        separate = np.max(np.abs(chain.by_pose - tree.by_pose), axis=(0, 1))
        assert np.all(separate <= 1e-7 * largest)
        np.testing.assert_allclose(chain.by_calibration, tree.by_calibration, atol=1e-7)
        np.testing.assert_array_equal(chain.spread, tree.spread)


def test_of_many_columns_each_channel_whitens_those_that_it_feels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    small = small_log(3)
    settings = SmootherSettings(tune=False)
    result = smooth(small.log, replace(small.site, model_error=1e-3), settings)
    blocks = placed((*fixed_blocks(result.declared.site, (), static=False), *result.field_errors))
    fields = next(m for m in result.graph.measurements if isinstance(m, FieldPhasors))
    at = states_in(result.estimate.values).rows(fields.epoch), result.calibration, blocks
    few = fields.linearize(*at).by_calibration
    monkeypatch.setattr(phasors, "MIN_SPARSE_COLUMNS", 10**6)
    every = fields.linearize(*at).by_calibration
    assert few is not None
    assert every is not None
    assert few.shape[-1] >= 64
    np.testing.assert_allclose(few, every, rtol=1e-12, atol=1e-12 * np.max(np.abs(every)))
