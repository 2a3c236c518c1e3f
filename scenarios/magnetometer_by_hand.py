"""Whether guidance leads a hand to a calibrated magnetometer in time.

A simulated hand turns a sensor with a hard iron of 30 uT per axis, rms, and writes its samples into
``magfusion calibrate magnetometer -``, a process.  It reads the guidance every two seconds, reacts
0.7 s later, turns the named axis up or down at 50 deg/s, trembles, and accelerates the IMU by a
lever of 0.25 m.  Drawn per hand: hard iron, matrix, biases, trembling, first attitude.

1. Hands that follow it: how long does it take, and how large is the error of the offset?  Of
   20 hands all end by themselves, in 23 s (27 at most), with 0.014 uT (0.034 at most).
2. A hand that turns about the vertical alone: what is reported as missing?
"""

import json
import queue
import re
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np
from harness import conclude, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.files.site import load_site, save_site
from magfusion.model.field import skew
from magfusion.model.site import Site
from magfusion.simulation.demo_site import demo_site
from magfusion.units import Array

STEP = 0.01  # s
MAX_DURATION = 90.0  # s
LINE = 2.0  # s; between lines of guidance
SPEED = 0.9  # rad/s
TREMBLE = 0.3  # rad/s, rms of each axis
REACTION = 0.7  # s
MUSCLE = 0.15  # s; each of two lags of the rate
LEVER = np.array([0.25, 0.05, 0.1])  # m
NOISE = 1e-7  # T, rms of a sample
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class HandRun:
    """A rotation: exit code, its length (s), error and largest sigma of the offset (uT)."""

    code: int
    seconds: float
    offset_error_ut: float
    offset_sigma_ut: float
    message: str


def uncalibrated_site() -> Site:
    """Return a site without beacons, whose magnetometer was never calibrated."""
    site = replace(demo_site(), beacons=())
    sensor = site.platform.magnetometer
    sigma = replace(
        sensor.sigma,
        matrix=np.full((3, 3), 0.05),
        offset=np.full(3, 6e-5),
        rotation_sensor=np.full(3, 0.02),
    )
    sensor = replace(sensor, matrix=np.eye(3), offset=np.zeros(3), sigma=sigma)
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


class Hand:
    """A hand that turns a sensor, and the samples of it.

    Parameters
    ----------
    follows : bool
        Whether it follows the guidance, or turns about the vertical alone.
    """

    def __init__(self, site: Site, rng: np.random.Generator, *, follows: bool) -> None:
        self.site, self._rng, self._follows = site, rng, follows
        self.time = 0.0
        self._target: Array | None = None
        self._next: tuple[float, Array | None] = (0.0, None)
        self._body = Rotation.random(random_state=rng) if follows else Rotation.identity()
        self._tremble, self._drive, self._rate = np.zeros(3), np.zeros(3), np.zeros(3)
        self.matrix = np.eye(3) + 0.03 * rng.standard_normal((3, 3))
        self.offset = 3e-5 * rng.standard_normal(3)
        imu = site.platform.imu
        self._biases = [
            sigma * rng.standard_normal(3) for sigma in (imu.gyro_bias_sigma, imu.accel_bias_sigma)
        ]

    def see(self, line: str) -> None:
        """Read the guidance."""
        target = target_in(line)
        if target is not None:
            target = self.site.platform.magnetometer.body_from_sensor @ target
        self._next = (self.time + REACTION, target)

    def _wanted(self) -> Array:
        """Return the intended rate, body axes."""
        up = self._body.inv().apply(UP)
        if not self._follows:
            return 0.7 * up
        if self.time >= self._next[0]:
            self._target = self._next[1]
        if self._target is None:
            return 0.3 * up
        axis = np.cross(self._target, up)
        if np.linalg.norm(axis) < 0.05 and up @ self._target < 0.0:
            axis = np.cross(np.roll(self._target, 1) + 0.1, up)
        far = np.arccos(np.clip(up @ self._target, -1.0, 1.0))
        return axis / max(float(np.linalg.norm(axis)), 0.05) * min(SPEED, 2.0 * far) + 0.2 * up

    def step(self) -> tuple[Array, Array, Array]:
        """Return angular rate, specific force and measured field of the next sample."""
        rng = self._rng
        keep = np.exp(-STEP / 0.5)
        tremble = TREMBLE if self._follows else 0.02
        self._tremble = keep * self._tremble
        self._tremble += tremble * np.sqrt(1.0 - keep**2) * rng.standard_normal(3)
        self._drive += STEP / MUSCLE * (self._wanted() + self._tremble - self._drive)
        before = self._rate
        self._rate = before + STEP / MUSCLE * (self._drive - before)
        self._body = self._body * Rotation.from_rotvec(STEP * self._rate)
        self.time += STEP
        turn = skew((self._rate - before) / STEP) + skew(self._rate) @ skew(self._rate)
        back = self._body.inv()
        site, imu = self.site, self.site.platform.imu
        accel = turn @ LEVER + back.apply(site.gravity * UP) + self._biases[1]
        accel += imu.accel_noise / np.sqrt(STEP) * rng.standard_normal(3)
        gyro = self._rate + self._biases[0]
        gyro = gyro + imu.gyro_noise / np.sqrt(STEP) * rng.standard_normal(3)
        field = back.apply(site.earth_field_world) @ site.platform.magnetometer.body_from_sensor
        return gyro, accel, self.matrix @ field + self.offset + NOISE * rng.standard_normal(3)


