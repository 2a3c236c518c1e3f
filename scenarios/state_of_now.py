"""How good the state of now is: each estimate carried by the inertial samples until the next.

A state of an epoch is that of the middle of its window: of a quarter of a second ago and more.
Kept until now it errs by what the platform has moved; carried by every inertial sample it errs by
what these drift.  Along logs as they came, replayed in pieces of 50 ms: errors of the states that
are a quarter of a second from their epoch, kept and propagated, the mean NEES of all propagated
ones, what one of them costs, and, with ``--pipe``, how old it is when ``magfusion navigate -`` has
written it.
"""

import json
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from harness import conclude, scenario_parser

from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.state_of_now import PropagatedState
from magfusion.files.open import open_log
from magfusion.files.site import load_site, save_site
from magfusion.files.stream import json_line
from magfusion.files.stream_contents import imu_content, magnetometer_content
from magfusion.jobs.replay import Replay
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Risk
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import DEGREE, Array

AGE = (0.225, 0.275)  # s since the epoch
ESTIMATORS = ("ekf", "smoother")
PIPED = 20.0  # s


@dataclass(frozen=True)
class Config:
    """What is navigated.

    Parameters
    ----------
    logs : tuple of Path
        Recorded logs with a truth and a site; without any, one is simulated.
    end : float, optional
        Only so much of each (s).
    """

    logs: tuple[Path, ...] = ()
    duration: float = 60.0  # s, of the simulated log
    end: float | None = None
    pipe: bool = False
    seed: int = 1


def simulated(config: Config) -> tuple[str, Log, Site]:
    """Return a walk among the demo's beacons, which are known exactly."""
    site, none = demo_site(coil_radius=None), np.zeros(3)
    sensor = replace(
        site.platform.magnetometer, sigma=MagnetometerSigma(np.zeros((3, 3)), none, none, none)
    )
    imu = replace(site.platform.imu, time_offset_sigma=0.0)
    known = BeaconSigma(none, none, np.zeros(2))
    site = replace(
        site,
        model_error=1e-5,
        beacons=tuple(replace(beacon, sigma=known) for beacon in site.beacons),
        platform=replace(site.platform, imu=imu, magnetometer=sensor),
    )
    plan = SimulationConfig(DEMO_BOX_WORLD, config.duration, perturb=False)
    return "simulated", simulate_log(site, plan, np.random.default_rng(config.seed)).log, site


def errors_at(states: list[PropagatedState], truth: Trajectory) -> dict[str, float]:
    """Return errors of states (mm, deg) and their NEES."""
    result = trajectory_errors(as_trajectory(list(states)), truth)
    assert result.nees is not None
    return {
        "position_mm": 1e3 * result.ate,
        "attitude_deg": result.attitude_rmse_deg,
        "nees": float(np.mean(result.nees)),
    }


def held_errors(states: list[PropagatedState], truth: Trajectory) -> dict[str, float]:
    """Return the motion of the truth since the epoch (mm, deg): the error of a constant state."""
    at = np.array([s.time for s in states])
    inside = (at > truth.time[0]) & (at < truth.time[-1])
    before = np.array([s.epoch for s in states])[inside]
    now, then = (
        np.stack([np.interp(when, truth.time, axis) for axis in truth.position_world.T])
        for when in (at[inside], before)
    )
    rows = [
        np.clip(np.searchsorted(truth.time, t), 0, len(truth) - 1) for t in (at[inside], before)
    ]
    rotated = np.einsum("nij,nkj->nik", *(truth.world_from_body[r] for r in rows))
    angle = np.arccos(np.clip(0.5 * (np.trace(rotated, axis1=1, axis2=2) - 1.0), -1.0, 1.0))
    moved = np.sum((now - then) ** 2, axis=0)
    return {
        "held_position_mm": 1e3 * float(np.sqrt(np.mean(moved))),
        "held_attitude_deg": float(np.sqrt(np.mean(angle**2))) / DEGREE,
    }


def propagated(
    log: Log, site: Site, estimator: str, *, levels: bool
) -> tuple[list[PropagatedState], float]:
    """Return the states of now along a log, and the processor time that they took (s)."""
    settings = NavigatorSettings(
        "ekf" if estimator == "ekf" else "smoother", rate="imu", risk=Risk() if levels else None
    )
    navigator, states, spent = Navigator(site, settings), [], 0.0
    replay = Replay(log)
    for k in range(len(replay)):
        piece = replay.piece(k)
        imu = piece.imu
        began = time.process_time()
        if len(imu):
            navigator.propagate_imu(imu.time, imu.gyro_body, imu.accel_body)
        states += navigator.take_propagated()
        spent += time.process_time() - began
        navigator.advance()
        if piece.waveform is not None:
            navigator.add_magnetometer(piece.waveform.time, piece.waveform.measured_sensor)
        for samples in piece.fields:
            navigator.add_fields(samples)
        navigator.take()
        navigator.take_lagged()
    return [s for s in states if not s.is_lost], spent


