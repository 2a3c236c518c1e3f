"""The scenario of clean logs: what is drawn, how it is counted, and that some are believed."""

from dataclasses import replace

import clean_logs
import numpy as np
import pytest


def test_every_kind_of_log_is_drawn() -> None:
    drawn = [clean_logs.draw(clean_logs.Config(), np.random.default_rng(i)) for i in range(60)]
    assert {len(one.site.beacons) for one in drawn} == set(range(1, clean_logs.MOST_BEACONS + 1))
    assert {one.rough for one in drawn} == {True, False}
    assert {one.config.motion for one in drawn} == {"walk", "turn"}
    for one in drawn:
        places = np.array([b.position_world for b in one.site.beacons])
        separate = np.linalg.norm(places[:, None] - places, axis=2) + 10.0 * np.eye(len(places))
        assert np.min(separate) > 0.3  # m; none lies in another
        assert np.all(one.config.box_world[1] > one.config.box_world[0])


def test_what_is_asked_is_counted() -> None:
    row = clean_logs.Row(
        4, False, "walk", 0.5, 5.0, 0.01, 0, "trustworthy", (), "", 0.001, 0.1, 6.0
    )
    rows = [
        row,
        replace(row, verdict="doubtful", text="why"),
        replace(row, nees=50.0),
        replace(row, bound_m=np.inf, beacons=1),
    ]
    result = clean_logs.figures(rows)
    assert (result.logs, result.determined, result.doubtful, result.failed) == (4, 3, 1, 0)
    assert result.silent == 1
    assert result.trusted_elsewhere == 1
    assert "why" in clean_logs.table(rows)


@pytest.mark.slow
def test_some_clean_logs_are_believed() -> None:
    rows = clean_logs.run(clean_logs.Config(logs=6, seed=3))
    result = clean_logs.figures(rows)
    assert result.silent == 0
    assert result.failed == 0
    assert result.doubtful <= 1
