"""Each further beacon lowers the error as paper 004 prints, and as its geometry says."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import beacon_count
import numpy as np
import pytest
from algorithms_tried import MAPPED, AlgorithmOutcome
from beacon_count import Config, bounds, errors, run

from magfusion.units import Array

A3 = "A3 differential"


def shares(error: Array) -> Array:
    return np.asarray(error[1:] / error[0])


@pytest.fixture(scope="module")
def many() -> Mapping[int, Sequence[AlgorithmOutcome]]:
    """Enough rooms to tell a step of ten per cent, without the map."""
    return run(Config(worlds=60, targets=100), {"workers": 1}, (A3,))


@pytest.mark.slow
def test_more_beacons_help_algorithm_3(many: Mapping[int, Sequence[AlgorithmOutcome]]) -> None:
    error = errors(many, A3).mean(axis=1)
    assert np.all(shares(error) < 0.9)
    assert shares(error)[-1] <= 0.75
    assert error[0] == pytest.approx(0.060, rel=0.15)  # m


@pytest.mark.slow
def test_more_beacons_lower_the_large_errors_as_well(
    many: Mapping[int, Sequence[AlgorithmOutcome]],
) -> None:
    every = [np.concatenate([room.position[A3] for room in rooms]) for rooms in many.values()]
    large = np.array([np.quantile(error, 0.95) for error in every])
    assert np.all(shares(large) < 0.9)
    assert shares(large)[-1] < 0.75


def test_the_bound_falls_as_expected(
    many: Mapping[int, Sequence[AlgorithmOutcome]],
) -> None:
    np.testing.assert_allclose(shares(bounds(many)), [0.82, 0.73, 0.66], atol=0.01)


@pytest.fixture(scope="module")
def full() -> Mapping[int, Sequence[AlgorithmOutcome]]:
    """Return two rooms: a map takes five seconds to learn."""
    return run(Config(worlds=2))


@pytest.mark.slow
def test_a_map_is_worth_more_than_three_beacons(
    full: Mapping[int, Sequence[AlgorithmOutcome]],
) -> None:
    mapped, published = errors(full, MAPPED).mean(axis=1), errors(full, A3).mean(axis=1)
    np.testing.assert_allclose(mapped, [0.0082, 0.0071, 0.0063, 0.0057], rtol=0.25)
    assert np.all(np.diff(mapped) < 0.0)
    assert mapped[0] < 0.5 * published[-1]
    assert mapped[0] == pytest.approx(published[0] / 8.0, rel=0.3)


@pytest.mark.slow
def test_the_scenario_draws_prints_and_ends_with_one_json_line(
    full: Mapping[int, Sequence[AlgorithmOutcome]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(beacon_count, "run", lambda *_: full)
    monkeypatch.setattr(sys, "argv", ["beacon_count.py", "-o", str(tmp_path)])
    beacon_count.main()
    lines = capsys.readouterr().out.splitlines()
    printed = json.loads(lines[-1])["position_m"]
    np.testing.assert_allclose(printed[A3], errors(full, A3).mean(axis=1), rtol=1e-12)
    assert any(line.split()[:2] == ["paper", "0.1100"] for line in lines[:-1])
    assert (tmp_path / "figure_11.png").stat().st_size > 10_000
