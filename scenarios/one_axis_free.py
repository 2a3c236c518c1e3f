"""A coil of one axis, moved by hand over sixteen coils in a floor, and no IMU.

The roll about the coil, 6 cm from the body's origin, is unobservable.  `smooth` and the
filter follow the coil by a motion prior, and of every state they open the roll, and with it the
body's place on its circle about the coil.

The rule, stated before the run: the mean NEES of place and direction over all seeds is at most 7.5
where 5 are expected, nine in ten epochs are within three sigma, no verdict fails, the roll is
reported to be open, and no state calls it known to better than 1.5 rad.
"""

from dataclasses import replace

import numpy as np
from fewer_axes import Row, filtered, row_of, smoothed
from harness import conclude, scenario_parser
from unsigned_amplitudes import BOX, SIGMA, floor

from magfusion.estimation.online_integrity.open_roll import (
    comparable,
    roll_findings,
    with_open_roll,
)
from magfusion.model.one_axis import axis_of
from magfusion.model.platform_motion import NO_IMU, MotionPrior
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Trust, Verdict
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import Rests, random_walk_motion
from magfusion.units import DEGREE

HZ, LEVER = 20.0, (0.05, -0.02, 0.03)  # m
MAX_NEES, INSIDE, MIN_ROLL = 7.5, 0.9, 1.5


def run_free() -> Site:
    """Return the site, of a platform without an IMU that a hand moves."""
    site = floor()
    sensor = replace(site.platform.magnetometer, position_body=np.array(LEVER))
    platform = replace(
        site.platform, imu=NO_IMU, motion_prior=MotionPrior(2.0, 3.0), magnetometer=sensor
    )
    return replace(site, platform=platform)


def moved(site: Site, seed: int, duration: float) -> Log:
    """Simulate a hand, and what the coil measures in it."""
    rng = np.random.default_rng([seed, 2])
    motion = random_walk_motion(rng, duration, BOX, rests=Rests(0.0, duration, 0.0))
    truth = motion.trajectory(np.arange(0.2, duration, 1.0 / HZ))
    fields = simulate_fields(site, truth, SIGMA, rng)
    phasor = np.full_like(fields.phasor_sensor, np.nan)
    phasor[..., 2] = fields.phasor_sensor[..., 2]
    window = np.full(len(truth), 1.0 / HZ)
    own = replace(fields, phasor_sensor=phasor, axes="z", window=window)
    return Log("free", 0, "scenario", ImuSamples.empty(), fields=own, truth=truth)


def reported(log: Log, site: Site, estimator: str) -> tuple[Trajectory, Trust]:
    """Return an estimator's result on a log."""
    if estimator == "ekf":
        return filtered(log, site)
    states, trust = smoothed(log, site)
    return with_open_roll(states, site), trust | Trust(roll_findings(site))


def rows_of(seed: int, duration: float) -> tuple[list[Row], list[str]]:
    """Return the rows of one log, and where its roll is called known."""
    site, rows, faults = run_free(), [], []
    log, axis = moved(site, seed, duration), axis_of(site.platform.magnetometer)
    for estimator in ("smooth", "ekf"):
        states, trust = reported(log, site, estimator)
        truth = comparable(log, states, site).truth
        assert truth is not None
        assert states.pose_cov is not None
        rows.append(row_of(seed, "z", estimator, states, trust, truth))
        roll = np.sqrt(np.einsum("i,nij,j->n", axis, states.pose_cov[:, :3, :3], axis))
        if np.min(roll) < MIN_ROLL:
            faults.append(f"{estimator}, seed {seed}: roll {np.min(roll) / DEGREE:.0f} deg")
    return rows, faults


def faults_of(rows: list[Row]) -> list[str]:
    """Return in what the rule is not kept."""
    faults = []
    for estimator in ("smooth", "ekf"):
        own = [row for row in rows if row.estimator == estimator]
        nees, inside = (float(np.mean([getattr(r, k) for r in own])) for k in ("nees", "inside"))
        if nees > MAX_NEES:
            faults.append(f"{estimator}: mean NEES {nees:.2f} of 5")
        if inside < INSIDE:
            faults.append(f"{estimator}: {inside:.0%} within three sigma")
        faults += [
            f"{estimator}, seed {r.seed}: {r.verdict}, {', '.join(r.codes)}"
            for r in own
            if r.verdict == str(Verdict.FAILED) or "roll_open" not in r.codes
        ]
    return faults


def main() -> None:
    """Run the scenario from the command line."""
    parser = scenario_parser(__doc__, seed=0, quick="one log of 9 s", output=None)
    parser.add_argument("--seeds", type=int, default=4, help="how many, from --seed")
    options = parser.parse_args()
    count, duration = (1, 9.0) if options.quick else (options.seeds, 15.0)
    rows: list[Row] = []
    faults: list[str] = []
    for k in range(count):
        own, known = rows_of(options.seed + k, duration)
        rows, faults = rows + own, faults + known
    faults += faults_of(rows)
    lines = [f"{'seed':>5} {'by':8}{'position':>12}{'attitude':>12}{'NEES':>8}"]
    for row in sorted(rows, key=lambda r: (r.estimator, r.seed)):
        errors = f"{row.position_mm:9.2f} mm{row.attitude_deg:8.3f} deg{row.nees:8.2f}"
        lines.append(f"{row.seed:5} {row.estimator:8}{errors}  {row.verdict}")
    conclude("\n".join([*lines, *faults, "FAIL" if faults else "pass"]), rows)
    if faults:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
