"""The scenario of drift by seeds: how it counts, and that it finds the trap."""

import drift_seeds
import pytest

from magfusion.results.drift import QUANTITIES


def test_verdicts_are_counted_by_quantity() -> None:
    good = {q.name: "pass" for q in QUANTITIES}
    rows = [
        drift_seeds.Row(0, False, "pass", good, ()),
        drift_seeds.Row(1, False, "fail", good | {"position": "fail"}, ("FAIL: it drifts.",)),
        drift_seeds.Row(0, True, "fail", good, ()),
    ]
    text = drift_seeds.report(rows, drift_seeds.Config())
    assert "free: 2 seeds, fail 1, pass 1" in text
    assert "trap: 1 seeds, fail 1" in text
    assert "seed 1: FAIL: it drifts." in text


@pytest.mark.slow
def test_the_trap_fails_and_a_good_seed_does_not() -> None:
    config = drift_seeds.Config(seeds=2, hours=4.0, trap_seeds=1, seed=3)
    rows = drift_seeds.run(config)
    assert [row.stability for row in rows if row.trap] == ["unstable"]
    assert "unstable" not in [row.stability for row in rows if not row.trap]
