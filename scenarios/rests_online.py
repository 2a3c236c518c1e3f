"""Whole rests as they last: what `navigate --at-rest` knows after a minute, and after half an hour.

A receiver rests 300 m from four beacons, as in `far_and_weak`, and what comes is given to the
estimator second by second.

1. How the pose sharpens while the platform is at rest: error, NEES, and how many times the sigma of
   a phasor is that of the whole rest integrated at once (`--at-rest` of a log).  How much is kept.
2. Storms, and a reference in the stream whose clock is late and runs otherwise: what it takes off,
   compared with the estimate of the whole rest at once; one that ends halfway.
3. What mines do: mains that wander, steel, motors and switches, compared with the whole rest at
   once.
"""

from dataclasses import dataclass, replace

import numpy as np
from far_and_weak import (
    FAR_AWAY,
    LATE,
    RATE,
    STORMS,
    errors_in_sigmas,
    far_site,
    monitored_log,
    pose_error,
    true_phasors,
)
from harness import conclude, rms, scenario_parser
from mine_noise import KINDS, RATE_HZ, SIGMA, Interference, mine_log
from mine_noise import Config as MineConfig
from scipy.spatial.transform import Rotation

from magfusion.estimation.rests.rest_stream import RestNavigator, RestState
from magfusion.estimation.rests.stationary_integration import IntegratedRests, integrate_rests
from magfusion.jobs.navigate_rests import replayed
from magfusion.model.samples import FieldSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array


@dataclass(frozen=True)
class Config:
    """What is simulated."""

    rest: float = 1800.0  # s
    storm: float = 900.0  # s
    mine: float = 600.0  # s
    runs: int = 8
    seed: int = 10


@dataclass(frozen=True)
class Sharpened:
    """What is known after so long."""

    after_s: float
    detected: float  # share of the tones
    position_m: float
    sigma_m: float
    pose_nees: float
    phasor_nees: float
    times_whole: float  # sigma of a phasor, of that of all of it at once; at the end


@dataclass(frozen=True)
class MonitoredRest:
    """What a reference in the stream takes off."""

    name: str
    gain: float  # of the rms error of a phasor, without one
    gain_at_once: float  # of the whole rest at once
    nees: float
    reported: str


@dataclass(frozen=True)
class Mine:
    """Errors with one kind of interference, in units of what white noise alone allows."""

    kind: str
    times_bound: float
    nees: float
    times_bound_at_once: float
    nees_at_once: float


def states_of(log: Log, site: Site) -> tuple[list[RestState], int]:
    """Return the states of a rest, and how many samples are kept in the end."""
    navigator = RestNavigator(site)
    return [one for one in replayed(log, navigator) if one.standing], navigator.kept


def as_rest(samples: FieldSamples) -> IntegratedRests:
    """Return a state's phasors as those of a rest."""
    none = np.zeros((1, len(samples.channels)))
    return IntegratedRests(samples, none, none == 0.0, {})


def pose_of(state: RestState, truth: Trajectory) -> tuple[float, float, float]:
    """Return error and sigma of the position (m), and the NEES of the pose."""
    assert state.fixes is not None
    fixes = state.fixes.fixes
    rotation, cov = fixes.world_from_body[0, 0], fixes.pose_cov[0, 0]
    turn = Rotation.from_matrix(truth.world_from_body[0].T @ rotation).as_rotvec()
    offset = fixes.position_world[0, 0] - truth.position_world[0]
    error = np.concatenate([turn, rotation.T @ offset])
    sigma = float(np.sqrt(np.trace(cov[3:, 3:])))
    return float(np.linalg.norm(offset)), sigma, float(error @ np.linalg.solve(cov, error))


def run_sharpening(config: Config) -> tuple[list[Sharpened], float, list[int]]:
    """Measure rests without storms; return what the whole rest at once errs by, too (m)."""
    site, rows, whole, kept = far_site(), [], [], []
    for seed in range(config.seed, config.seed + config.runs):
        built = monitored_log(site, config.rest, seed, FAR_AWAY, 0.0)
        log = replace(built.log, reference=None)
        at_once = integrate_rests(log, site)
        whole.append(pose_error(at_once, log, site)[0])
        states, count = states_of(log, site)
        kept.append(count)
        sigma = _sigma(at_once.fields)
        for state in states:
            assert state.samples is not None
            own = as_rest(state.samples)
            square = float(np.mean(errors_in_sigmas(own, built)))
            ratio = float(np.median(_sigma(state.samples) / sigma))
            assert log.truth is not None
            pose = (np.nan,) * 3 if state.fixes is None else pose_of(state, log.truth)
            detected = float(np.mean(state.detected))
            rows.append((round(state.duration, -1), detected, *pose, square, ratio))
    table, out = np.array(rows), []
    for after in np.unique(table[:, 0]):
        own = table[table[:, 0] == after]
        mean = np.nanmean(own, axis=0)
        error = rms(own[np.isfinite(own[:, 2]), 2])
        sigma_m = float(np.nanmedian(own[:, 3]))
        out.append(Sharpened(float(after), mean[1], error, sigma_m, mean[4], mean[5], mean[6]))
    return out, rms(np.array(whole)), kept


