"""A tracker of three wound coils in time slots, navigated live through the pipe.

Raw samples at 20 kHz come from code that shares nothing with the estimators: every turn of every
winding by elliptic integrals, a drive that drifts, steps of a 16-bit converter, mains, the Earth
field, and a head that turns at 100 deg/s, rests and turns again.  `magfusion navigate -` reads
them with an inertial stream as records of 10 ms, and the scenario reports

1. how far its states are from the truth at rest and turning, and how many there are a second;
2. how far those are that it predicts to the instant of a display, 20 ms ahead of the samples;
3. what a second of data takes of a processor once it has begun, and of the start;
4. with ``--plate``, how soon a plate of aluminium that is moved near the head is reported, and
   whether the sigmas hold meanwhile.

``--cycles 480`` has the source drive its coils so often a second; from 625 on, of an own clock, the
converter takes 40 kHz.
"""

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from harness import conclude, rms, scenario_parser
from tracker_head import CHANGE, TURNING, Config, Head
from tracker_pipe import errors, nees, piped
from tracker_plate import PLATE_COMES, plate_fields
from tracker_samples import PIECE, SOURCE_PPM, records, site_text

from magfusion.units import DEGREE

BEGUN = 6.5  # s; from when states are compared
WRONG_SIDE = 0.2  # m; the source is farther away
PLATE_NEAR, PLATE_RUN = 0.01, 18.5  # share of the fields; s


@dataclass(frozen=True)
class Figures:
    """What a run of the pipe gave; errors are root mean squares, of position in mm."""

    states_per_s: float
    rest_mm: float
    rest_deg: float
    turning_mm: float
    turning_deg: float
    ahead_mm: float
    ahead_deg: float
    rest_nees: float
    turning_nees: float
    turned_deg_s: float
    processor_share: float  # seconds of processor for a second of data
    python_ms: float  # a million turns of an empty loop, in the same run


@dataclass(frozen=True)
class SideFigures:
    """Side of the source in the states, where it is not declared."""

    first_s: float  # of the states
    ambiguous: float  # share of the states that say so
    wrong: float  # share that do not, and are on the other side
    mm: float  # of those that do not


@dataclass(frozen=True)
class PlateFigures:
    """What a plate did to a run of the pipe: positions in mm, mean squared errors in variances."""

    largest_share: float  # of the fields
    detected_after_s: float  # it made a hundredth of them
    false_detections: int  # states before
    poses: float  # share of the states that have one while it is there
    nees: float  # of the poses from when it made a hundredth of the fields until it is gone
    error_mm: float
    error_deg: float
    after_mm: float  # two seconds after it has gone
    after_nees: float


def run_near_plate(config: Config) -> PlateFigures:
    """Simulate a head near which a plate is moved, and navigate it through the pipe."""
    given, head = records(config), Head(config)
    with tempfile.TemporaryDirectory() as directory:
        site = Path(directory) / "site.yaml"
        site.write_text(site_text(config))
        states, _ = piped(site, given)
    time = np.arange(0.0, config.duration, 0.02)
    share = plate_fields(head, time)[1]
    near, elapsed = time[share > PLATE_NEAR][[0, -1]]
    findings = [s["time"] for s in states if any(r["code"] == "metal_near" for r in s["reasons"])]
    there = [s for s in states if near <= s["time"] < elapsed]
    posed = [s for s in there if not s["lost"]]
    after = [s for s in states if s["time"] >= elapsed + 2.0 and not s["lost"]]
    return PlateFigures(
        float(np.max(share)),
        next((t for t in findings if t >= near), np.inf) - near,
        sum(t < PLATE_COMES for t in findings),
        len(posed) / len(there),
        nees(posed, head),
        *errors(posed, head, near, elapsed),
        errors(after, head, elapsed, config.duration)[0],
        nees(after, head),
    )


def run_without_hemisphere(config: Config) -> SideFigures:
    """Navigate a head through the pipe where no side of the source is declared."""
    given, head = records(replace(config, hemisphere=False)), Head(config)
    with tempfile.TemporaryDirectory() as directory:
        site = Path(directory) / "site.yaml"
        site.write_text(site_text(replace(config, hemisphere=False)))
        states, _ = piped(site, given)
    certain = [s for s in states if not s["ambiguous"] and not s["lost"]]
    place = np.array([s["position"] for s in certain]).reshape(-1, 3)
    off = np.linalg.norm(place - head.place(np.array([s["time"] for s in certain])), axis=1)
    wrong, result = int(np.sum(off > WRONG_SIDE)), off[off <= WRONG_SIDE]
    return SideFigures(
        states[0]["time"],
        sum(bool(s["ambiguous"]) for s in states) / len(states),
        wrong / len(states),
        1e3 * rms(result) if len(result) else np.inf,
    )


def python_ms() -> float:
    """Return the processor time of a million turns of an empty loop (ms): that of the machine."""
    began = time.process_time()
    for _ in range(1_000_000):
        pass
    return 1e3 * (time.process_time() - began)


