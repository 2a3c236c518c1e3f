"""A thousand logs of one site: what a round of `calibrate log` costs the driver, and that it ends.

Some logs are real: walks among the demo's beacons, whose survey is drawn from wide sigmas; each is
smoothed alone, then with the others as its prior.  The others are simulated in condensed form: each
has the information of one of the real logs, and a calibration drawn from it.  Sums, priors,
agreement and convergence are those of ``magfusion calibrate log``.

1. What does a round cost the driver: processor time, bytes to and from the workers, memory?
2. One worker is killed in each round (``--cluster``): does the run end with the same result?
3. Is the common calibration that which the logs were made with, within its own sigmas?

The workers of a ``--cluster`` need this directory on their PYTHONPATH::

    python scenarios/many_logs.py --logs 1000 --real 50 --cluster tcp://127.0.0.1:8786
"""

import os
import pickle
import resource
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from harness import chosen_scale, conclude, scenario_parser

from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.batch.joint import LogInformation, Shared, apart_in_sigmas
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.jobs.inputs import Job
from magfusion.jobs.joint_driver import Driver
from magfusion.jobs.joint_kept import load_information, save_information
from magfusion.jobs.joint_run import site_files, tasks_of
from magfusion.jobs.joint_tasks import (
    LogTask,
    RoundTask,
    alone,
    one_round,
    together_settings,
)
from magfusion.model.parameters import difference, initial_calibration
from magfusion.model.progress import quiet
from magfusion.model.site import BeaconSigma, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, perturb_site, simulate_fields, simulate_log
from magfusion.simulation.monte_carlo import WorkerPool, worker_pool
from magfusion.units import DEGREE, Array

NOISE = 3e-10  # T; of each part of a phasor
SETTINGS = together_settings(SmootherSettings(tune=False))


@dataclass(frozen=True)
class SimulatedLog(LogTask):
    """A log of which only the information is simulated."""


@dataclass(frozen=True)
class RealLog:
    """A log to be simulated."""

    site: Path
    true: Site
    path: Path


@dataclass(frozen=True, eq=False)
class Metered(WorkerPool):
    """Workers that lose one in each round, and what is sent to them.

    Parameters
    ----------
    kills : bool
    bytes_sent, bytes_received : list of int
        Of each call.
    """

    kills: bool = False
    bytes_sent: list[int] = field(default_factory=list)
    bytes_received: list[int] = field(default_factory=list)

    def run(self, task: Callable[..., Any], inputs: Sequence[Any], **options: Any) -> list[Any]:
        """Run a task on every input; rounds are those of real and simulated logs."""
        if task is one_round:
            task, last = any_round, len(inputs) - 1
            inputs = [(one, self.kills and i == last) for i, one in enumerate(inputs)]
        result = super().run(task, inputs, **options)
        self.bytes_sent.append(sum(len(pickle.dumps(one)) for one in inputs))
        self.bytes_received.append(sum(len(pickle.dumps(one)) for one in result))
        return result


def any_round(given: tuple[RoundTask, bool], rng: np.random.Generator) -> None:
    """Take a log through a round; the worker may be killed once."""
    task, dies = given[0].task, given[1]
    died = task.information(given[0].rounds).with_suffix(".died")
    if dies and not died.exists():
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if isinstance(task, SimulatedLog):  # a quadratic is the same wherever it is linearised
        known = load_information(task.information(given[0].rounds))
        save_information(task.information(given[0].rounds + 1), *known)
    else:
        one_round(given[0], rng)


def surveyed() -> Site:
    """Return the demo's site, roughly surveyed."""
    plain = replace(demo_site(coil_radius=None), model_error=1e-4)
    sigma = BeaconSigma(np.full(3, 0.02), np.full(3, 1.0 * DEGREE), np.full(2, 0.01))
    return replace(plain, beacons=tuple(replace(one, sigma=sigma) for one in plain.beacons))


