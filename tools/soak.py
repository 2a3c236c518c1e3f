"""Hours of a walk with faults through ``magfusion navigate -`` as a process.

    python tools/soak.py --hours 6 --place soak
    python tools/soak.py --hours 6 --place soak --resume

Inertial samples and phasors of `magfusion.simulation.endurance` are written to its standard input;
each kind of fault occurs so many times at random.  The run fails where the process ends, where it
is wrong beyond what it claims while trustworthy, where no state comes back after a fault, or where
its memory grows.  ``result.json`` in the directory has each of these, by minute.
"""

import argparse
import json
import queue
import resource
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from magfusion.files.site import save_site
from magfusion.files.stream import json_line
from magfusion.files.stream_contents import fields_contents, imu_content
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.drift import Drift
from magfusion.simulation.endurance import BLOCK, EnduranceConfig, EnduranceWorld, draw_endurance
from magfusion.simulation.motion import Rests

PIECE = 0.5  # s in a record
CALM = 30.0  # s before each fault: a start needs about ten
MIN_SILENCE, MAX_SILENCE = 1.0, 600.0  # s of a silence
FULL = 60.0  # s
SPIKED = 0.02  # of the samples, while they have spikes
WRONG = 2.0  # s
BACK = {"restart": 30.0}  # s to the next state, of a run that starts again
BACK_BY_FIELDS = 10.0  # s
GROWTH_MIB = 64.0  # beyond what the first third of the run needed
WAIT = 120.0  # s of real time without a state, of a process that hangs
KINDS = (
    "imu_silent", "fields_silent", "imu_spikes", "field_spikes", "clock_step", "beacons_off",
    "full_disk", "kill",
)  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """A fault from one time to another (s), with a number that is its size."""

    kind: str
    begin: float
    end: float
    size: float

    @property
    def allowed(self) -> float:
        """Time to the next state after its end (s)."""
        return BACK["restart"] if self.kind in ("clock_step", "kill") else BACK_BY_FIELDS


def schedule(hours: float, each: int, rng: np.random.Generator) -> list[Fault]:
    """Return the faults, one after the other in random order."""
    kinds = rng.permutation(np.repeat(KINDS, each))
    duration = np.exp(rng.uniform(np.log(MIN_SILENCE), np.log(MAX_SILENCE), len(kinds)))
    duration[kinds == "full_disk"] = FULL
    duration[np.isin(kinds, ("clock_step", "kill"))] = 0.0
    spare = 3600.0 * hours - CALM * (len(kinds) + 1)
    if spare <= 0.0:
        raise SystemExit(f"{len(kinds)} faults do not fit {hours:g} h; give less --faults")
    duration *= min(1.0, 0.6 * spare / duration.sum())
    gaps = CALM + (spare - duration.sum()) * rng.dirichlet(np.ones(len(kinds) + 1))
    begin = np.cumsum(gaps[:-1]) + np.concatenate([[0.0], np.cumsum(duration)[:-1]])
    size = rng.uniform(size=len(kinds))
    rows = zip(kinds.tolist(), begin.tolist(), duration.tolist(), size.tolist(), strict=True)
    return [Fault(kind, start, start + length, number) for kind, start, length, number in rows]


@dataclass
class Result:
    """What came of the run so far: times in seconds of the simulation."""

    seed: int
    hours: float
    faults: int
    estimator: str
    minute: int = 0
    offset: float = 0.0
    states: int = 0
    rss_mib: list[float] = field(default_factory=list)
    back_s: list[dict[str, Any]] = field(default_factory=list)
    finds: list[str] = field(default_factory=list)


