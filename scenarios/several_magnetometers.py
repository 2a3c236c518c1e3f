"""Two magnetometers 25 cm apart, of unequal clocks, responses, mountings, against each alone.

A walk among four beacons whose fields are bent by half a per cent, much the same within half a
metre.  The magnetometers' matrices, mountings, places and the second one's clock are drawn from
what the site declares of them.  Smoothed and filtered with both, and with each as if the other were
not there, with noise and model error as found in the log, or as declared; fixed with the clock
known, at instants that they share.  Then the second is mounted eight degrees otherwise than the
site declares: which is named?  Last, the raw samples of both (`several_piped`), smoothed,
navigated, and through the pipe.
"""

from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation
from several_piped import raw_errors
from several_piped import walked as walked_raw

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.data_checks.magnetometers import of_sensors
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.integrity.magnetometer_exclusion import agreed
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.fields import on_log_clock, side_by_side
from magfusion.jobs.replay import Replay, feed
from magfusion.model.parameters import initial_calibration
from magfusion.model.response import AxisResponses, FrequencyResponse
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import MagnetometerSigma, Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.disturbance import Bending, draw_bending
from magfusion.simulation.log import (
    SimulatedLog,
    SimulationConfig,
    simulate_fields,
    simulate_log,
)
from magfusion.units import DEGREE

BOX = np.array([[1.0, 1.0, 0.5], [4.0, 3.0, 1.5]])  # m
RATES = (10.0, 7.0)  # Hz
NOISE, WINDOW, EDGE = 2e-10, 0.1, 0.5  # T, s, s
CLOCK, CLOCK_SIGMA = 0.004, 4e-4  # s
MISTAKE = 8.0  # deg
WHICH = {"both": [0, 1], "left alone": [0], "right alone": [1]}


@dataclass(frozen=True)
class Row:
    """Root mean squares over all walks."""

    estimator: str
    magnetometers: str
    position_mm: float
    attitude_deg: float
    nees: float


def declared() -> Site:
    """Return the site with both magnetometers."""
    site = demo_site(coil_radius=None)
    known = replace(
        site.platform.magnetometer,
        sigma=MagnetometerSigma(
            matrix=np.full((3, 3), 0.003),
            offset=np.zeros(3),
            rotation_sensor=np.full(3, 0.5 * DEGREE),
            position_body=np.full(3, 0.002),
        ),
    )
    frequency_hz = np.array([5.0, 20.0, 60.0])

    def axis(gain: float, lag: float) -> FrequencyResponse:
        falling = gain ** np.arange(3.0)
        return FrequencyResponse(frequency_hz, falling, -lag * np.arange(3.0))

    remaining = replace(known, name="left", position_body=np.array([0.125, 0.0, 0.0]))
    right = replace(
        known,
        name="right",
        position_body=np.array([-0.125, 0.0, 0.0]),
        body_from_sensor=Rotation.from_euler("xyz", (57, 115, 23), degrees=True).as_matrix(),
        matrix=np.diag([1.1, 0.9, 1.0]),
        response=AxisResponses(axis(0.95, 0.1), axis(0.8, 0.4), axis(0.9, 0.2)),
        clock_offset=CLOCK,
        sigma=replace(known.sigma, clock_offset=CLOCK_SIGMA),
    )
    return replace(site, platform=site.platform.with_magnetometers((remaining, right)))


def only(site: Site, kept: list[int]) -> Site:
    """Return the site of some of its magnetometers."""
    sensors = tuple(site.platform.magnetometers[k] for k in kept)
    return replace(site, platform=site.platform.with_magnetometers(sensors))


def recorded(walk: SimulatedLog, bending: Bending, which: int, at: Trajectory) -> FieldSamples:
    """Return the phasors of one magnetometer as it stamps and refers them."""
    own = only(walk.true_site, [which])
    rng = np.random.default_rng(which)
    result = simulate_fields(own, at, NOISE, rng, walk.drives, WINDOW, bending=bending)
    late = own.platform.magnetometer.clock_offset
    tones = np.concatenate([beacon.tone_frequencies_hz for beacon in own.beacons])
    turn = np.exp(2j * np.pi * tones * late)[:, None]
    return replace(result, time=result.time - late, phasor_sensor=result.phasor_sensor * turn)


def walked(site: Site, duration: float, seed: int) -> tuple[Log, SimulatedLog, Bending]:
    """Return a walk with the phasors of both, each at its own instants."""
    rng = np.random.default_rng(seed)
    walk = simulate_log(site, SimulationConfig(box_world=BOX, duration=duration), rng)
    bending = draw_bending(rng, site.model_error, site.model_error_length, len(site.beacons))
    parts = []
    for which, rate in enumerate(RATES):
        at = np.arange(EDGE + 0.03 * which, duration - EDGE, 1.0 / rate)
        result = recorded(walk, bending, which, walk.motion.trajectory(at))
        parts.append(on_log_clock(result, only(site, [which])))
    fields = side_by_side(parts, site)
    return replace(walk.log, waveforms={}, fields=fields), walk, bending


