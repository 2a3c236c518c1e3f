"""A beacon that is switched off for a while: its noise is no measurement, in any job."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.data_checks.detection import without_silence
from magfusion.estimation.demodulation.demodulation import demodulated
from magfusion.estimation.integrity.judge import judge_result
from magfusion.model.samples import Waveform
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import synchronised_drives
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.waveform import simulate_waveform

OFF, ON = 6.0, 16.0  # s


@pytest.mark.slow
def test_a_beacon_that_is_off_for_a_while_costs_no_more_than_its_share() -> None:
    site = demo_site()
    config = SimulationConfig(DEMO_BOX_WORLD, duration=24.0)
    simulated = simulate_log(site, config, np.random.default_rng(5))
    log, true = simulated.log, simulated.true_site
    assert log.waveform is not None
    first = replace(true, beacons=true.beacons[:1], earth_field_world=None)
    quiet = replace(true.platform.magnetometer, noise_density=0.0, offset=np.zeros(3))
    first = replace(first, platform=replace(true.platform, magnetometer=quiet))
    time, rng = log.waveform.time, np.random.default_rng(0)
    rate_hz = 1.0 / float(np.median(np.diff(time)))
    drives = synchronised_drives(first)
    own_field = simulate_waveform(simulated.motion, first, drives, rate_hz, 24.0, rng)
    off = (time >= OFF) & (time < ON)
    mixed = log.waveform.measured_sensor - np.where(off[:, None], own_field.measured_sensor, 0.0)
    silent = replace(log, waveform=Waveform(time, mixed))
    fields = demodulated(silent, site).fields
    assert without_silence(fields) is fields  # nothing more is taken
    name = site.beacons[0].name
    own = fields.valid[:, [beacon == name for beacon, _ in fields.channels]].all(axis=1)
    inside = (fields.time > OFF + 0.4) & (fields.time < ON - 0.4)
    outside = (fields.time < OFF - 0.6) | (fields.time > ON + 0.6)
    assert not np.any(own[inside])
    assert np.all(own[outside])
    # The lock-in assumes whole windows of a tone: what is left of it leaks into all others.
    edges = fields.time[:, None] + 0.5 * fields.window[:, None] * np.array([-1.0, 1.0])
    holds = ((edges[:, :1] < [OFF, ON]) & (edges[:, 1:] > [OFF, ON])).any(axis=1)
    assert np.any(holds)
    assert not np.any(fields.valid[holds])
    assert np.all(fields.valid[outside])
    result, trust = judge_result(smooth(silent, site), silent)
    assert [finding.code for finding in trust.reasons] == []
    assert "silent_beacon" in [finding.code for finding in trust.remarks]
    errors = trajectory_errors(result.states, log.truth)
    whole = trajectory_errors(smooth(log, site).states, log.truth)
    assert errors.ate < 2.0 * whole.ate + 0.001  # m
    assert errors.inside_3_sigma is not None
    assert errors.inside_3_sigma > 0.97
