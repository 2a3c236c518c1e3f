"""Sums of information over files: a pool without a contradicting log leaves those of all logs."""

from pathlib import Path

import numpy as np
from test_joint import SETTINGS, surveyed

from magfusion.estimation.batch.calendar import LogBlocks, names_of
from magfusion.estimation.batch.joint import LogInformation
from magfusion.estimation.posterior.marginalized_log import MarginalizedLog
from magfusion.files.site import save_site
from magfusion.jobs.inputs import Job
from magfusion.jobs.joint_driver import Driver
from magfusion.jobs.joint_kept import save_information
from magfusion.jobs.joint_tasks import LogTask, SiteFiles, considered_of
from magfusion.model.parameters import BEACON_POSITION, dimension, prior_sigma
from magfusion.simulation.monte_carlo import WorkerPool
from magfusion.units import Array

LOGS, MOVED = 5, 2  # of which one saw a beacon elsewhere
SHIFT = 20.0  # declared sigmas


def driven(place: Path, rng: np.random.Generator) -> tuple[Driver, list[Array]]:
    """Return a driver of drawn logs, and the information of each on the shared parameters."""
    site, path = surveyed(), place / "site.yaml"
    save_site(site, path)
    jobs = [Job(place / f"log{i}", path, place / "out") for i in range(LOGS)]
    tasks = [
        LogTask(f"log{i}", job, SETTINGS, place / "kept" / f"log{i}.npz", "")
        for i, job in enumerate(jobs)
    ]
    files = SiteFiles((jobs[0],), SETTINGS)
    shared, considered = files.calendar().shared, considered_of(site, SETTINGS)
    blocks = LogBlocks(0.0, 0, names_of(shared.blocks), names_of(considered))
    size, unit = dimension(shared.blocks), prior_sigma(shared.blocks)
    nothing, known = np.zeros((size, size)), []
    for i, task in enumerate(tasks):
        root = rng.normal(size=(size, 2 * size)) / unit[:, None]
        information = root @ root.T
        truth = np.zeros(size)
        if i == MOVED:
            moved = next(b for b in shared.blocks if b.parameter == BEACON_POSITION)
            truth[moved.columns] = SHIFT * moved.sigma
        gradient = information @ truth + root @ rng.normal(size=2 * size)
        by_common = np.zeros((size, dimension(considered)))
        part = MarginalizedLog(information, gradient, by_common, nothing, nothing)
        save_information(task.information(0), LogInformation(np.zeros(size), part), blocks)
        known.append(information)
    return Driver(WorkerPool(None), tasks, files, lambda *_: None), known


def test_each_log_has_all_others_as_prior_after_one_was_excluded_from_a_test(
    tmp_path: Path,
) -> None:
    driver, known = driven(tmp_path, np.random.default_rng(4))
    sums = driver.first_sums()
    agreed = driver.agreement(sums)
    assert [bool(findings) for findings in agreed.of_log] == [i == MOVED for i in range(LOGS)]
    shared = driver.calendar.shared
    unit = prior_sigma(shared.blocks)
    for i, task in enumerate(driver.last_tasks(sums)):
        others = sum(part for k, part in enumerate(known) if k != i)
        expected = np.linalg.inv(unit[:, None] * (shared.information + others) * unit)
        np.testing.assert_allclose(
            task.prior().cov / unit[:, None] / unit, expected, rtol=0, atol=1e-9 * np.max(expected)
        )
