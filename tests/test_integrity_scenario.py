"""The integrity scenario: its closed form is the fix's, and the promise is kept."""

import sys

import integrity
import numpy as np
import pytest

from magfusion.model.trust import Risk

PROMISE = Risk()


def test_the_closed_form_tells_of_an_epoch_what_the_fix_does() -> None:
    config = integrity.Config(epochs=300, largest=0.03)
    epochs = integrity.draw(config, config.epochs, np.random.default_rng(1))
    closed, full = integrity.solve(config, epochs), integrity.fix(config, epochs)
    assert np.mean(closed.alarm == full.alarm) > 0.98
    quiet = ~closed.alarm & ~full.alarm
    np.testing.assert_allclose(closed.error_m[quiet], full.error_m[quiet], rtol=0.05, atol=5e-5)
    np.testing.assert_allclose(closed.ratio[quiet], full.ratio[quiet], rtol=0.05)
    assert not np.any(full.beyond & ~full.alarm)
    # Of what was found to be false the fix is rid.
    assert np.median(full.error_m[full.alarm]) < 0.5 * np.median(closed.error_m[full.alarm])


def test_the_promise_is_kept_in_a_few_epochs() -> None:
    config = integrity.Config(epochs=6_000, largest=0.03)
    result = integrity.figures(integrity.run(config, {"workers": 1}), config)
    assert result.hazard_limit <= PROMISE.total
    assert result.false_alarm_rate <= 2.0 * PROMISE.false_alarm
    assert result.median_ratio <= 4.0
    assert result.finite >= 0.99
    assert 0.3 < result.detected < 1.0  # so small a fault is often not seen, nor does it matter


@pytest.mark.slow
@pytest.mark.parametrize("largest", [0.02, 0.2])
def test_the_promise_is_kept(largest: float) -> None:
    config = integrity.Config(epochs=100_000, largest=largest)
    result = integrity.figures(integrity.run(config), config)
    assert result.hazard_limit <= PROMISE.total
    assert result.false_alarm_limit <= 1e-3
    assert result.median_ratio <= 4.0
    assert result.finite >= 0.99


def test_the_scenario_prints_a_table_and_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["integrity.py", "--quick", "--full", "--workers", "1"])
    monkeypatch.setattr(integrity, "BLOCK", 100)
    monkeypatch.setattr(integrity, "run", lambda config, _scale: _few(config))
    integrity.main()
    out = capsys.readouterr().out
    assert "beyond the level, unseen" in out
    assert '"hazard_limit"' in out


def _few(config: integrity.Config) -> integrity.CaseOutcome:
    return integrity.try_block(config, np.random.default_rng(2))
