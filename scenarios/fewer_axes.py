"""A magnetometer of three axes, of two and of one on the same walks: what each axis is worth.

Walks among the demo's beacons, calibration drawn from the declared sigmas, raw samples with an
IMU.  Of the same samples all three axes are used, two, and one, by the batch smoother and by the
filter.  Those of one axis are located epoch by epoch, too, as a coil whose roll is unobservable.

The rule, stated before the run, of every set of axes:

1. errors are consistent: the mean NEES over all seeds is at most 9 where 6 are expected (of a coil
   alone, place and direction, 7.5 of 5), and nine in ten epochs are within three sigma;
2. no verdict fails, and none reports a dead axis;
3. of one axis the roll is determined by the IMU (all sigmas of the smoothed attitude below 5 deg
   in the median), and reported as undetermined without it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, rms, scenario_parser

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.demodulation.demodulation import demodulated
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.jobs.fix_coil import find_coil
from magfusion.jobs.replay import Replay, feed
from magfusion.model.progress import quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Trust, Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import DEGREE

SETS = ("xyz", "xy", "z")
EXPECTED, MAX_COUNT = {"fix": 5.0}, 1.5  # numbers of a pose, six but of a coil alone; times these
INSIDE = 0.9
ROLL = 5.0  # deg


@dataclass(frozen=True)
class Row:
    """What an estimator makes of one walk by some axes.

    Parameters
    ----------
    nees : float
        Mean of all epochs.
    inside : float
        Share of the epochs within three sigma.
    sigma_deg : float
        Of the attitude along its worst direction, median of the epochs.
    """

    seed: int
    axes: str
    estimator: str
    position_mm: float
    attitude_deg: float
    nees: float
    inside: float
    sigma_deg: float
    verdict: str
    codes: tuple[str, ...]


def with_axes(log: Log, site: Site, axes: str) -> tuple[Log, Site]:
    """Return a log and its site as of a receiver with some of the axes."""
    assert log.waveform is not None
    own = np.array([axis in axes for axis in "xyz"])
    measured = np.where(own, log.waveform.measured_sensor, 0.0)
    sensor = replace(site.platform.magnetometer, axes=axes)
    wave = replace(log.waveform, measured_sensor=measured, axes=axes)
    site = replace(site, platform=replace(site.platform, magnetometer=sensor))
    return replace(log, waveform=wave), site


def smoothed(log: Log, site: Site) -> tuple[Trajectory, Trust]:
    """Smooth a log."""
    result, trust = judge_result(smooth(log, site, SmootherSettings()), log)
    return result.states, trust


def filtered(log: Log, site: Site) -> tuple[Trajectory, Trust]:
    """Navigate along a log by the filter."""
    navigator, replayed = Navigator(site, NavigatorSettings("ekf")), Replay(log)
    states: list[JudgedState] = []
    for k in range(len(replayed)):
        feed(navigator, replayed.piece(k))
        states += navigator.take()
    return as_trajectory(states), navigator.summary.trust


def row_of(
    seed: int, axes: str, estimator: str, states: Trajectory, trust: Trust, truth: Trajectory
) -> Row:
    """Compare states with the truth."""
    result = trajectory_errors(states, truth)
    assert result.nees is not None
    assert states.pose_cov is not None
    widest = np.sqrt(np.linalg.eigvalsh(states.pose_cov[:, :3, :3])[:, -1])
    return Row(
        seed,
        axes,
        estimator,
        1e3 * rms(np.linalg.norm(result.position_world, axis=1)),
        rms(result.attitude) / DEGREE,
        float(np.mean(result.nees)),
        float(result.inside_3_sigma or 0.0),
        float(np.median(widest)) / DEGREE,
        str(trust.verdict),
        tuple(finding.code for finding in trust.findings),
    )


def rows_of(seed: int, duration: float) -> list[Row]:
    """Return the rows of one walk."""
    declared = demo_site()
    plan = SimulationConfig(DEMO_BOX_WORLD, duration=duration)
    log = simulate_log(declared, plan, np.random.default_rng(seed)).log
    assert log.truth is not None
    rows = []
    for axes in SETS:
        own, site = with_axes(log, declared, axes)
        for name, estimate in (("smooth", smoothed), ("ekf", filtered)):
            states, trust = estimate(own, site)
            rows.append(row_of(seed, axes, name, states, trust, log.truth))
        if len(axes) == 1:
            coil = find_coil(own, demodulated(own, site).fields, site, (), quiet)
            assert coil.log.truth is not None
            best = coil.fixes.best()
            rows.append(row_of(seed, axes, "fix", best, coil.trust, coil.log.truth))
    return rows


def pooled(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Return root mean squares and the mean NEES over the walks, by axes and estimator."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for axes, estimator in dict.fromkeys((row.axes, row.estimator) for row in rows):
        own = [row for row in rows if (row.axes, row.estimator) == (axes, estimator)]
        out.setdefault(axes, {})[estimator] = {
            "position_mm": rms(np.array([row.position_mm for row in own])),
            "attitude_deg": rms(np.array([row.attitude_deg for row in own])),
            "nees": float(np.mean([row.nees for row in own])),
        }
    return out


def faults_of(rows: list[Row]) -> list[str]:
    """Return in what the rule is not kept."""
    faults = []
    for axes, estimator in dict.fromkeys((row.axes, row.estimator) for row in rows):
        own = [row for row in rows if (row.axes, row.estimator) == (axes, estimator)]
        nees, inside = (float(np.mean([getattr(r, k) for r in own])) for k in ("nees", "inside"))
        where = f"{axes} by {estimator}"
        expected = EXPECTED.get(estimator, 6.0)
        if nees > MAX_COUNT * expected:
            faults.append(f"{where}: mean NEES {nees:.2f} of {expected:g}")
        if inside < INSIDE:
            faults.append(f"{where}: {inside:.0%} within three sigma")
        for row in own:
            false = {"stuck_axis", "silent_beacon"} & set(row.codes)
            if row.verdict == str(Verdict.FAILED) or false:
                faults.append(f"{where}, seed {row.seed}: {row.verdict}, {', '.join(row.codes)}")
            if estimator == "fix" and "roll_open" not in row.codes:
                faults.append(f"{where}, seed {row.seed}: the roll is not reported as undetermined")
            if estimator == "smooth" and row.sigma_deg > ROLL:
                faults.append(f"{where}, seed {row.seed}: sigma {row.sigma_deg:.1f} deg")
    return faults


def main() -> None:
    """Run the scenario from the command line."""
    parser = scenario_parser(__doc__, seed=0, quick="one walk of 12 s", output=None)
    parser.add_argument("--seeds", type=int, default=4, help="how many, from --seed")
    options = parser.parse_args()
    count, duration = (1, 12.0) if options.quick else (options.seeds, 40.0)
    rows = [
        r for seed in range(options.seed, options.seed + count) for r in rows_of(seed, duration)
    ]
    faults = faults_of(rows)
    lines = [f"{'axes':6}{'seed':>5} {'estimator':10}{'position':>12}{'attitude':>12}{'NEES':>8}"]
    for row in sorted(rows, key=lambda r: (SETS.index(r.axes), r.estimator, r.seed)):
        errors = f"{row.position_mm:9.2f} mm{row.attitude_deg:8.3f} deg{row.nees:8.2f}"
        lines.append(f"{row.axes:6}{row.seed:5} {row.estimator:10}{errors}  {row.verdict}")
    conclude(
        "\n".join([*lines, *faults, "FAIL" if faults else "pass"]),
        {"rows": rows, "pooled": pooled(rows)},
    )
    if faults:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
