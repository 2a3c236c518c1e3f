"""A tracker whose coils a host drives one after the other, with pauses as they happen.

The world of `tracker_samples`: turns of windings by elliptic integrals, a drive that drifts, steps
of a 16-bit converter, mains, and a head that turns at 100 deg/s.  A host switches the coils: bursts
of 1.6 to 2.4 ms, pauses of 0.2 to 1.3 ms, and now and then 10 to 60 ms in which it was busy.  The
current takes 0.05 ms to rise and to fall, and 0.2 ms of it are marked as nothing.  Reported are

1. how far `magfusion fix` and `smooth` are from the truth while the head turns, with a slot next to
   each sample and with a table of marks, for a tone and for pulses of direct current;
2. how far the states of the pipe are, by records with a slot for each sample and by marks;
3. the same of slots that keep to a clock, 120 cycles a second: what the pauses cost.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from harness import conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation
from tracker_head import TURNING, Config, Head
from tracker_pipe import piped
from tracker_samples import PIECE, sample_times, site_text, waveform

from magfusion.files.log import write_log
from magfusion.files.trajectory_table import read_trajectory
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.trajectory import Trajectory
from magfusion.units import DEGREE, Array, IntArray

BURST, PAUSE = (1.6e-3, 2.4e-3), (0.2e-3, 1.3e-3)  # s
BUSY, LONG_PAUSE = 0.01, (0.01, 0.06)  # share of the pauses in which the host did else; s
RISE, SETTLING = 0.05e-3, 0.2e-3  # s
SILENT = -1
LENGTH, BEGUN = 12.5, 6.5  # s
Declared = Literal["column", "marks"]
Ways = tuple[Declared, ...]


@dataclass(frozen=True)
class Errors:
    """Root mean squares while the head turns, and the epochs or states of that."""

    mm: float
    deg: float
    count: int


@dataclass(frozen=True, eq=False)
class Bursts:
    """When a host drove which coil, as it switched it (s); silences between cycles, too."""

    begin: Array
    end: Array
    slot: IntArray

    def marked(self) -> tuple[Array, Array, IntArray]:
        """Return start, end and slot as the host would write them, when the current has settled."""
        return self.begin + SETTLING, self.end, self.slot

    def between(self, time: Array) -> IntArray:
        """Return the slot of each sample, -2 where none is declared."""
        start, end, slot = self.marked()
        row = np.searchsorted(start, time, side="right") - 1
        inside = (row >= 0) & (time < end[row])
        return np.where(inside, slot[row], -2)

    def gates(self, time: Array) -> Array:
        """Return the share of its current that each coil has (n, 3)."""
        out = np.zeros((len(time), 3))
        for begin, end, slot in zip(self.begin, self.end, self.slot, strict=True):
            if slot == SILENT:
                continue
            rows = slice(*np.searchsorted(time, [begin, end + SETTLING]))
            start_time = time[rows] - begin
            rising = 1.0 - np.exp(-start_time / RISE)
            falling = np.exp(-(time[rows] - end) / RISE)
            out[rows, slot] += np.where(time[rows] < end, rising, falling)
        return out


def bursts(duration: float, silences: bool, rng: np.random.Generator) -> Bursts:
    """Return bursts of three coils in turn, of pulses with a silence behind each cycle."""
    count = int(duration / (BURST[0] + PAUSE[0]))
    length, pause = rng.uniform(*BURST, count), rng.uniform(*PAUSE, count)
    busy = rng.random(count) < BUSY
    pause[busy] = rng.uniform(*LONG_PAUSE, int(np.sum(busy)))
    end = np.cumsum(length + pause)
    turn = np.array([0, 1, 2, SILENT] if silences else [0, 1, 2], dtype=np.int64)
    kept = end < duration
    return Bursts((end - length)[kept], end[kept], np.resize(turn, count)[kept])


@dataclass(frozen=True, eq=False)
class Recording:
    """What was recorded of a head."""

    config: Config
    head: Head
    wave: tuple[Array, Array]
    imu: tuple[Array, Array, Array]
    bursts: Bursts | None

    def site_text(self) -> str:
        """Return the site as its owner would write it."""
        text = site_text(self.config)
        if self.bursts is None:
            return text
        line = next(line for line in text.splitlines() if "slots: {" in line)
        return text.replace(line, "    slots: marked")

    def write(self, path: Path, reported: Declared) -> None:
        """Write it as a log, with its site next to it."""
        time, field = self.wave
        at = self.imu[0]
        turn, place = self.head.turn(at).as_matrix(), self.head.place(at)
        truth = Trajectory(at, turn, place)
        imu, waveform = ImuSamples(*self.imu), Waveform(time, field)
        write_log(Log("bursts", 0, "simulated", imu, waveform, truth=truth), path)
        (path / "site.yaml").write_text(self.site_text())
        if self.bursts is None:
            return
        if reported == "marks":
            start, end, slot = self.bursts.marked()
            stamps = {"time_ns": _stamps(start), "end_ns": _stamps(end), "slot": slot}
            pa.parquet.write_table(pa.table(stamps), path / "marks.parquet")
            return
        table = pa.parquet.read_table(path / "magnetometer.parquet")
        own = self.bursts.between(time)
        column = pa.array(own, pa.int64(), mask=own == -2)
        pa.parquet.write_table(table.append_column("slot", column), path / "magnetometer.parquet")

    def records(self, reported: Declared) -> bytes:
        """Return the streams as the lines of a driver, every hundredth of a second."""
        time, field = self.wave
        others = None if self.bursts is None else self.bursts.between(time)
        edges = PIECE * np.arange(round(self.config.duration / PIECE) + 1)
        lines = []
        for begin, end in pairwise((edges - 1e-9).tolist()):
            own = slice(*np.searchsorted(self.imu[0], [begin, end]))
            rows = slice(*np.searchsorted(time, [begin, end]))
            parts = (part[own].tolist() for part in self.imu)
            wave: dict[str, Any] = {"time": time[rows].tolist(), "field": field[rows].tolist()}
            record: dict[str, Any] = {
                "imu": dict(zip(("time", "gyro", "accel"), parts, strict=True)),
                "magnetometer": wave,
            }
            if others is not None and reported == "column":
                wave["slot"] = [None if one == -2 else one for one in others[rows].tolist()]
            elif self.bursts is not None:
                start, until, slot = self.bursts.marked()
                new = slice(*np.searchsorted(until, [begin, end]))
                names = ("start", "end", "slot")
                marks = (part[new].tolist() for part in (start, until, slot))
                record["marks"] = dict(zip(names, marks, strict=True))
            lines.append(json.dumps(record).encode())
        return b"\n".join(lines) + b"\n"


def _stamps(time: Array) -> IntArray:
    return np.rint(1e9 * time).astype(np.int64)


def record(config: Config, *, uneven: bool) -> Recording:
    """Return what is recorded of a head."""
    rng = np.random.default_rng(config.seed + 1)
    head, own = Head(config), None
    gates = None
    if uneven:
        schedule = np.random.default_rng([config.seed, 7])
        own = bursts(config.duration, config.carrier_hz == 0.0, schedule)
        gates = own.gates(sample_times(config))
    wave = waveform(config, head, rng, gates)
    return Recording(config, head, wave, head.imu(config, rng), own)


def errors(result: Trajectory, head: Head) -> Errors:
    """Return the errors of poses while the head turns."""
    kept = result.time >= TURNING
    time = result.time[kept]
    place = result.position_world[kept] - head.place(time)
    own = Rotation.from_matrix(result.world_from_body[kept])
    turn = (head.turn(time).inv() * own).magnitude() / DEGREE
    return Errors(1e3 * rms(np.linalg.norm(place, axis=1)), rms(turn), len(time))


def of_job(job: str, simulation: Recording, reported: Declared) -> Errors:
    """Return the errors of a job of the command line."""
    with tempfile.TemporaryDirectory() as directory:
        log, result = Path(directory) / "log", Path(directory) / "result"
        simulation.write(log, reported)
        command = [sys.executable, "-m", "magfusion", job, str(log), "-o", str(result)]
        subprocess.run(command, check=True, capture_output=True)
        return errors(read_trajectory(result / "trajectory.parquet", 0), simulation.head)


def of_pipe(simulation: Recording, reported: Declared) -> Errors:
    """Return the errors of the states of the pipe."""
    with tempfile.TemporaryDirectory() as directory:
        site = Path(directory) / "site.yaml"
        site.write_text(simulation.site_text())
        states, _ = piped(site, simulation.records(reported))
    known = [s for s in states if not s["lost"]]
    time = np.array([s["time"] for s in known])
    turn = Rotation.from_quat([s["quaternion"] for s in known], scalar_first=True)
    place = np.array([s["position"] for s in known])
    return errors(Trajectory(time, turn.as_matrix(), place), simulation.head)


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, quick="without smooth", output=None)
    given = parser.parse_args()
    config = Config(seed=given.seed, duration=LENGTH)
    pulsed = replace(config, carrier_hz=0.0)
    worlds = {
        "slots by a clock": (record(config, uneven=False), ("marks",)),
        "uneven bursts": (record(config, uneven=True), ("column", "marks")),
        "pulses, uneven": (record(pulsed, uneven=True), ("column", "marks")),
    }
    jobs = ("fix",) if given.quick else ("fix", "smooth")
    result: dict[str, Errors] = {}
    for name, (built, ways) in worlds.items():
        for reported in ways:
            label = name if built.bursts is None else f"{name}, {reported}"
            for job in jobs:
                result[f"{label}, {job}"] = of_job(job, built, reported)
            result[f"{label}, pipe"] = of_pipe(built, reported)
    lines = [f"{'turning at 100 deg/s':<34}{'mm':>8}{'deg':>8}{'a second':>10}"]
    for label, one in result.items():
        rate = one.count / (LENGTH - TURNING)
        lines.append(f"{label:<34}{one.mm:8.3f}{one.deg:8.3f}{rate:10.1f}")
    conclude("\n".join(lines), result)


if __name__ == "__main__":
    main()