def target_in(line: str) -> Array | None:
    """Return the direction in sensor axes that a line of guidance names."""
    named = re.search(r"next: ([^;]*);", line)
    if named is None:
        return None
    result = np.zeros(3)
    for axis, way in re.findall(r"\b([xyz]) (up|down)", named[1]):
        result["xyz".index(axis)] = 1.0 if way == "up" else -1.0
    return result / np.linalg.norm(result) if result.any() else None


def turn(hand: Hand, directory: Path, duration: float = MAX_DURATION) -> HandRun:
    """Turn a sensor while ``magfusion calibrate magnetometer -`` guides, as a process."""
    site, output = directory / "site.yaml", directory / "magnetometer"
    save_site(hand.site, site)
    words = ["calibrate", "magnetometer", "-", "--site", str(site), "-o", str(output)]
    command = [sys.executable, "-m", "magfusion", *words]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stderr=pipe, stdout=subprocess.DEVNULL) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        lines: queue.Queue[str] = queue.Queue()
        reader = threading.Thread(target=_lines, args=(process.stderr, lines), daemon=True)
        reader.start()
        text, due = "", LINE + 0.5
        try:
            while hand.time < duration:
                process.stdin.write(_record(hand))
                process.stdin.flush()
                if hand.time > due:
                    text = lines.get(timeout=60.0)
                    if not text:
                        break
                    hand.see(text)
                    due += LINE
            process.stdin.close()
        except BrokenPipeError:
            pass
        code = process.wait(timeout=120.0)
        reader.join()
    while not lines.empty():
        text = lines.get() or text
    return _result(hand, code, output, text)


def _record(hand: Hand) -> bytes:
    """Return five samples of each stream as a record."""
    times, rows = [], []
    for _ in range(5):
        rows.append(hand.step())
        times.append(round(hand.time, 6))
    gyro, accel, field = (np.array(column).tolist() for column in zip(*rows, strict=True))
    imu = {"time": times, "gyro": gyro, "accel": accel}
    record = {"imu": imu, "magnetometer": {"time": times, "field": field}}
    return json.dumps(record).encode() + b"\n"


def _lines(stream: IO[bytes], lines: queue.Queue[str]) -> None:
    for line in stream:
        lines.put(line.decode())
    lines.put("")


def _result(hand: Hand, code: int, output: Path, text: str) -> HandRun:
    error = sigma = np.nan
    if code == 0:
        sensor = load_site(output / "site.yaml", without=True).platform.magnetometer
        error = 1e6 * float(np.linalg.norm(sensor.offset - hand.offset))
        sigma = 1e6 * float(np.max(sensor.sigma.offset))
    return HandRun(code, hand.time, error, sigma, " ".join(text.split()))


def turn_many(count: int, seed: int, *, follows: bool) -> list[HandRun]:
    """Return the rotations of several hands."""
    result = []
    for k in range(count):
        hand = Hand(uncalibrated_site(), np.random.default_rng([seed, k]), follows=follows)
        with tempfile.TemporaryDirectory() as directory:
            result.append(turn(hand, Path(directory), MAX_DURATION if follows else 30.0))
    return result


def main() -> None:
    """Run both parts."""
    parser = scenario_parser(__doc__, seed=1, quick="three hands", output=None)
    options = parser.parse_args()
    count = 3 if options.quick else 20
    following = turn_many(count, options.seed, follows=True)
    ignoring = turn_many(1, options.seed, follows=False)
    seconds = [one.seconds for one in following]
    errors = [one.offset_error_ut for one in following]
    text = (
        f"{sum(one.code == 0 for one in following)} of {count} hands that follow end by themselves,"
        f" in {np.median(seconds):.0f} s (median; {max(seconds):.0f} at most); their offset is off"
        f" by {np.median(errors):.3f} uT (median; {max(errors):.3f} at most).\n"
        f"One that turns about the vertical alone: exit code {ignoring[0].code},"
        f" {ignoring[0].message}"
    )
    conclude(text, {"following": following, "ignoring": ignoring})


if __name__ == "__main__":
    main()
