"""Three logs of one site: honest together, better than each alone, and the same on a cluster."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from test_joint import NOISE, RESTLESS, refined, step_to, surveyed

from magfusion.estimation.batch.joint import apart_in_sigmas
from magfusion.estimation.batch.joint_log import joint_posterior
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.model.parameters import initial_calibration, prior_sigma
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.results.errors import trajectory_errors
from magfusion.results.observability import gauge_basis
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.log import (
    SimulationConfig,
    perturb_site,
    simulate_fields,
    simulate_log,
)

WORLDS, LOGS = 5, 3


def part_of_room(true: Site, world: int, which: int, duration: float = 6.0) -> Log:
    """Return a log of phasors that sees a third of the room only."""
    rng = np.random.default_rng([world, which])
    low, high = DEMO_BOX_WORLD
    width = (high[0] - low[0]) / LOGS
    box = np.array([low, high])
    box[:, 0] = low[0] + width * np.array([which, which + 1])
    config = SimulationConfig(
        box, duration=duration, perturb=False, rests=RESTLESS, magnetometer_rate_hz=100.0
    )
    built = simulate_log(true, config, rng)
    time = np.arange(0.3, duration - 0.3, 0.2)
    fields = simulate_fields(
        built.true_site, built.motion.trajectory(time), NOISE, rng, built.drives, window=0.2
    )
    return replace(built.log, name=f"log{which}", waveform=None, fields=fields)


@pytest.mark.slow
def test_three_logs_are_honest_together_and_better_than_each_alone() -> None:
    nees, of_site, errors = [], [], []
    for world in range(WORLDS):
        site = surveyed()
        true = perturb_site(site, np.random.default_rng([world, 9]))
        logs = [part_of_room(true, world, which) for which in range(LOGS)]
        estimate = refined(site, true, logs, rounds=5)
        truth = step_to(estimate.shared, initial_calibration(true, 0.0))
        of_site.append(apart_in_sigmas(estimate.known.step, truth, estimate.known.honest) ** 2)
        # What no log can know, the common place and heading, is the same in all.
        gauge = gauge_basis(initial_calibration(true, 0.0), estimate.shared.blocks)
        remaining = np.eye(len(truth)) - gauge @ gauge.T
        steps = [estimate.known.step]
        steps += [step_to(estimate.shared, result.calibration) for result in estimate.alone]
        unit = prior_sigma(estimate.shared.blocks)
        errors.append([np.sqrt(np.mean((remaining @ ((s - truth) / unit)) ** 2)) for s in steps])
        for log, own, done, alone in zip(
            logs, estimate.kept, estimate.rounds, estimate.alone, strict=True
        ):
            joint = joint_posterior(own, done, alone.blocks)
            assert log.truth is not None
            of_log = trajectory_errors(joint.states, log.truth).nees
            assert of_log is not None
            nees.append(np.mean(of_log))
    print(np.mean(nees), np.mean(of_site), np.mean(errors, axis=0))
    assert 4.0 < np.mean(nees) < 8.0  # of six
    assert 0.5 < np.mean(of_site) < 1.5  # of one, a degree of freedom
    together, *alone = np.sqrt(np.mean(np.square(errors), axis=0))
    assert together < 0.9 * min(alone)


@pytest.mark.slow
def test_a_cluster_of_two_workers_gives_the_same_figures(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    true = perturb_site(surveyed(), np.random.default_rng([1, 9]))
    save_site(surveyed(), tmp_path / "site.yaml")
    for which in range(LOGS):
        write_log(part_of_room(true, 1, which, 2.4), tmp_path / f"log{which}")
    logs = [tmp_path / f"log{which}" for which in range(LOGS)]
    command = ("smooth", *logs, "--site", tmp_path / "site.yaml", "--no-tune", "-o")
    run_command(*command, tmp_path / "here", "--workers", 1)
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    ) as cluster:
        run_command(*command, tmp_path / "there", "--cluster", cluster.scheduler_address)
    here, there = (
        json.loads((tmp_path / place / "report.json").read_text()) for place in ("here", "there")
    )
    assert here["logs_used"] == LOGS
    for key, value in here.items():
        if key.endswith("_sigma"):
            assert there[key] == pytest.approx(value, rel=1e-6), key
    for key in ("verdict", "reasons", "determined", "directions_determined"):
        assert there[key] == here[key]
    for mine, other in zip(here["logs"], there["logs"], strict=True):
        for key in ("epochs", "verdict", "reason"):
            assert mine[key] == other[key]
        assert other["ate_m"] == pytest.approx(mine["ate_m"], rel=1e-6)
        assert (tmp_path / "there" / "logs" / mine["log"] / "trajectory.parquet").is_file()
