"""A coil that measures amplitudes without sign, over sixteen coils in a floor: the value of signs.

Walks with an IMU over a floor of 4 x 4 coils, 1 m apart; of one axis the phasors are given as they
are, or their amplitudes alone.  The same walk is smoothed, and followed by the filter, with both.

The rule, stated before the run: of amplitudes the mean NEES of all seeds is at most 9 where 6 are
expected, nine in ten epochs are within three sigma, no verdict fails, and the root mean square of
places is at most twice that with signs.
"""

from dataclasses import dataclass, replace

import numpy as np
from fewer_axes import Row, filtered, pooled, row_of, smoothed
from harness import conclude, scenario_parser

from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Beacon, BeaconSigma, Coil, MagnetometerSigma, Site
from magfusion.model.trust import Verdict
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulationConfig, simulate_fields, simulate_log

PITCH, ACROSS, MOMENT = 1.0, 4, 10.0  # m, coils, A m^2
FIRST_HZ, STEP_HZ = 500.0, 20.0
BOX = np.array([[-1.2, -1.2, 0.5], [1.2, 1.2, 1.6]])  # m
HZ, SIGMA, MODEL_ERROR = 10.0, 1e-10, 0.001
MAX_NEES, INSIDE, WORSE = 9.0, 0.9, 2.0


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk with what the coil measured on it."""

    site: Site
    log: Log
    phasors: FieldSamples

    @property
    def amplitudes(self) -> FieldSamples:
        """The same without sign."""
        size = np.abs(self.phasors.phasor_sensor).astype(np.complex128)
        return replace(self.phasors, phasor_sensor=size, signed=False)


def floor() -> Site:
    """Return a site of coils in a floor, and of a receiver with one axis."""
    base = demo_site(coil_radius=None)
    line = PITCH * (np.arange(ACROSS) - 0.5 * (ACROSS - 1))
    none, up = np.zeros(3), np.array([0.0, 0.0, 1.0])
    beacons = [
        Beacon(
            name=f"C{k}",
            position_world=np.array(place),
            world_from_beacon=np.eye(3),
            frequency_hz=FIRST_HZ + STEP_HZ * k,
            coils=(Coil(MOMENT * up, 0.0),),
            synchronised=True,
            sigma=BeaconSigma(none, none, np.zeros(1)),
        )
        for k, place in enumerate([(x, y, 0.0) for x in line for y in line])
    ]
    beacons[0] = replace(beacons[0], hemisphere_beacon=up)
    known = MagnetometerSigma(np.zeros((3, 3)), none, none, none)
    sensor = replace(base.platform.magnetometer, axes="z", sigma=known)
    platform = replace(base.platform, magnetometer=sensor)
    return replace(base, beacons=tuple(beacons), model_error=MODEL_ERROR, platform=platform)


def walk(seed: int, duration: float) -> Walk:
    """Simulate a walk with an IMU, and what the coil measures on it."""
    config = SimulationConfig(BOX, duration=duration, perturb=False)
    built = simulate_log(demo_site(), config, np.random.default_rng(seed))
    site, time = floor(), np.arange(0.5, duration - 0.5, 1.0 / HZ)
    rng = np.random.default_rng([seed, 1])
    fields = simulate_fields(site, built.motion.trajectory(time), SIGMA, rng)
    phasor = np.full_like(fields.phasor_sensor, np.nan)
    phasor[..., 2] = fields.phasor_sensor[..., 2]
    window = np.full(len(time), 1.0 / HZ)
    phasors = replace(fields, phasor_sensor=phasor, axes="z", window=window)
    return Walk(site, replace(built.log, waveform=None), phasors)


def rows_of(seed: int, duration: float) -> list[Row]:
    """Return the rows of one walk."""
    built, rows = walk(seed, duration), []
    assert built.log.truth is not None
    for name, fields in (("phasors", built.phasors), ("amplitudes", built.amplitudes)):
        own = replace(built.log, fields=fields)
        for estimator, estimate in (("smooth", smoothed), ("ekf", filtered)):
            states, trust = estimate(own, built.site)
            rows.append(row_of(seed, name, estimator, states, trust, built.log.truth))
    return rows


def faults_of(rows: list[Row]) -> list[str]:
    """Return in what the rule is not kept."""
    faults = []
    for estimator in ("smooth", "ekf"):
        own = [r for r in rows if (r.axes, r.estimator) == ("amplitudes", estimator)]
        with_signs = [r for r in rows if (r.axes, r.estimator) == ("phasors", estimator)]
        nees, inside = (float(np.mean([getattr(r, k) for r in own])) for k in ("nees", "inside"))
        here, there = (
            float(np.sqrt(np.mean([r.position_mm**2 for r in some]))) for some in (own, with_signs)
        )
        if nees > MAX_NEES:
            faults.append(f"{estimator}: mean NEES {nees:.2f} of 6")
        if inside < INSIDE:
            faults.append(f"{estimator}: {inside:.0%} within three sigma")
        if here > WORSE * there:
            faults.append(f"{estimator}: {here:.2f} mm, and {there:.2f} mm with signs")
        faults += [
            f"{estimator}, seed {r.seed}: {r.verdict}, {', '.join(r.codes)}"
            for r in own
            if r.verdict == str(Verdict.FAILED)
        ]
    return faults


def main() -> None:
    """Run the scenario from the command line."""
    parser = scenario_parser(__doc__, seed=0, quick="one walk of 8 s", output=None)
    parser.add_argument("--seeds", type=int, default=4, help="how many, from --seed")
    options = parser.parse_args()
    count, duration = (1, 8.0) if options.quick else (options.seeds, 20.0)
    rows = [r for k in range(count) for r in rows_of(options.seed + k, duration)]
    faults = faults_of(rows)
    lines = [f"{'':12}{'seed':>5} {'by':8}{'position':>12}{'attitude':>12}{'NEES':>8}"]
    for row in sorted(rows, key=lambda r: (r.axes, r.estimator, r.seed)):
        errors = f"{row.position_mm:9.2f} mm{row.attitude_deg:8.3f} deg{row.nees:8.2f}"
        lines.append(f"{row.axes:12}{row.seed:5} {row.estimator:8}{errors}  {row.verdict}")
    conclude(
        "\n".join([*lines, *faults, "FAIL" if faults else "pass"]),
        {"rows": rows, "pooled": pooled(rows)},
    )
    if faults:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
