"""Batch, fixed lag and filter on the same logs: what not knowing the future costs.

Every estimator sees the same samples through the same measurement model.  The batch smoother knows
the whole log; the fixed-lag smoother and the error-state filter take it as it comes, from a start
they find themselves.  Where the survey is exact, the filter's position errs by a quarter more
than the batch's, and what leaves the window by hardly more.

Where the survey is wrong by centimetres the comparison requires more than is observable: the
trajectory of a calibrated log is in a frame that the log itself defines, and that frame moves by a
centimetre while the calibration is still being learnt.  The row ``batch up to now`` shows it: it
smooths the log again up to each of some instants and keeps the last state alone: all that was known
by then, in one solution.  An online estimator can be expected to come near it, not to beat it by
much; one log is one draw, and on one of ours they err by less.  The rows ``..., then`` are the
online estimators' states of the same instants.

Who calibrates once and navigates from then on has left that behind: ``..., calibrated`` are the
estimators on the second half of the log, with the site that the smoother made of the first.

Also in the table: the fixes alone, the batch smoother fed with fixes (loose), and every estimator
with the surveyed calibration fixed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from harness import blank_figure, conclude, save_picture, scenario_parser

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.demodulation.demodulation import first_fixes, phasors
from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import TrajectoryErrors, trajectory_errors
from magfusion.results.refinement import result_site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

HELD_CASES = ("phase", "time-offset")  # what no survey gives
PIECE = 0.1  # s, fed at once
FIRST = 8.0  # s; first instant of the batch up to now
ONLINE: dict[Literal["smoother", "ekf"], str] = {"smoother": "fixed lag", "ekf": "filter"}


@dataclass(frozen=True)
class Config:
    """What is compared on what."""

    logs: tuple[Path, ...] = ()
    duration: float = 120.0  # s, of the simulated log where no log is given
    lag: float = 10.0  # s
    instants: int = 16  # of the batch up to now
    seed: int = 3


@dataclass(frozen=True)
class Row:
    """Errors of one estimator: absolute, and after the rigid motion that fits best."""

    log: str
    estimator: str
    position_cm: float
    attitude_deg: float
    aligned_position_cm: float
    aligned_attitude_deg: float
    settled_position_cm: float  # aligned, over the second half alone
    nees: float | None


def pieces(log: Log) -> Iterator[tuple[ImuSamples, Waveform]]:
    """Cut a log into what arrives in each tenth of a second."""
    assert log.waveform is not None
    imu, waveform = log.imu, log.waveform
    first, last = min(imu.time[0], waveform.time[0]), max(imu.time[-1], waveform.time[-1])
    edges = np.arange(first, last + 2.0 * PIECE, PIECE)
    by_imu, by_waveform = (np.searchsorted(t, edges) for t in (imu.time, waveform.time))
    for k in range(len(edges) - 1):
        i, w = (slice(at[k], at[k + 1]) for at in (by_imu, by_waveform))
        yield (
            ImuSamples(imu.time[i], imu.gyro_body[i], imu.accel_body[i]),
            Waveform(waveform.time[w], waveform.measured_sensor[w]),
        )


def online(log: Log, site: Site, settings: NavigatorSettings) -> tuple[Trajectory, Trajectory]:
    """Return the states as they were when they were made, and those that left the window."""
    navigator = Navigator(site, settings)
    built: list[State] = []
    remaining: list[State] = []
    for imu, waveform in pieces(log):
        if len(imu):
            navigator.add_imu(imu.time, imu.gyro_body, imu.accel_body)
        if len(waveform):
            navigator.add_magnetometer(waveform.time, waveform.measured_sensor)
        built += navigator.take()
        remaining += navigator.take_lagged()
    return as_trajectory(built), as_trajectory(remaining)


def part_of(log: Log, begin: float, end: float) -> Log:
    """Return the samples of a log between two times (s)."""
    assert log.waveform is not None
    i = slice(*np.searchsorted(log.imu.time, (begin, end)))
    w = slice(*np.searchsorted(log.waveform.time, (begin, end)))
    return replace(
        log,
        imu=ImuSamples(log.imu.time[i], log.imu.gyro_body[i], log.imu.accel_body[i]),
        waveform=Waveform(log.waveform.time[w], log.waveform.measured_sensor[w]),
    )


def batch_up_to_now(log: Log, site: Site, instants: Array) -> Trajectory:
    """Return the last state of the log smoothed up to each instant."""
    parts = [smooth(part_of(log, -np.inf, float(t)), site).states for t in instants]

    def last(name: str) -> Array:
        return np.stack([getattr(p, name)[-1] for p in parts])

    return Trajectory(
        time=last("time"),
        world_from_body=last("world_from_body"),
        position_world=last("position_world"),
        pose_cov=last("pose_cov"),
    )


def at(result: Trajectory, time: Array) -> Trajectory:
    """Return the states nearest to some times."""
    rows = np.array([np.argmin(np.abs(result.time - t)) for t in time])
    return result.rows(rows)


def row(log: Log, estimator: str, result: Trajectory) -> Row:
    """Return the errors of a trajectory against the log's truth."""
    assert log.truth is not None
    errors = trajectory_errors(result, log.truth)
    middle = 0.5 * (result.time[0] + result.time[-1])
    return Row(
        log=log.name,
        estimator=estimator,
        position_cm=100.0 * errors.ate,
        attitude_deg=errors.attitude_rmse_deg,
        aligned_position_cm=100.0 * errors.aligned_ate,
        aligned_attitude_deg=errors.aligned_attitude_rmse_deg,
        settled_position_cm=100.0 * _of_part(result, log, result.time >= middle).aligned_ate,
        nees=None if errors.nees is None else float(np.mean(errors.nees)),
    )


