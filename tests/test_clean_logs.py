"""The scenario of clean logs: what is drawn, how it is counted, and that some are believed."""

from dataclasses import replace

import clean_logs
import numpy as np
import pytest

from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log


def test_every_kind_of_log_is_drawn() -> None:
    drawn = [clean_logs.draw(clean_logs.Config(), np.random.default_rng(i)) for i in range(120)]
    lower, upper = clean_logs.MIN_BEACONS, clean_logs.MAX_BEACONS
    assert {len(one.site.beacons) for one in drawn} == set(range(lower, upper + 1))
    assert {one.config.motion for one in drawn} == {"walk", "turn"}
    assert any(one.config.box_world[1, 0] == 0.75 * 80.0 for one in drawn)
    assert all(one.config.random_field == one.site.model_error for one in drawn)
    for one in drawn:
        places = np.array([b.position_world for b in one.site.beacons])
        separate = np.linalg.norm(places[:, None] - places, axis=2) + 10.0 * np.eye(len(places))
        assert np.min(separate) > 0.3  # m; none lies in another
        assert np.all(one.config.box_world[1] > one.config.box_world[0])


def test_what_is_asked_is_counted() -> None:
    row = clean_logs.Row(
        4, 0.01, "walk", 0.5, 1.0, 0.005, 5.0, 0.01, 0, "trustworthy", (), "", 0.001, 0.1, 6.0
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
    assert result.nees_median == 6.0
    assert "why" in clean_logs.table(rows)


def test_the_fastest_turns_reach_800_degrees_a_second() -> None:
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=30.0,
        motion="turn",
        turn_rate=clean_logs.TURN_RATE[1],
        imu_rate_hz=100.0,
        magnetometer_rate_hz=300.0,
    )
    motion = simulate_log(demo_site(), config, np.random.default_rng(0)).motion
    rate = np.rad2deg(np.linalg.norm(motion.rate_body(np.arange(0.0, 30.0, 0.005)), axis=1))
    assert 700.0 < np.max(rate) < 1200.0
    assert np.sqrt(np.mean(rate[rate > 1.0] ** 2)) > 150.0


@pytest.mark.slow
def test_some_clean_logs_are_believed() -> None:
    rows = clean_logs.run(clean_logs.Config(logs=6, seed=3))
    result = clean_logs.figures(rows)
    assert result.silent == 0
    assert result.failed == 0
    assert result.doubtful <= 1
