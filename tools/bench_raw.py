"""Time the way from raw samples to states in bare loops, compared with its goal.

`magfusion smooth` and `navigate`, by both estimators, are run on a log of raw samples as a user
runs them, and their processor time is taken.  The rest without start-up, the processor
time of the same command with ``--end 10``, is divided by that of a bare loop over GTSAM's
``integrateMeasurement`` on as many of the log's inertial samples, timed before and after each
command: other work on the machine slows down both.  Start-up is divided by the time of importing
gtsam, scipy, pyarrow and rerun.  The last row is ``magfusion --help``; ``--long`` adds half an hour
at 500 Hz from a bag, by ``bench_long.py``.  ``--profile`` writes a profile of the first command,
``--flame`` its flame graph, sampled by py-spy, which is installed apart: `pip install py-spy`.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import gtsam
import numpy as np
from bench_long import GOAL_MINUTES, measure, used

from magfusion.estimation.graph.preintegration import preintegration_parameters
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site

BEGINNING = 10.0  # s; what is taken for start-up
IMPORTS = "import gtsam, scipy, pyarrow, rerun"
STARTUP_GOAL = 2.5
HELP_GOAL = 0.2  # s
SPREAD_GOAL = 3.0  # p99 over p50
PROGRAM = (sys.executable, "-m", "magfusion")


class Goal(NamedTuple):
    """A command with what it should take: bare loops, and milliseconds an update."""

    name: str
    command: tuple[str, ...]
    loops: float
    update_ms: float | None


GOALS = (
    Goal("smooth", ("smooth",), 35.0, None),
    Goal("ekf", ("navigate", "--estimator", "ekf"), 40.0, 8.0),
    Goal("fixed lag", ("navigate",), 80.0, 12.0),
)


def bare_loop(site: Site, imu: ImuSamples) -> float:
    """Return the processor time of preintegration alone, a fifth of a second at a time (s)."""
    parameters = preintegration_parameters(site.platform.imu, site.gravity, bridge=False)
    step = float(np.median(np.diff(imu.time)))
    every, bias = max(int(0.2 / step), 1), gtsam.imuBias.ConstantBias()
    began = time.process_time()
    for start in range(0, len(imu), every):
        measurement = gtsam.PreintegratedCombinedMeasurementsG(parameters, bias)
        integrate, rows = measurement.integrateMeasurement, slice(start, start + every)
        for accel, gyro in zip(imu.accel_body[rows], imu.gyro_body[rows], strict=True):
            integrate(accel, gyro, step)
    return time.process_time() - began


def measured(goal: Goal, log: Path, site: Site, imu: ImuSamples, room: Path) -> dict[str, Any]:
    """Run a command on a log and on its beginning; return its figures."""
    later = imu.time > imu.time[0] + BEGINNING
    remaining = ImuSamples(imu.time[later], imu.gyro_body[later], imu.accel_body[later])
    loops = [bare_loop(site, remaining)]
    output = room / goal.name.replace(" ", "_")
    beginning = (*PROGRAM, *goal.command, str(log), "--end", str(BEGINNING))
    used((*beginning, "-o", f"{output}_first"))  # keeps byte code, as an installation has
    seconds = used((*PROGRAM, *goal.command, str(log), "-o", str(output))).seconds
    loops.append(bare_loop(site, remaining))
    startup = used((*beginning, "-o", f"{output}_beginning")).seconds
    imports = used((sys.executable, "-c", IMPORTS)).seconds
    loops.append(bare_loop(site, remaining))
    report = json.loads((output / "report.json").read_text())
    result = {
        "seconds": seconds,
        "startup": startup,
        "imports": imports,
        "bare": float(np.mean(loops)),
        "loops": (seconds - startup) / float(np.mean(loops)),
        "startup_of_imports": startup / imports,
    }
    return result | {k: v for k, v in report.items() if k.startswith("update_")}


def reported(goal: Goal, result: dict[str, Any]) -> str:
    """Return a line of the table."""
    line = (
        f"{goal.name:<10}{result['seconds']:8.1f} s{result['startup']:7.1f} s"
        f"{result['bare']:7.2f} s"
        f"{result['loops']:8.0f}{goal.loops:6.0f}"
        f"{result['startup_of_imports']:9.1f}{STARTUP_GOAL:5.1f}"
    )
    if goal.update_ms is None:
        return line
    p50, p99 = result["update_p50_ms"], result["update_p99_ms"]
    return f"{line}{p50:9.1f}{goal.update_ms:6.0f}{p99 / p50:7.1f}{SPREAD_GOAL:5.1f}"


def profile(goal: Goal, log: Path, path: Path, room: Path) -> None:
    """Write the profile of a command, for snakeviz or pstats."""
    profiled = (sys.executable, "-m", "cProfile", "-o", str(path), "-m", "magfusion")
    used((*profiled, *goal.command, str(log), "-o", str(room / "profiled")))
    print(f"profile of {goal.name}: {path}")


def flame(goal: Goal, log: Path, path: Path, room: Path) -> None:
    """Write the flame graph of a command, with its calls of compiled code, as SVG."""
    sampled = ("py-spy", "record", "--native", "--rate", "200", "-o", str(path), "--")
    used((*sampled, *PROGRAM, *goal.command, str(log), "-o", str(room / "sampled")))
    print(f"flame graph of {goal.name}: {path}")


def main() -> None:
    """Print the table and one JSON line; exit with 1 where a goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--log", type=Path, help="of raw samples; one is simulated by default")
    parser.add_argument("--duration", type=float, default=180.0, help="of the simulated log, s")
    names = [goal.name for goal in GOALS]
    parser.add_argument("--only", choices=names, action="append", help="of the commands")
    parser.add_argument("--profile", type=Path, help="file of the profile of the first command")
    parser.add_argument("--flame", type=Path, help="file (SVG) of its flame graph")
    parser.add_argument("--long", action="store_true", help="half an hour at 500 Hz, too")
    options = parser.parse_args()
    if options.flame is not None and shutil.which("py-spy") is None:
        parser.error("--flame needs py-spy, which is not installed: pip install py-spy")
    chosen = [goal for goal in GOALS if options.only is None or goal.name in options.only]
    missed, figures = False, {}
    with tempfile.TemporaryDirectory() as directory:
        room, log = Path(directory), options.log
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        if log is None:
            log = room / "log"
            used((*PROGRAM, "simulate", "--duration", str(options.duration), "-o", str(log)))
        imu, site = open_log(log).imu, load_site(log / "site.yaml")
        print(
            "command     processor  start  a loop   loops  goal  of imports   p50/ms  goal  p99/p50"
        )
        for goal in chosen:
            figures[goal.name] = result = measured(goal, log, site, imu, room)
            print(reported(goal, result), flush=True)
            missed |= result["loops"] > goal.loops or result["startup_of_imports"] > STARTUP_GOAL
            if goal.update_ms is not None:
                missed |= result["update_p50_ms"] > goal.update_ms
                missed |= result["update_p99_ms"] > SPREAD_GOAL * result["update_p50_ms"]
        shown = used((*PROGRAM, "--help")).seconds
        figures["help"] = {"seconds": shown}
        print(f"{'--help':<10}{shown:8.1f} s   goal: {HELP_GOAL} s")
        if options.profile is not None:
            profile(chosen[0], log, options.profile, room)
        if options.flame is not None:
            flame(chosen[0], log, options.flame, room)
        if options.long:
            long, over = measure(room, [GOAL_MINUTES], ["smooth"])
            figures["long"], missed = {"found": long}, missed or over
    print(json.dumps(figures))
    raise SystemExit(1 if missed else 0)


if __name__ == "__main__":
    main()