def run(config: Config) -> Figures:
    """Simulate one head, and navigate it through the pipe."""
    given, head = records(config), Head(config)
    with tempfile.TemporaryDirectory() as directory:
        site = Path(directory) / "site.yaml"
        site.write_text(site_text(config))
        beginning = b"\n".join(given.splitlines()[: int(BEGUN / PIECE)]) + b"\n"
        _, startup = piped(site, beginning)
        speed = python_ms()
        states, seconds = piped(site, given)
        speed = 0.5 * (speed + python_ms())
        rate = f"{config.rate_hz:g}"
        propagated, _ = piped(site, given, "--rate", rate, "--horizon", str(config.ahead))
    end = config.duration
    rotated = np.linalg.norm(head.rate_body(np.arange(TURNING, end, 0.01)), axis=1)
    reported = [s for s in states if s["time"] >= BEGUN and not s["lost"]]
    resting = [s for s in reported if s["time"] < TURNING - CHANGE]
    moving = [s for s in reported if s["time"] >= TURNING]
    return Figures(
        len(reported) / (end - BEGUN),
        *errors(states, head, BEGUN, TURNING - CHANGE),
        *errors(states, head, TURNING, end),
        *errors(propagated, head, TURNING, end),
        nees(resting, head),
        nees(moving, head),
        rms(rotated) / DEGREE,
        (seconds - startup) / (end - BEGUN),
        speed,
    )


def report(result: Figures) -> str:
    """Return the table that a reader sees."""
    return "\n".join(
        [
            "three wound coils, 0.3 to 0.6 m away",
            f"{'states a second':<32}{result.states_per_s:8.1f}",
            f"{'at rest':<32}{result.rest_mm:8.3f} mm {result.rest_deg:7.3f} deg,"
            f" NEES {result.rest_nees:.2f}",
            f"{'turning, ' + format(result.turned_deg_s, '.0f') + ' deg/s':<32}"
            f"{result.turning_mm:8.3f} mm {result.turning_deg:7.3f} deg,"
            f" NEES {result.turning_nees:.2f}",
            f"{'predicted to the display':<32}{result.ahead_mm:8.3f} mm {result.ahead_deg:7.3f}"
            " deg",
            f"{'processor for a second':<32}{result.processor_share:8.2f} s"
            f" (a million empty turns: {result.python_ms:.0f} ms)",
        ]
    )


def report_of_plate(result: PlateFigures) -> str:
    """Return the printed text of the run near a plate."""
    return "\n".join(
        [
            f"a plate of aluminium makes up to {100 * result.largest_share:.1f} % of the fields",
            f"reported {result.detected_after_s:.2f} s after it made {100 * PLATE_NEAR:g} %;"
            f" before it came, {result.false_detections} states reported so",
            f"{'while it is there':<32}{result.error_mm:8.3f} mm {result.error_deg:7.3f} deg,"
            f" NEES {result.nees:.1f}, poses in {100 * result.poses:.0f} %",
            f"{'after it':<32}{result.after_mm:8.3f} mm, NEES {result.after_nees:.1f}",
        ]
    )


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, quick="four seconds of turning")
    parser.add_argument("--plate", action="store_true", help="only near a moving plate")
    parser.add_argument("--no-hemisphere", action="store_true", help="only without a declared side")
    parser.add_argument("--no-imu", action="store_true", help="without an IMU")
    parser.add_argument("--cycles", type=float, help="of the source, a second; 120 or 60 (1/s)")
    parser.add_argument("--rate", type=float, default=Config.rate_deg_s, help="of turning (deg/s)")
    given = parser.parse_args()
    usual = 60.0 if given.no_imu else Config.rate_hz
    cycles = usual if given.cycles is None else given.cycles
    config = Config(seed=given.seed, rate_deg_s=given.rate, rate_hz=cycles)
    if given.no_hemisphere:
        side = run_without_hemisphere(replace(config, duration=TURNING + 2.0))
        hemisphere_reported = (
            f"first state {side.first_s:.1f} s after the data begin; {100 * side.ambiguous:.0f} %"
            f" are ambiguous, {100 * side.wrong:.1f} % wrong without it; the others err by"
            f" {side.mm:.2f} mm"
        )
        conclude(hemisphere_reported, side)
        return
    if given.plate:
        others = run_near_plate(replace(config, duration=PLATE_RUN, plate=True))
        conclude(report_of_plate(others), others)
        return
    if given.quick:
        config = replace(config, duration=TURNING + 4.0)
    if given.no_imu:
        alone = run(replace(config, inertial=False))
        conclude(report(alone), alone)
        return
    known, searched = run(config), run(replace(config, source_ppm=SOURCE_PPM))
    reported = [report(known), "a clock of its own, slots found in the stream:", report(searched)]
    conclude("\n".join(reported), {"known": known, "searched": searched})


if __name__ == "__main__":
    main()