def pipe_ages(log: Log, site: Path, seconds: float) -> Array:
    """Return how old each state is when it is read from the pipe (s), fed sample by sample."""
    command = [sys.executable, "-m", "magfusion", "navigate", "-", "--site", str(site)]
    command += ["--estimator", "ekf", "--rate", "imu"]
    pipe = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert pipe.stdin is not None
    assert pipe.stdout is not None
    read: list[tuple[float, float]] = []
    lines = pipe.stdout

    def listen() -> None:
        for line in lines:
            now, state = time.perf_counter(), json.loads(line)
            if state.get("carried_s", 0.0) > 0.0:
                read.append((now, state["time"]))

    listener = threading.Thread(target=listen)
    listener.start()
    sent: list[tuple[float, float]] = []
    wave = log.waveform
    assert wave is not None
    first = log.imu.time[0]
    rows, fed = np.flatnonzero(log.imu.time < first + seconds), 0
    time.sleep(3.0)  # until it has started
    began = time.perf_counter()
    for k in rows.tolist():
        due = began + (log.imu.time[k] - first)
        time.sleep(max(due - time.perf_counter(), 0.0))
        own = slice(k, k + 1)
        one = ImuSamples(log.imu.time[own], log.imu.gyro_body[own], log.imu.accel_body[own])
        sent.append((time.perf_counter(), float(one.time[0])))
        pipe.stdin.write(json_line(imu_content(one)))
        come = int(np.searchsorted(wave.time, one.time[0]))
        if come > fed:
            part = type(wave)(wave.time[fed:come], wave.measured_sensor[fed:come])
            pipe.stdin.write(json_line(magnetometer_content(part)))
            fed = come
        pipe.stdin.flush()
    pipe.stdin.close()
    listener.join()
    pipe.wait()
    stamps = np.array([stamp for _, stamp in sent])
    nearest = [int(np.argmin(np.abs(stamps - when))) for _, when in read]
    return np.array([now - sent[k][0] for k, (now, _) in zip(nearest, read, strict=True)])


def run(config: Config) -> dict[str, object]:
    """Return the figures of every log, by estimator."""
    figures: dict[str, object] = {}
    logs = [
        (p.name, open_log(p, None, config.end), load_site(p / "site.yaml")) for p in config.logs
    ]
    for name, log, site in logs or [simulated(config)]:
        assert log.truth is not None
        for estimator in ESTIMATORS:
            states, spent = propagated(log, site, estimator, levels=False)
            aged = [s for s in states if AGE[0] <= s.time - s.epoch <= AGE[1]]
            own = errors_at(aged, log.truth) | held_errors(aged, log.truth)
            own["nees"] = errors_at(states, log.truth)["nees"]
            own |= {"states": float(len(states)), "ms_a_state": 1e3 * spent / len(states)}
            figures |= {f"{name}, {estimator}, {key}": value for key, value in own.items()}
        if config.pipe:
            with TemporaryDirectory() as directory:
                save_site(site, Path(directory) / "site.yaml")
                age = pipe_ages(log, Path(directory) / "site.yaml", PIPED)
            for share in (50, 90, 99):
                figures[f"{name}, pipe_age_p{share}_ms"] = 1e3 * float(np.percentile(age, share))
    return figures


def report(figures: dict[str, object]) -> str:
    """Return the table that a reader sees."""
    lines = ["propagated 0.25 s from the epoch (kept); mean NEES of all; cost of a state"]
    names = dict.fromkeys(key.rpartition(", ")[0] for key in figures if key.count(", ") == 2)
    for name in names:
        own = {key: figures[f"{name}, {key}"] for key in _SHOWN}
        lines.append(
            "{0:<28}{position_mm:6.2f} mm {attitude_deg:6.3f} deg ({held_position_mm:.0f} mm,"
            " {held_attitude_deg:.1f} deg); NEES {nees:.2f}; {ms_a_state:.3f} ms".format(
                name, **own
            )
        )
    lines += [f"{key}: {value:.1f}" for key, value in figures.items() if "pipe_age" in key]
    return "\n".join(lines)


_SHOWN = (
    "position_mm",
    "attitude_deg",
    "held_position_mm",
    "held_attitude_deg",
    "nees",
    "ms_a_state",
)


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("logs", nargs="*", type=Path, help="logs with truth and site")
    parser.add_argument("--duration", type=float, default=Config.duration)
    parser.add_argument("--end", type=float)
    parser.add_argument("--pipe", action="store_true", help="measure the age in a pipe, 20 s")
    options = parser.parse_args()
    config = Config(tuple(options.logs), options.duration, options.end, options.pipe, options.seed)
    figures = run(config)
    conclude(report(figures), figures)


if __name__ == "__main__":
    main()
