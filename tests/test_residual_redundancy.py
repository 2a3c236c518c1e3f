"""What is left of drawn errors: by one sweep along the chain as by GTSAM's elimination."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_problem import small_log
from test_tracker_fusion import _recorded as recorded_tracker

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.posterior import residual_redundancy
from magfusion.estimation.posterior.residual_redundancy import ResidualProjection
from magfusion.files.log import read_log
from magfusion.files.site import load_site
from magfusion.model.trajectory import Trajectory


def _compare(result: Smoothed, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = {k: v[result.epoch] for k, v in vars(result.states).items() if v is not None}
    poses = Trajectory(**rows)
    given = result.graph, result.estimate, result.fields, poses, 2.0, result.considered
    chain = ResidualProjection(*given)
    monkeypatch.setattr(residual_redundancy, "is_chain", lambda *_: False)
    tree = ResidualProjection(*given)
    np.testing.assert_array_equal(chain.sigma, tree.sigma)
    for own, other in zip(chain.inertial(), tree.inertial(), strict=True):
        scale = np.max(np.abs(other), axis=0)
        assert np.any(own != other)  # found otherwise
        assert np.all(np.abs(own - other) < 1e-6 * np.maximum(scale, 1e-30))
    for beacon in range(len(result.declared.site.beacons)):
        pairs = zip(chain.channels_of(beacon), tree.channels_of(beacon), strict=True)
        for one, two in pairs:
            np.testing.assert_allclose(one.seen, two.seen, atol=1e-6)
            for own, other in zip(one.residuals, two.residuals, strict=True):
                np.testing.assert_allclose(own, other, atol=1e-6)


@pytest.mark.parametrize("loss", ["cauchy", None])
@pytest.mark.parametrize("estimated", [True, False])
def test_a_sweep_leaves_what_the_tree_leaves(
    monkeypatch: pytest.MonkeyPatch, *, estimated: bool, loss: str | None
) -> None:
    small = small_log(3)
    settings = SmootherSettings(tune=False, loss=loss)
    if not estimated:
        settings = replace(settings, estimate=())
    result = smooth(small.log, replace(small.site, model_error=1e-3), settings)
    assert bool(result.blocks) == estimated
    assert result.considered
    _compare(result, monkeypatch)


@pytest.mark.slow
def test_so_it_does_of_direct_current_whose_quadratures_nothing_explains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = recorded_tracker(tmp_path / "log", 0.0)
    site = load_site(log / "site.yaml")
    _compare(smooth(read_log(log), site, SmootherSettings(tune=False)), monkeypatch)
