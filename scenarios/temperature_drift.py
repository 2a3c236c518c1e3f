"""Coils and a magnetometer that warm up: what their temperatures are worth.

A walk among the demo's beacons is simulated, whose coils fade as copper does at a constant voltage
and whose magnetometer changes its matrix and offset.  It is smoothed, and navigated by the filter,
with a site that declares both and with one that does not.
"""

from dataclasses import dataclass, replace

import numpy as np
from both_estimators import Row, rows_of, table
from harness import conclude, scenario_parser

from magfusion.estimation.demodulation.temperature_compensation import at_reference
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.temperature import (
    MAGNETOMETER,
    MomentTemperatureModel,
    SensorTemperatureModel,
    Temperatures,
)
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

PER_K = -3.9e-3  # copper at a constant voltage
MATRIX_PER_K = 1e-4 * np.array([[5.0, 0.3, 0.0], [0.0, -4.0, 0.2], [0.1, 0.0, 3.0]])
OFFSET_PER_K = 1e-9 * np.array([40.0, -25.0, 10.0])  # T/K
REFERENCE, RISE, TIME_CONSTANT = 20.0, 45.0, 10.0  # degrees Celsius, K, s
EVERY = 0.5  # s; between readings


@dataclass(frozen=True)
class Config:
    """What is simulated."""

    duration: float = 60.0  # s
    seed: int = 3


def warmer(time: Array) -> Array:
    """Return by how much the temperature is above that of reference (K)."""
    return -RISE * np.expm1(-time / TIME_CONSTANT)


def temperature_site() -> Site:
    """Return the demo's site with what a temperature changes."""
    site = demo_site()
    sensor = SensorTemperatureModel(MATRIX_PER_K, OFFSET_PER_K, REFERENCE)
    magnetometer = replace(site.platform.magnetometer, temperature_model=sensor)
    return replace(
        site,
        beacons=tuple(
            replace(b, temperature_model=MomentTemperatureModel(PER_K, REFERENCE))
            for b in site.beacons
        ),
        platform=replace(site.platform, magnetometer=magnetometer),
    )


def warm_log(duration: float, seed: int) -> Log:
    """Return a walk during which all became warm, of simulations that know nothing of it."""
    site, sensor = demo_site(), demo_site().platform.magnetometer
    silent = replace(site.platform, magnetometer=replace(sensor, noise_density=1e-18))
    quiet = replace(site, platform=silent)
    config = SimulationConfig(DEMO_BOX_WORLD, duration=duration, perturb=False)
    logs = [
        simulate_log(known, config, np.random.default_rng(seed)).log
        for known in (site, quiet, replace(quiet, beacons=()))
    ]
    waves = [log.waveform for log in logs if log.waveform is not None]
    samples, all_beacons, none = (wave.measured_sensor for wave in waves)
    more = warmer(waves[0].time)[:, None]
    cold = samples + np.expm1(PER_K * more) * (all_beacons - none) - sensor.offset
    grown = cold + more * (cold @ (MATRIX_PER_K @ np.linalg.inv(sensor.matrix)).T)
    wave = replace(waves[0], measured_sensor=grown + sensor.offset + more * OFFSET_PER_K)
    read = np.arange(0.0, duration + EVERY, EVERY)
    parts = [*(beacon.name for beacon in site.beacons), MAGNETOMETER]
    degrees = Temperatures({part: np.stack([read, REFERENCE + warmer(read)]) for part in parts})
    return replace(logs[0], waveform=wave, temperatures=degrees)


def run(config: Config) -> list[Row]:
    """Estimate by both sites."""
    log = warm_log(config.duration, config.seed)
    cases = {"declared": temperature_site(), "not declared": demo_site()}
    return [row for name, site in cases.items() for row in rows_of(name, *at_reference(log, site))]


def main() -> None:
    """Print the errors with and without what is declared."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--duration", type=float, default=Config.duration, help="of the walk (s)")
    given = parser.parse_args()
    rows = run(Config(given.duration, given.seed))
    conclude(table("temperatures", rows), rows)


if __name__ == "__main__":
    main()