def _sigma(samples: FieldSamples) -> Array:
    return np.asarray(np.sqrt(np.trace(samples.phasor_cov[0], axis1=1, axis2=2)))


def run_reference(name: str, config: Config, until: float = np.inf) -> MonitoredRest:
    """Measure what a reference takes off, in the stream and at once."""
    site, square, nees, findings = far_site(), [], [], set[str]()
    for seed in range(config.seed, config.seed + config.runs):
        built = monitored_log(site, config.storm, seed, FAR_AWAY, STORMS, LATE, RATE)
        reference = built.log.reference
        assert reference is not None
        there = reference.time < until
        cut = Waveform(reference.time[there], reference.measured_sensor[there])
        log, known = replace(built.log, reference=cut), built.true_site
        states, _ = states_of(log, known)
        last = states[-1].samples
        assert last is not None
        alone = integrate_rests(replace(log, reference=None), known)
        ways = (alone.fields, last, integrate_rests(log, known).fields)
        true = true_phasors(alone, built)
        square.append([np.mean(np.abs(way.phasor_sensor - true) ** 2) for way in ways])
        nees.append(np.mean(errors_in_sigmas(as_rest(last), built)))
        findings |= {finding.code for state in states for finding in state.trust.findings}
    total = np.sqrt(np.mean(square, axis=0))
    codes = ", ".join(sorted(findings))
    gain = total[0] / total[1:]
    return MonitoredRest(name, float(gain[0]), float(gain[1]), float(np.mean(nees)), codes)


def run_in_mine(kind: Interference, config: Config) -> Mine:
    """Measure one kind of interference."""
    square, nees = np.zeros((2, config.runs)), np.zeros((2, config.runs))
    mine = MineConfig(duration=config.mine)
    for k in range(config.runs):
        log, site, phasor = mine_log(kind, mine, config.seed + k)
        states, _ = states_of(log, site)
        last = states[-1].samples
        assert last is not None
        for way, fields in enumerate((last, integrate_rests(log, site).fields)):
            error = fields.phasor_sensor[0] - phasor
            solved = np.linalg.solve(fields.phasor_cov[0], error[..., None])[..., 0]
            square[way, k] = np.mean(np.abs(error) ** 2) / 2.0
            nees[way, k] = np.mean(np.real(np.sum(np.conj(error) * solved, axis=1)))
    bound = SIGMA * np.sqrt(2.0 / (config.mine * RATE_HZ))
    size, mean = np.sqrt(np.mean(square, axis=1)) / bound, np.mean(nees, axis=1)
    name = kind.__name__.replace("_", " ")
    return Mine(name, float(size[0]), float(mean[0]), float(size[1]), float(mean[1]))


def report(
    sharpened: list[Sharpened], whole: float, monitored: list[MonitoredRest], mines: list[Mine]
) -> str:
    """Return the tables."""
    lines = ["at rest  found  position  its sigma  NEES (6)  of phasors  sigma by all at once"]
    for one in sharpened:
        detected = f"{one.after_s:5.0f} s{100.0 * one.detected:6.0f} %{one.position_m:8.2f} m"
        certain = f"{one.sigma_m:9.2f} m{one.pose_nees:10.2f}{one.phasor_nees:12.2f}"
        lines.append(f"{detected}{certain}{one.times_whole:12.2f}")
    lines.append(f"all at once: {whole:.2f} m")
    lines.append("reference            gain of error  at once  NEES (6)")
    for result in monitored:
        gain = f"{result.gain:14.2f}{result.gain_at_once:9.2f}{result.nees:10.2f}"
        lines.append(f"{result.name:20}{gain}  {result.reported}")
    lines.append("mine               times the bound  NEES (6)   at once, times the bound  NEES")
    for mine in mines:
        own = f"{mine.times_bound:15.2f}{mine.nees:10.2f}"
        lines.append(
            f"{mine.kind:19}{own}{mine.times_bound_at_once:20.2f}{mine.nees_at_once:12.2f}"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure rests, storms and mines."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--runs", type=int, default=Config.runs, help="of each kind")
    given = parser.parse_args()
    config = Config(runs=given.runs, seed=given.seed)
    sharpened, whole, kept = run_sharpening(config)
    monitored = [
        run_reference("5 km away", config),
        run_reference("ends halfway", config, 0.5 * config.storm),
    ]
    mines = [run_in_mine(kind, config) for kind in KINDS]
    result = {"sharpened": sharpened, "whole_m": whole, "kept": max(kept)}
    text = report(sharpened, whole, monitored, mines)
    text += f"\nsamples kept at the end of a rest: at most {max(kept)}"
    conclude(text, result | {"witnessed": monitored, "mines": mines})


if __name__ == "__main__":
    main()
