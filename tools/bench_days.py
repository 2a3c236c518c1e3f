"""Two days of raw samples through the online filter: memory and pace, hour by hour.

Walks among the demo's beacons and rests between them, both instruments at one rate, a field epoch a
second; samples are simulated a minute at a time and discarded, so that what grows is the
navigator's. A checkpoint is written every hour, and the run goes on from it with ``--resume``.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from magfusion.estimation.online.navigator import NavigatorSettings
from magfusion.files.checkpoint import run_key
from magfusion.jobs.checkpoint import CheckpointWriter, begin
from magfusion.jobs.drift_world import bare_loop, memory_mib
from magfusion.model.trust import Risk
from magfusion.receiver.windows import default_settings
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.endurance import Biases, EnduranceConfig, draw_endurance
from magfusion.simulation.log import draw_drives
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import Array

HOUR, BLOCK, PIECE = 60, 60.0, 1.0  # blocks; s
GOAL_MIB = 4096.0


@dataclass(frozen=True, eq=False)
class Kept:
    """What a run stores with its navigator: the squared errors (m^2) of the hour, and of all."""

    biases: Biases
    seconds: float = 0.0
    bare: float = 0.0
    largest_mib: float = 0.0
    states: int = 0
    first_mib: float = 0.0
    squares: float = 0.0
    errors: tuple[float, ...] = ()


def pieces(time_s: Array, first: float) -> Iterator[slice]:
    """Yield the samples of a minute, a second at a time."""
    edges = np.searchsorted(time_s, first + PIECE * np.arange(round(BLOCK / PIECE) + 1))
    yield from (slice(*pair) for pair in pairwise(edges.tolist()))


def run(options: argparse.Namespace, place: Path) -> Kept:
    """Navigate through the hours that are left; return what came of all."""
    config = EnduranceConfig(options.hours, imu_rate_hz=options.rate_hz)
    seed = (options.seed, 0)
    world = draw_endurance(demo_site(synchronised=True), config, seed)
    drives = draw_drives(world.true_site, np.random.default_rng(seed))
    lockin = replace(default_settings(world.site), step=1.0)
    settings = NavigatorSettings(estimator=options.estimator, lockin=lockin, risk=Risk())
    key = run_key("bench_days", options.hours, options.rate_hz, options.seed, options.estimator)
    begun = begin(place, key, world.site, settings, Kept(world.start()), resume=options.resume)
    navigator, kept = begun.navigator, begun.extra
    writer = CheckpointWriter(place, key, sys.stderr)
    print("  hour  states  ms a state   loops      MiB  error/mm  (rms, of that hour)")
    for block in range(begun.position, config.blocks):
        built = world.stretch(block, 1, kept.biases)
        imu, began = built.imu, block * BLOCK
        rng = np.random.default_rng((*seed, block))
        parts = world.motion, world.true_site, drives, options.rate_hz, BLOCK, rng
        field = simulate_waveform(*parts, begin=began)
        bare = bare_loop(imu, world.site.platform.imu, world.site.gravity) * len(imu)
        states, spent = [], time.process_time()
        for own in pieces(field.time, began):
            navigator.propagate_imu(imu.time[own], imu.gyro_body[own], imu.accel_body[own])
            navigator.add_magnetometer(field.time[own], field.measured_sensor[own])
            states += navigator.take()
            navigator.take_lagged()
        spent = time.process_time() - spent
        true = world.motion.position_world(np.array([s.time for s in states]))
        off = [
            float(np.sum((s.position_world - p) ** 2)) for s, p in zip(states, true, strict=True)
        ]
        kept = replace(
            kept,
            biases=built.after,
            seconds=kept.seconds + spent,
            bare=kept.bare + bare,
            states=kept.states + len(states),
            largest_mib=max(kept.largest_mib, memory_mib()),
            squares=kept.squares + sum(off),
            errors=(*kept.errors, *off),
        )
        if (block + 1) % HOUR == 0:
            first_mib = kept.first_mib or memory_mib()
            rms = 1e3 * float(np.sqrt(np.mean(kept.errors)))
            each, loops = 1e3 * kept.seconds / max(kept.states, 1), kept.seconds / kept.bare
            line = f"{(block + 1) // HOUR:6d}{kept.states:8d}{each:12.2f}{loops:8.1f}"
            print(f"{line}{memory_mib():9.0f}{rms:10.2f}", flush=True)
            kept = replace(kept, first_mib=first_mib, errors=())
            writer.save(navigator, block + 1, kept)
    return kept


def main() -> None:
    """Print a line an hour and one of JSON; exit with 1 where the goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--hours", type=float, default=48.0, help="of raw samples")
    parser.add_argument("--rate-hz", type=float, default=100.0, help="of both instruments")
    parser.add_argument("--estimator", choices=("ekf", "smoother"), default="ekf")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--checkpoint", type=Path, help="file to go on from; else a new one")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        kept = run(options, options.checkpoint or Path(directory) / "checkpoint.bin")
    result = {
        "states": kept.states,
        "error_mm": 1e3 * (kept.squares / max(kept.states, 1)) ** 0.5,
        "largest_mib": kept.largest_mib,
        "grown_mib": memory_mib() - kept.first_mib if kept.first_mib else None,
        "seconds": kept.seconds,
        "loops": kept.seconds / kept.bare,
    }
    print(json.dumps(result))
    sys.exit(int(kept.largest_mib > GOAL_MIB))


if __name__ == "__main__":
    main()
