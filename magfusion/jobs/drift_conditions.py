"""The conditions of a drift test: what the worlds do, and what their user declares."""

from dataclasses import replace
from typing import Literal

import numpy as np

from magfusion.model.site import Site
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.drift import DailySwing, Drift
from magfusion.simulation.endurance import DAYTIME, SCHEDULE, EnduranceConfig, usual_drift
from magfusion.simulation.events import Events, Exchange, Hum, Settlement, ThermalBias
from magfusion.simulation.inertial import BiasInstability
from magfusion.simulation.motion import Rests
from magfusion.units import DAY, HOUR

Condition = Literal["usual", "temperature", "mains", "exchange", "settlement", "common-settlement"]
NOON = 12.0 * HOUR
# A good MEMS, in addition to the walk declared in the site.
INSTABILITY = BiasInstability(gyro=1e-5, accel=1e-4, time=300.0)
# Declared moment uncertainty (log) of such a drive: heating and drift.
MOMENT_SIGMA = {"current": 0.005, "voltage": 0.08}
OUTDOORS = DailySwing(amplitude=10.0, warmest_time=DAYTIME)  # half of the day's range
STATIC_INTERVAL = 2.0  # s; of the phasors of a static platform, which uses all samples


def endurance_config(
    condition: Condition, hours: float, drive: str, clock_rate: float
) -> EnduranceConfig:
    """Return the configuration of the worlds.

    `drive`: 'current' or 'voltage'. `clock_rate`: relative error of the drives' common clock.
    """
    usual = EnduranceConfig(
        hours=hours, drift=_drift(condition, drive, clock_rate), instability=INSTABILITY
    )
    if condition in ("settlement", "common-settlement"):
        settlement = Settlement(whole=condition == "common-settlement")
        # One walk, in which the navigator starts.
        static = Rests(SCHEDULE.start, SCHEDULE.move, hours * HOUR)
        return replace(
            usual,
            events=Events(settlement=settlement),
            schedule=static,
            window=STATIC_INTERVAL,
            rest_interval=STATIC_INTERVAL,
        )
    events = {
        "usual": Events(),
        "temperature": Events(thermal_bias=ThermalBias(OUTDOORS)),
        "mains": Events(hum=Hum()),
        "exchange": Events(exchange=Exchange(min(NOON, 0.5 * hours * HOUR))),
    }
    return replace(usual, events=events[condition])


def _drift(condition: Condition, drive: str, clock_rate: float) -> Drift:
    usual = usual_drift(drive, clock_rate)
    if condition != "temperature":
        return usual
    return replace(usual, sensor=OUTDOORS, ambient=OUTDOORS)


def declared_site(condition: Condition, drive: str, phase_known: bool) -> Site:
    """Return the site as its user declares it: only the drifts of these worlds.

    A moment has the drift of its gain, and the fading of its coil, in an hour; the only error of
    the field model is the scale that follows the magnetometer's temperature.
    """
    site, drift = demo_site(synchronised=phase_known), _drift(condition, drive, 0.0)
    assert drift.gain is not None
    assert drift.coils is not None
    assert drift.sensor is not None
    wander = drift.gain.rms * np.sqrt(2.0 * HOUR / drift.gain.time_constant)
    fading = drift.fading_per_kelvin * drift.coils.rise * np.sqrt(HOUR / drift.coils.time_constant)
    daily = 0.0
    if drift.ambient is not None:  # its steepest hour
        daily = drift.fading_per_kelvin * drift.ambient.amplitude * 2.0 * np.pi * HOUR / DAY
    beacons = tuple(
        replace(b, sigma=replace(b.sigma, log_moment=np.full(len(b.coils), MOMENT_SIGMA[drive])))
        for b in site.beacons
    )
    return replace(
        site,
        beacons=beacons,
        model_error=drift.scale_per_kelvin * drift.sensor.amplitude,
        clock=replace(site.clock, log_moment_walk=float(np.linalg.norm([wander, fading, daily]))),
    )