def _of_part(result: Trajectory, log: Log, part: Array) -> TrajectoryErrors:
    assert log.truth is not None
    return trajectory_errors(result.rows(part), log.truth)


def compare(log: Log, site: Site, config: Config) -> Iterator[Row]:
    """Run every estimator on a log."""
    samples, _ = phasors(log, site)
    calibration = initial_calibration(site, float(np.mean(samples.time)))
    yield row(log, "fixes", first_fixes(samples, log, calibration).best())
    for coupling in ("tight", "loose"):
        result = smooth(log, site, SmootherSettings(coupling=coupling))
        yield row(log, f"batch, {coupling}", result.states)
    fixed = smooth(log, site, SmootherSettings(estimate=HELD_CASES))
    yield row(log, "batch, survey fixed", fixed.states)
    instants = np.linspace(log.imu.time[0] + FIRST, log.imu.time[-1] - 1.0, config.instants)
    best = batch_up_to_now(log, site, instants)
    yield row(log, "batch up to now", best)
    for estimator, label in ONLINE.items():
        for estimate, name in ((None, ""), (HELD_CASES, ", survey fixed")):
            settings = NavigatorSettings(estimator=estimator, lag=config.lag, estimate=estimate)
            now, remaining = online(log, site, settings)
            yield row(log, label + name, now)
            if len(remaining):
                yield row(log, f"{label}, lagged{name}", remaining)
            if estimate is None:
                yield row(log, f"{label}, then", at(now, best.time))
    yield from calibrated(log, site, config)


def calibrated(log: Log, site: Site, config: Config) -> Iterator[Row]:
    """Smooth the first half of a log, and run the estimators on the second as calibrated by it."""
    middle = 0.5 * float(log.imu.time[0] + log.imu.time[-1])
    before = smooth(part_of(log, -np.inf, middle), site)
    known = result_site(before, log.name)
    rest = part_of(log, middle, np.inf)
    yield row(rest, "batch, calibrated", smooth(rest, known).states)
    for estimator, label in ONLINE.items():
        now, remaining = online(rest, known, NavigatorSettings(estimator=estimator, lag=config.lag))
        yield row(rest, f"{label}, calibrated", now)
        if len(remaining):
            yield row(rest, f"{label}, lagged, calibrated", remaining)


def inputs(config: Config) -> Iterator[tuple[Log, Site]]:
    """Return the logs to compare on, with their sites."""
    for path in config.logs:
        yield open_log(path), load_site(path / "site.yaml")
    if not config.logs:
        site = demo_site(coil_radius=None)
        plan = SimulationConfig(DEMO_BOX_WORLD, duration=config.duration)
        yield simulate_log(site, plan, np.random.default_rng(config.seed)).log, site


def report(rows: list[Row]) -> str:
    """Return the table that a reader sees."""
    lines = [
        f"{'':<26}{'absolute':>16}{'aligned':>16}{'2nd half':>10}{'NEES':>7}",
        f"{'':<26}{'cm':>8}{'deg':>8}{'cm':>8}{'deg':>8}{'cm':>10}",
    ]
    for name in dict.fromkeys(r.log for r in rows):
        lines.append(name)
        for r in (r for r in rows if r.log == name):
            nees = "" if r.nees is None else f"{r.nees:7.1f}"
            lines.append(
                f"  {r.estimator:<24}{r.position_cm:8.2f}{r.attitude_deg:8.2f}"
                f"{r.aligned_position_cm:8.2f}{r.aligned_attitude_deg:8.2f}"
                f"{r.settled_position_cm:10.2f}{nees}"
            )
    return "\n".join(lines)


def run(config: Config) -> list[Row]:
    """Compare on every log."""
    return [r for log, site in inputs(config) for r in compare(log, site, config)]


def main() -> None:
    """Print the table and one JSON line; draw where a directory is given."""
    parser = scenario_parser(__doc__, Config.seed)
    parser.add_argument("logs", nargs="*", type=Path, help="with truth and site.yaml")
    parser.add_argument("--lag", type=float, default=Config.lag)
    options = parser.parse_args()
    rows = run(Config(logs=tuple(options.logs), lag=options.lag, seed=options.seed))
    if options.output is not None:
        draw(rows, options.output)
    conclude(report(rows), {"rows": rows})


def draw(rows: list[Row], directory: Path) -> None:
    """Write the table's aligned errors as bars."""
    names = list(dict.fromkeys(r.log for r in rows))
    figure = blank_figure(6.0 * len(names), 5.0)
    for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        own = [r for r in rows if r.log == name][::-1]
        axes.barh([r.estimator for r in own], [r.aligned_position_cm for r in own], color="0.7")
        axes.barh(
            [r.estimator for r in own],
            [r.settled_position_cm for r in own],
            height=0.4,
            color="tab:blue",
        )
        axes.set(title=name, xscale="log", xlabel="position error, aligned (cm)")
    figure.suptitle("grey: the whole log; blue: its second half, when the calibration is known")
    save_picture(figure, directory / "estimators_compared.png", dpi=100)


if __name__ == "__main__":
    main()
