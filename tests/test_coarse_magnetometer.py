"""A magnetometer with coarse steps, or behind a multiplexer, does not hang; one that hangs does."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.data_checks.samples import (
    clipped_samples,
    false_samples,
    frozen_samples,
    repeated_samples,
)
from magfusion.estimation.integrity.likely_cause import cause_of
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

CHECKS = (frozen_samples, repeated_samples, clipped_samples, false_samples)
STEPS = (0.15e-6, 0.6e-6)  # T
RATE_HZ = 100.0
WEAK = 0.02  # of the demo's moments: fields below the steps


def weak_site(noise: float = 2.5e-10) -> Site:
    """Return the demo's site with weak beacons and a noise density (T/sqrt(Hz))."""
    site, beacons = demo_site(), []
    for beacon in site.beacons:
        coils = tuple(replace(c, moment_beacon=WEAK * c.moment_beacon) for c in beacon.coils)
        beacons.append(replace(beacon, coils=coils))
    sensor = replace(site.platform.magnetometer, noise_density=noise)
    platform = replace(site.platform, magnetometer=sensor)
    return replace(site, beacons=tuple(beacons), platform=platform)


def recorded(motion: str, step: float | None, noise: float = 2.5e-10) -> Log:
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=30.0,
        motion=motion,
        magnetometer_rate_hz=RATE_HZ,
        quantisation=step,
    )
    return simulate_log(weak_site(noise), config, np.random.default_rng(1)).log


def held(log: Log, *spans: tuple[float, float]) -> Log:
    """Return a log whose magnetometer repeats its value from one time to another (s)."""
    assert log.waveform is not None
    value: Array = log.waveform.measured_sensor.copy()
    for begin, end in spans:
        first, last = np.searchsorted(log.waveform.time, [begin, end])
        value[first:last] = value[first]
    return replace(log, waveform=replace(log.waveform, measured_sensor=value))


def codes(log: Log) -> list[str]:
    return [finding.code for check in CHECKS for finding in check(log, weak_site())]


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("noise", [2.5e-10, 5e-9])
@pytest.mark.parametrize("motion", ["walk", "turn"])
def test_values_between_two_steps_are_no_fault(motion: str, noise: float, step: float) -> None:
    assert codes(recorded(motion, step, noise)) == []


def test_an_axis_that_rests_between_two_steps_is_not_dead() -> None:
    log = recorded("static", STEPS[0])
    assert log.waveform is not None
    assert np.min(np.ptp(log.waveform.measured_sensor, axis=0)) == 0.0
    assert codes(log) == []


@pytest.mark.parametrize("span", [(8.0, 9.5), (20.0, 30.0)])
@pytest.mark.parametrize("step", [None, *STEPS])
def test_a_coarse_magnetometer_that_hangs_while_it_turns_is_reported(
    step: float | None, span: tuple[float, float]
) -> None:
    assert "frozen_magnetometer" in codes(held(recorded("turn", step), span))


def test_a_dead_axis_of_a_coarse_magnetometer_is_reported() -> None:
    log = recorded("turn", STEPS[1])
    assert log.waveform is not None
    value = log.waveform.measured_sensor.copy()
    value[:, 1] = 0.0
    dead = replace(log, waveform=replace(log.waveform, measured_sensor=value))
    assert codes(dead) == ["stuck_axis"]


def test_pauses_of_a_multiplexer_are_no_freeze() -> None:
    log = recorded("turn", None)
    pauses = [(begin, begin + 0.3) for begin in np.arange(1.0, 29.0, 1.0).tolist()]
    assert "frozen_magnetometer" not in codes(held(log, *pauses))
    assert "frozen_magnetometer" in codes(held(log, pauses[10]))
    uneven = [(1.0, 1.3), (3.0, 4.1), (9.0, 9.4), (15.0, 15.3), (21.0, 23.0), (26.0, 26.5)]
    assert "frozen_magnetometer" in codes(held(log, *uneven))


@pytest.mark.slow
@pytest.mark.parametrize("step", [None, *STEPS])
def test_fields_distorted_by_steps_are_no_iron(step: float | None) -> None:
    site = demo_site()
    config = SimulationConfig(DEMO_BOX_WORLD, duration=20.0, quantisation=step)
    log = simulate_log(site, config, np.random.default_rng(4)).log
    cause = cause_of(log, site)
    if step is None:
        assert cause is None
        return
    assert cause is not None
    assert cause[0].code == "quantised"
    assert "Choose a smaller range" in cause[1]
