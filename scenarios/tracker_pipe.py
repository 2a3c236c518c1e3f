"""The pipe as its user runs it, and how far its states are from where a head is."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from harness import rms
from scipy.spatial.transform import Rotation
from tracker_head import Head

from magfusion.units import DEGREE, Array


def piped(site: Path, given: bytes, *options: str) -> tuple[list[dict[str, Any]], float]:
    """Return the states that the pipe gives, and the processor time that it took (s)."""
    command = [sys.executable, "-m", "magfusion", "navigate", "-", "--site", str(site)]
    with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as sink:
        source.write(given)
        source.seek(0)
        process = subprocess.Popen(
            [*command, "--estimator", "ekf", *options], stdin=source, stdout=sink
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(process.returncode)
        sink.seek(0)
        states = [json.loads(line) for line in sink]
    return [s for s in states if s["started"]], usage.ru_utime + usage.ru_stime


def errors(states: list[dict[str, Any]], head: Head, begin: float, end: float) -> Array:
    """Return the RMS errors of the states of a stretch: position (mm), attitude (deg)."""
    some = [s for s in states if begin <= s["time"] < end and not s["lost"]]
    if not some:
        return np.full(2, np.inf)
    time = np.array([s["time"] for s in some])
    place = np.array([s["position"] for s in some]) - head.place(time)
    quaternion = np.array([s["quaternion"] for s in some])
    turn = head.turn(time).inv() * Rotation.from_quat(quaternion, scalar_first=True)
    return np.array([1e3 * rms(np.linalg.norm(place, axis=1)), rms(turn.magnitude() / DEGREE)])


def nees(states: list[dict[str, Any]], head: Head) -> float:
    """Return the mean squared error of poses, each component in units of its sigma."""
    time = np.array([s["time"] for s in states])
    sigma = np.array([[s["sigma"]["position"], s["sigma"]["rotation_body"]] for s in states])
    place = np.array([s["position"] for s in states]) - head.place(time)
    quaternion = np.array([s["quaternion"] for s in states])
    turn = head.turn(time).inv() * Rotation.from_quat(quaternion, scalar_first=True)
    return float(np.mean(np.sum((np.stack([place, turn.as_rotvec()], 1) / sigma) ** 2, (1, 2))))
