"""Processor time of the estimators against the number of beacons.

A walk of 20 s (IMU 200 Hz, magnetometer 500 Hz, tones 2.5 Hz apart) is simulated and taken by
`magfusion navigate` and `magfusion smooth` as processes of their own: once with 4 to 64 beacons
around one room, all received, and once with as many in rooms 80 m apart, four received.
Start-up, the time of `magfusion smooth --help`, is taken off.  The exponent is that of the time
against the number, from the first to the last.
"""

import argparse
import json
import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_long import PROGRAM, used
from scipy.spatial.transform import Rotation

from magfusion.files.site import save_site
from magfusion.model.site import Site
from magfusion.simulation.demo_site import demo_site
from magfusion.units import Array

ROOM_WORLD = np.array([[0.0, 0.0, 0.1], [8.0, 6.0, 2.5]])  # m
BOX_WORLD = np.array([[1.5, 1.5, 0.6], [6.5, 4.5, 1.6]])  # m, of the walk
ROOM_SPACING = 80.0  # m, of rooms: a beacon's field is then below the noise of the next room's walk
SECONDS = 20.0
COMMANDS = {"navigate": ("navigate", "--estimator", "ekf"), "smooth": ("smooth",)}


def on_the_wall(rng: np.random.Generator) -> Array:
    """Return a place (m) on one of the four walls of the first room, shape (3,)."""
    place = rng.uniform(*ROOM_WORLD)
    axis = rng.integers(2)
    place[axis] = ROOM_WORLD[rng.integers(2), axis]
    return np.asarray(place)


def installation(count: int, a_room: int, rng: np.random.Generator) -> Site:
    """Return a site of as many beacons, so many of them in each room."""
    site = demo_site(coil_radius=None)
    beacons = tuple(
        replace(
            site.beacons[0],
            name=f"B{k}",
            position_world=on_the_wall(rng) + np.array([ROOM_SPACING * (k // a_room), 0.0, 0.0]),
            world_from_beacon=Rotation.random(random_state=rng).as_matrix(),
            frequency_hz=20.0 + 2.5 * k,
        )
        for k in range(count)
    )
    return replace(site, beacons=beacons)


def measured(place: Path, count: int, a_room: int, seed: int) -> dict[str, float]:
    """Return the processor time (s) of each command on a simulated log."""
    place.mkdir()
    site, log = place / "site.yaml", place / "log"
    save_site(installation(count, a_room, np.random.default_rng([seed, count])), site)
    box = ",".join(f"{value:g}" for value in BOX_WORLD.T.ravel())
    simulation = f"simulate --site {site} --box {box} --rate 500 --duration {SECONDS:g}"
    used((*PROGRAM, *simulation.split(), "--seed", str(seed), "-o", str(log)))
    return {
        name: used(
            (*PROGRAM, *command, str(log), "--site", str(site), "-o", str(place / name))
        ).seconds
        for name, command in COMMANDS.items()
    }


def main() -> None:
    """Print a table and one JSON line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--counts", type=int, nargs="+", default=[4, 8, 16, 32, 64])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    start_up = used((*PROGRAM, "smooth", "--help")).seconds
    figures: dict[str, dict[int, dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for layout, a_room in {"all received": max(options.counts), "four received": 4}.items():
            of_layout = figures.setdefault(layout, {})
            for count in options.counts:
                place = Path(scratch) / f"{a_room}_{count}"
                seconds = measured(place, count, a_room, options.seed)
                of_layout[count] = {name: seconds[name] - start_up for name in seconds}
                row = "".join(
                    f"{name:>10} {value:6.1f} s" for name, value in of_layout[count].items()
                )
                print(f"{layout:<14}{count:4} beacons{row}", flush=True)
            first, last = of_layout[options.counts[0]], of_layout[options.counts[-1]]
            span = math.log(options.counts[-1] / options.counts[0])
            for name in COMMANDS:
                print(f"{name}: exponent {math.log(last[name] / first[name]) / span:.2f}")
    print(json.dumps({"start_up_s": start_up, "processor_s": figures}))


if __name__ == "__main__":
    sys.exit(main())
