"""Coils whose current wanders, recorded with the field: the value of a reference.

A walk among the demo's beacons, whose amplifiers sag with the mains and hunt, and whose oscillators
run apart from the log's clock.  Their currents are recorded by the instrument that records the
field.  The walk is smoothed, and navigated by the filter, with the currents; then without them; and
one of steady currents on the log's clock is given for comparison.

The rule, stated before the run: with the currents errors are within 1.3 of those of steady ones,
and the verdict is trustworthy.
"""

from dataclasses import dataclass, replace

import numpy as np
from both_estimators import Row, rows_of, table
from harness import conclude, scenario_parser

from magfusion.estimation.demodulation.drive_reference import with_drives
from magfusion.model.drive import DriveSamples
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import Drives
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import Array

CURRENT = 2.0  # A
NOISE = 1e-3  # A, of a sample
SAG, HUNT = 0.12, 0.03  # of the current
DRIFT = 30e-6  # one sigma, of an oscillator beside the log's clock


@dataclass(frozen=True)
class Config:
    """What is simulated."""

    duration: float = 60.0  # s
    seed: int = 3


def with_currents(site: Site) -> Site:
    """Return a site that declares for which current its moments hold."""
    beacons = tuple(
        replace(b, coils=tuple(replace(c, current=CURRENT) for c in b.coils)) for b in site.beacons
    )
    return replace(site, beacons=beacons)


def _envelope(time: Array, rng: np.random.Generator) -> Array:
    """Return a current as a share of the declared one."""
    fall = rng.uniform(0.5, 1.0) * SAG / (1.0 + np.exp(-(time - rng.uniform(5.0, 20.0))))
    return 1.0 - fall + HUNT * np.sin(2.0 * np.pi * rng.uniform(0.1, 0.4) * time)


def wandering_log(config: Config, *, steady: bool) -> Log:
    """Return a walk with its currents; steady ones are on the log's clock."""
    rng = np.random.default_rng([config.seed, 1])
    site = demo_site()
    plan = SimulationConfig(DEMO_BOX_WORLD, duration=config.duration, perturb=False)
    without = replace(site, beacons=())
    simulated = simulate_log(without, plan, np.random.default_rng(config.seed))
    log, wave = simulated.log, simulated.log.waveform
    assert wave is not None
    sensor = replace(site.platform.magnetometer, noise_density=1e-18, offset=np.zeros(3))
    quiet = replace(
        without, platform=replace(site.platform, magnetometer=sensor), earth_field_world=None
    )
    measured, time, current = wave.measured_sensor.copy(), wave.time, {}
    rate = 1.0 / float(np.median(np.diff(time)))
    for beacon in site.beacons:
        phase = np.full(len(beacon.tones), 0.0 if steady else rng.uniform(-np.pi, np.pi))
        drift = 0.0 if steady else rng.normal(0.0, DRIFT)
        share = np.ones_like(time) if steady else _envelope(time, rng)
        alone, drives = replace(quiet, beacons=(beacon,)), Drives(phase, np.array([drift]))
        own = simulate_waveform(simulated.motion, alone, drives, rate, config.duration, rng)
        measured += share[:, None] * own.measured_sensor
        current[beacon.name] = share * _current(beacon, time, float(phase[0]), drift)
        current[beacon.name] += rng.normal(0.0, NOISE, len(time))
    return replace(
        log, waveform=replace(wave, measured_sensor=measured), drive=DriveSamples(time, current)
    )


def _current(beacon: Beacon, time: Array, phase: float, drift: float) -> Array:
    """Return the current through the first coil at its declared amplitude (A)."""
    rotated = 2.0 * np.pi * beacon.frequency_hz * (1.0 + drift) * time
    return CURRENT * np.cos(rotated + phase + beacon.coils[0].phase)


def run(config: Config) -> list[Row]:
    """Estimate with steady currents, with recorded ones, and without a record of them."""
    wandering = wandering_log(config, steady=False)
    alone = replace(
        demo_site(), beacons=tuple(replace(b, synchronised=False) for b in demo_site().beacons)
    )
    cases = {
        "steady": (replace(wandering_log(config, steady=True), drive=None), demo_site()),
        "recorded": with_drives(wandering, with_currents(demo_site())),
        "not recorded": (replace(wandering, drive=None), alone),
    }
    return [row for name, case in cases.items() for row in rows_of(name, *case)]


def main() -> None:
    """Print the errors with and without a record of the currents."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--duration", type=float, default=Config.duration, help="of the walk (s)")
    given = parser.parse_args()
    rows = run(Config(given.duration, given.seed))
    conclude(table("currents", rows), rows)


if __name__ == "__main__":
    main()
