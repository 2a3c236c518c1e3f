"""A magnetometer with coarse steps, or behind a multiplexer, does not hang; one that hangs does."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command

from magfusion.estimation.data_checks.pauses import repeated_samples
from magfusion.estimation.data_checks.samples import (
    clipped_samples,
    false_samples,
    frozen_samples,
)
from magfusion.estimation.integrity.hypothesis_tests import cause_of
from magfusion.estimation.integrity.quick_check import quick_check
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
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
    cause, look = cause_of(log, site), quick_check(log, site)
    if step is None:
        assert cause is None
        assert look.trust.findings == ()
        return
    assert cause is not None
    assert cause[0].code == "quantised"
    assert "Choose a smaller range" in cause[1]
    (noted,) = look.trust.findings
    assert noted.code == "quantised"
    assert noted.text.partition(" by ")[0] == cause[1].partition(" by ")[0]
    assert noted.verdict is Verdict.TRUSTWORTHY  # the bound is above what motion leaves of it


@pytest.mark.slow
def test_navigation_names_steps_before_the_moments_that_they_falsify(tmp_path: Path) -> None:
    """A parameter that absorbs the distortion is estimated, but it is not the cause."""
    site = demo_site()
    config = SimulationConfig(DEMO_BOX_WORLD, duration=20.0, quantisation=STEPS[1])
    write_log(simulate_log(site, config, np.random.default_rng(4)).log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    run_command("navigate", tmp_path / "log", "-o", tmp_path / "run", "--estimator", "ekf")
    reasons = json.loads((tmp_path / "run" / "report.json").read_text())["reasons"]
    assert reasons[0]["code"] == "quantised"
