"""The scenarios of the online estimators: what they print is what they claim."""

import json
import sys

import estimators_compared
import online_warehouse
import pytest

Monkey = pytest.MonkeyPatch
Capture = pytest.CaptureFixture[str]


@pytest.mark.slow
def test_a_vehicle_comes_through_everything_that_goes_wrong(
    monkeypatch: Monkey, capsys: Capture
) -> None:
    monkeypatch.setattr(sys, "argv", ["online_warehouse.py"])
    online_warehouse.main()
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    for estimator in online_warehouse.ESTIMATORS:
        usual = figures[f"{estimator}, undisturbed"]
        assert usual < 0.3  # cm
        assert figures[f"{estimator}, epochs to recover"] <= 10
        assert figures[f"{estimator}, at the end"] < 1.5 * usual
        assert figures[f"{estimator}, outliers, beacon 2 silent"] < 2.0 * usual
        assert figures[f"{estimator}, counts"]["outlier of W0"] > 20


@pytest.mark.slow
def test_what_not_knowing_the_future_costs() -> None:
    config = estimators_compared.Config(duration=60.0, instants=6)
    rows = {row.estimator: row for row in estimators_compared.run(config)}
    batch = rows["batch, tight"].position_cm
    assert rows["fixed lag, lagged"].position_cm < 1.5 * batch
    assert rows["fixed lag"].position_cm < 2.0 * batch
    assert rows["filter"].position_cm < 2.5 * batch
    assert rows["batch, tight"].aligned_position_cm < rows["fixes"].aligned_position_cm
    for name in ("fixed lag", "filter"):
        nees = rows[name].nees
        assert nees is not None
        assert nees < 12.0  # of 6; one log