def simulated(given: RealLog, rng: np.random.Generator) -> None:
    """Write a short walk, as phasors."""
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=6.0, perturb=False, magnetometer_rate_hz=100.0
    )
    built = simulate_log(given.true, config, rng)
    epochs = built.motion.trajectory(np.arange(0.3, 5.7, 0.2))
    fields = simulate_fields(built.true_site, epochs, NOISE, rng, built.drives, window=0.2)
    write_log(replace(built.log, waveform=None, fields=fields), given.path)


def drawn(
    real: LogInformation, shared: Shared, truth: Array, rng: np.random.Generator
) -> LogInformation:
    """Return the information of a log like another, of a calibration drawn from it."""
    value, vector = np.linalg.eigh(real.part.information)
    noise = vector @ (np.sqrt(np.maximum(value, 0.0)) * rng.standard_normal(len(value)))
    here = LogInformation(truth, replace(real.part, gradient=noise))
    return here.taken_at(shared, real.step)


def main() -> None:
    """Print what the rounds cost and what they gave; end with one JSON line."""
    parser = scenario_parser(__doc__, seed=0, output=None, parallel=True)
    parser.add_argument("--logs", type=int, default=100, help="of them all")
    parser.add_argument("--real", type=int, default=6, help="simulated as walks, and smoothed")
    options = parser.parse_args()
    scale = chosen_scale(options)
    rng = np.random.default_rng(options.seed)
    with (
        tempfile.TemporaryDirectory(dir=Path.cwd()) as scratch,
        worker_pool(options.logs, cluster=scale["cluster"], workers=scale["workers"]) as hands,
    ):
        place = Path(scratch)
        save_site(surveyed(), place / "site.yaml")
        true = perturb_site(surveyed(), rng)
        paths = [place / f"log{i}" for i in range(options.real)]
        jobs = [Job(path, place / "site.yaml", place / "out") for path in paths]
        hands.run(simulated, [RealLog(place / "site.yaml", true, p) for p in paths], seed=1)
        tasks: list[LogTask] = tasks_of(jobs, SETTINGS, place / "out")
        began = time.process_time()
        hands.run(alone, tasks)
        alone_s = time.process_time() - began
        files = site_files(tasks)
        shared = files.calendar().shared
        truth = difference(shared.declared, initial_calibration(true, 0.0), shared.blocks)
        for i in range(options.real, options.logs):
            like = tasks[rng.integers(options.real)]
            kept = like.kept.with_stem(f"simulated{i}")
            tasks.append(SimulatedLog(kept.stem, like.job, SETTINGS, kept, like.key))
            stored = load_information(like.information(0))
            simulated_log = drawn(stored.information, shared, truth, rng)
            save_information(tasks[-1].information(0), simulated_log, stored.blocks)
        metered = Metered(hands.executor, kills=scale["cluster"] is not None)
        driver = Driver(metered, tasks, files, quiet)
        began = time.process_time()
        sums = driver.first_sums()
        before = driver.agreement(sums)
        agreement_s = time.process_time() - began
        began = time.process_time()
        sums, moved = driver.repeated(sums)
        rounds_s = (time.process_time() - began) / sums.rounds
    known = sums.known
    off = apart_in_sigmas(known.step, truth, known.honest)
    figures = {
        "logs": options.logs,
        "real": options.real,
        "rounds": sums.rounds,
        "moved_sigma": moved,
        "off_sigma": off,
        "contradicting": sum(bool(findings) for findings in before.of_log),
        "driver_alone_s": alone_s,
        "driver_agreement_s": agreement_s,
        "driver_round_s": rounds_s,
        "sent_a_log_and_round_bytes": sum(metered.bytes_sent) / options.logs / sums.rounds,
        "received_a_log_and_round_bytes": sum(metered.bytes_received) / options.logs / sums.rounds,
        "largest_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }
    conclude("\n".join(f"{name:<32}{value:12.4g}" for name, value in figures.items()), figures)


if __name__ == "__main__":
    main()