class Navigation:
    """The process, and a thread that reads its states."""

    def __init__(self, place: Path, estimator: str, *, resume: bool) -> None:
        words = f"-m magfusion navigate - --estimator {estimator} --every 5"
        files = ["--site", str(place / "site.yaml"), "--checkpoint", str(place / "checkpoint.bin")]
        self._messages = (place / "messages.txt").open("ab")
        self.process = subprocess.Popen(
            [sys.executable, *words.split(), *files, *["--resume"][: int(resume)]],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._messages,
        )
        self.lines: queue.Queue[bytes] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line)

    def write(self, content: dict[str, Any]) -> None:
        """Write a record."""
        assert self.process.stdin is not None
        self.process.stdin.write(json_line(content))
        self.process.stdin.flush()

    def limit(self, size: int) -> None:
        """Let no file of the process be longer (bytes)."""
        _, hard = resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (size, hard))

    def rss_mib(self) -> float:
        """Return its resident memory."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) / 1024.0

    def close(self, *, kill: bool = False) -> int:
        """End the process, at once or by the end of its input; return its exit code."""
        assert self.process.stdin is not None
        if kill:
            self.process.kill()
        else:
            self.process.stdin.close()
        status = self.process.wait(WAIT)
        self._reader.join()
        self._messages.close()
        return status


class Judge:
    """Compares states with the truth."""

    def __init__(self, world: EnduranceWorld, result: Result) -> None:
        self._world, self.result = world, result
        self._wrong_since: float | None = None
        self._offset = result.offset  # of the states that are read
        self.awaited: deque[Fault] = deque()

    def see(self, line: bytes) -> None:
        """Judge a state."""
        state = json.loads(line)
        if not state["started"]:  # a new start, which each step of the clock leads to
            self._offset = self.result.offset
        time_s = state["time"] - self._offset
        if not state["started"] or state["lost"]:
            self._wrong_since = None
            return
        self.result.states += 1
        while self.awaited and time_s > self.awaited[0].end:
            fault = self.awaited.popleft()
            row = {"kind": fault.kind, "end": fault.end, "back_s": time_s - fault.end}
            self.result.back_s.append(row)
            if row["back_s"] > fault.allowed:
                self._find(f"{row['back_s']:.1f} s to a state after {fault}")
        claim = state["protection_level_m"] or 5.0 * float(
            np.linalg.norm(state["sigma"]["position"])
        )
        true = self._world.motion.position_world(np.array([time_s]))[0]
        error = float(np.linalg.norm(np.array(state["position"]) - true))
        if state["verdict"] != "trustworthy" or error <= claim:
            self._wrong_since = None
        elif self._wrong_since is None:
            self._wrong_since = time_s
        elif self._wrong_since < time_s - WRONG:
            self._find(f"at {time_s:.1f} s trustworthy, but wrong by {error:.3g} m ({claim:.3g} m)")
            self._wrong_since = np.inf  # once

    def overdue(self, fed: float) -> None:
        """Find what has not come back though samples were written far beyond."""
        while self.awaited and fed > self.awaited[0].end + 2.0 * self.awaited[0].allowed:
            self._find(f"no state after {self.awaited.popleft()}")

    def _find(self, what: str) -> None:
        self.result.finds.append(what)
        sys.stdout.write(f"\n{what}\n")


class Soak:
    """The run: a world, its faults, and the process."""

    def __init__(self, place: Path, result: Result, *, resume: bool) -> None:
        config = EnduranceConfig(
            result.hours,
            drift=Drift(),
            schedule=Rests(20.0, 100.0, 20.0),
            imu_rate_hz=50.0,
            rest_interval=1.0,
        )
        self.place, self.result = place, result
        self.world = draw_endurance(demo_site(), config, (result.seed, 0))
        self.faults = schedule(result.hours, result.faults, np.random.default_rng(result.seed))
        save_site(self.world.site, place / "site.yaml")
        self.judge = Judge(self.world, result)
        self.navigation = Navigation(place, result.estimator, resume=resume)
        self._begun = set(f for f in self.faults if f.begin < BLOCK * result.minute)
        self._full = False

    def run(self, *, realtime: bool) -> None:
        """Go through all minutes, from the first that is not done."""
        biases, began = self.world.start(), time.monotonic()
        first = self.result.minute
        for block in range(self.world.config.blocks):
            built = self.world.stretch(block, 1, biases)
            biases = built.after
            if block < first:
                continue
            rng = np.random.default_rng((self.result.seed, 1, block))
            for k in range(round(BLOCK / PIECE)):
                edge = BLOCK * block + PIECE * (k + 1)
                if realtime:
                    time.sleep(max(0.0, edge - BLOCK * first - (time.monotonic() - began)))
                self._piece(built.imu, built.fields, edge, rng)
                if self.navigation.process.poll() is not None:
                    status = self.navigation.process.returncode
                    self.result.finds.append(f"ended by itself with {status} at {edge:.1f} s")
                    return
            self._save(block + 1, time.monotonic() - began)
        status = self.navigation.close()
        self._read(BLOCK * self.world.config.blocks)
        if status:
            self.result.finds.append(f"exit code {status} at the end")

    def _piece(
        self, imu: ImuSamples, fields: FieldSamples, edge: float, rng: np.random.Generator
    ) -> None:
        """Write the samples up to a time, with what is wrong in them then."""
        for fault in self.faults:
            if fault.begin < edge and fault not in self._begun:
                self._begin(fault, edge)
        now = {f.kind: f for f in self.faults if f.begin < edge <= f.end}
        self._fill_disk(full="full_disk" in now)
        rows = (imu.time >= edge - PIECE) & (imu.time < edge)
        gyro, accel = imu.gyro_body[rows], imu.accel_body[rows]
        if "imu_spikes" in now:
            hit = rng.random(len(gyro)) < SPIKED
            gyro[hit] += 10.0 ** rng.uniform(0.0, 12.0, (hit.sum(), 3))
            accel[hit] += 10.0 ** rng.uniform(1.0, 19.0, (hit.sum(), 3))
        offset = self.result.offset
        try:
            if "imu_silent" not in now:
                self.navigation.write(imu_content(ImuSamples(imu.time[rows] + offset, gyro, accel)))
            for k in np.flatnonzero((fields.time >= edge - PIECE) & (fields.time < edge)):
                one = _spoiled(fields.rows(slice(k, k + 1)), now, rng)
                if "fields_silent" not in now:
                    for record in fields_contents(replace(one, time=one.time + offset)):
                        self.navigation.write(record)
        except BrokenPipeError:
            self.navigation.process.wait(WAIT)
        self._read(edge)

    def _begin(self, fault: Fault, edge: float) -> None:
        self._begun.add(fault)
        self.judge.awaited.append(fault)
        if fault.kind == "clock_step":
            # Back by more than a second, or ahead by more than a minute, is a step.
            size = fault.size
            self.result.offset += 70.0 + 1e4 * size if size > 0.5 else -2.0 - edge * size
        elif fault.kind == "kill":
            self.navigation.close(kill=True)
            self._read(edge)
            self.navigation = Navigation(self.place, self.result.estimator, resume=True)

    def _fill_disk(self, *, full: bool) -> None:
        if full != self._full:
            self.navigation.limit(1000 if full else resource.RLIM_INFINITY)
            self._full = full

    def _read(self, fed: float) -> None:
        while not self.navigation.lines.empty():
            self.judge.see(self.navigation.lines.get())
        self.judge.overdue(fed - 30.0)  # s; what is still in the pipe

    def _save(self, minute: int, elapsed: float) -> None:
        result = self.result
        result.minute = minute
        result.rss_mib.append(round(self.navigation.rss_mib(), 1))
        save(result, self.place)
        sys.stdout.write(
            f"\r{minute} of {self.world.config.blocks} min, {elapsed:.0f} s,"
            f" {result.states} states, {result.rss_mib[-1]:.0f} MiB,"
            f" {len(result.back_s)} faults, {len(result.finds)} finds "
        )
        sys.stdout.flush()


def _spoiled(fields: FieldSamples, now: dict[str, Fault], rng: np.random.Generator) -> FieldSamples:
    """Return phasors without the beacons that are off, and with spikes."""
    phasor, cov = fields.phasor_sensor.copy(), fields.phasor_cov.copy()
    if "beacons_off" in now:
        names = [name for name, _ in fields.channels]
        off = list(dict.fromkeys(names))[: 1 + int(4.0 * now["beacons_off"].size)]
        columns = [k for k, name in enumerate(names) if name in off]
        phasor[:, columns], cov[:, columns] = np.nan, np.nan
    if "field_spikes" in now and rng.random() < 0.2:
        phasor[:, rng.integers(phasor.shape[1])] += 10.0 ** rng.uniform(-8.0, 0.0)
    return replace(fields, phasor_sensor=phasor, phasor_cov=cov)


def save(result: Result, place: Path) -> None:
    """Write the result so far."""
    unfinished = place / "result.json.part"
    unfinished.write_text(json.dumps(asdict(result), indent=1) + "\n")
    unfinished.replace(place / "result.json")


def grown_mib(rss_mib: list[float]) -> float:
    """Return by how much the memory grew after the first third of a run."""
    third = max(1, len(rss_mib) // 3)
    return max(rss_mib[third:], default=0.0) - max(rss_mib[:third], default=0.0)


def main() -> int:
    """Soak as the command line requests; return 1 where anything is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--hours", type=float, default=6.0, help="of samples")
    parser.add_argument("--faults", type=int, default=10, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--estimator", choices=("ekf", "smoother"), default="ekf")
    parser.add_argument("--realtime", action="store_true", help="not faster than the clock")
    parser.add_argument("--place", type=Path, required=True, help="directory of the result")
    parser.add_argument("--resume", action="store_true", help="continue where it was ended")
    chosen = parser.parse_args()
    chosen.place.mkdir(parents=True, exist_ok=True)
    result = Result(chosen.seed, chosen.hours, chosen.faults, chosen.estimator)
    resume = chosen.resume and (chosen.place / "result.json").exists()
    if resume:
        result = Result(**json.loads((chosen.place / "result.json").read_text()))
    Soak(chosen.place, result, resume=resume).run(realtime=chosen.realtime)
    if grown_mib(result.rss_mib) > GROWTH_MIB:
        result.finds.append(f"memory grew by {grown_mib(result.rss_mib):.0f} MiB")
    save(result, chosen.place)
    slowest = max((row["back_s"] for row in result.back_s), default=0.0)
    sys.stdout.write(
        f"\n{result.states} states, {len(result.back_s)} faults, at most {slowest:.1f} s to the"
        f" next state, {grown_mib(result.rss_mib):.0f} MiB grown, {len(result.finds)} finds\n"
    )
    return int(bool(result.finds))


if __name__ == "__main__":
    sys.exit(main())