def fixed(site: Site, walk: SimulatedLog, bending: Bending, kept: list[int]) -> Trajectory:
    """Return fixes at instants that magnetometers share, their clocks known."""
    at = walk.motion.trajectory(np.arange(EDGE, walk.log.imu.time[-1] - EDGE, 0.5))
    parts = [on_log_clock(recorded(walk, bending, k, at), only(walk.true_site, [k])) for k in kept]
    some = only(site, kept)
    known = tuple(
        replace(s, clock_offset=0.0, sigma=replace(s.sigma, clock_offset=0.0))
        for s in some.platform.magnetometers
    )
    some = replace(some, platform=some.platform.with_magnetometers(known))
    samples = side_by_side(parts, some) if len(kept) > 1 else parts[0]
    return fix_epochs(samples, initial_calibration(some, 0.0)).best()


def filtered(log: Log, site: Site) -> Trajectory:
    """Return the states of the filter."""
    navigator, replayed = Navigator(site, NavigatorSettings("ekf")), Replay(log)
    states = []
    for k in range(len(replayed)):
        feed(navigator, replayed.piece(k))
        states += navigator.take()
    return as_trajectory(states)


def run(walks: int, duration: float, seed: int) -> list[Row]:
    """Return the rows of all estimators."""
    site = declared()
    result: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for k in range(walks):
        log, walk, bending = walked(site, duration, seed + k)
        assert log.fields is not None
        for name, kept in WHICH.items():
            one = replace(log, fields=of_sensors(log.fields, site, kept))
            mine = only(site, kept)
            estimates = {
                "fix": fixed(site, walk, bending, kept),
                "smooth": smooth(one, mine).states,
                "as declared": smooth(one, mine, SmootherSettings(tune=False)).states,
                "navigate (ekf)": filtered(one, mine),
            }
            for estimator, states in estimates.items():
                errors = trajectory_errors(states, walk.motion.trajectory(states.time))
                assert errors.nees is not None
                own = errors.ate, errors.attitude_rmse_deg, float(np.mean(errors.nees))
                result.setdefault((estimator, name), []).append(own)
    rows = []
    for (estimator, name), values in result.items():
        position, attitude, nees = np.array(values).T
        rows.append(Row(estimator, name, 1e3 * rms(position), rms(attitude), float(np.mean(nees))))
    return sorted(rows, key=lambda row: row.estimator)


def run_raw(walks: int, duration: float, seed: int) -> tuple[list[Row], float]:
    """Return the rows of raw samples, and how far pipe and log are apart at most (m)."""
    site, separate = declared(), 0.0
    result: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for k in range(walks):
        errors, far = raw_errors(walked_raw(site, BOX, duration, seed + k), site)
        separate = max(separate, far)
        for key, one in errors.items():
            result.setdefault(key, []).append((one.position_mm, one.attitude_deg, one.nees))
    rows = []
    for (estimator, name), values in result.items():
        position, attitude, nees = np.array(values).T
        rows.append(Row(estimator, name, rms(position), rms(attitude), float(np.mean(nees))))
    return rows, separate


def named(duration: float, seed: int) -> list[str]:
    """Return the findings where the second is not mounted as declared."""
    site = declared()
    log, _, _ = walked(site, duration, seed)
    remaining, right = site.platform.magnetometers
    turn = Rotation.from_euler("x", MISTAKE, degrees=True).as_matrix()
    wrong = replace(right, body_from_sensor=right.body_from_sensor @ turn)
    site = replace(site, platform=site.platform.with_magnetometers((remaining, wrong)))

    def solve(log: Log, site: Site) -> Smoothed:
        return smooth(log, site, SmootherSettings(tune=False))

    result = agreed(smooth(log, site), log, site, solve, solve)
    return [finding.text for finding in result.findings]


def main() -> None:
    """Run the scenario."""
    parser = scenario_parser(__doc__, 1, "one short walk", None)
    options = parser.parse_args()
    walks, duration = (1, 12.0) if options.quick else (3, 20.0)
    raw, separate = run_raw(walks, duration, options.seed)
    rows = [*run(walks, duration, options.seed), *raw]
    lines = [f"{'':30}{'':14}{'position':>12}{'attitude':>12}{'mean NEES':>12}"]
    lines += [
        f"{r.estimator:30}{r.magnetometers:14}{r.position_mm:9.2f} mm{r.attitude_deg:8.3f} deg"
        f"{r.nees:12.1f}"
        for r in rows
    ]
    lines.append(f"The states of the pipe are those of the log within {separate:.1e} m.")
    findings = named(duration, options.seed)
    conclude("\n".join([*lines, *findings]), {"rows": rows, "said": findings, "apart_m": separate})


if __name__ == "__main__":
    main()
