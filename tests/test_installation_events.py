"""What happens to an installation within days: hum, heat, settlement and exchange."""

import numpy as np
import pytest

from magfusion.jobs.drift_conditions import NOON, declared_site, endurance_config
from magfusion.jobs.drift_events import event_of
from magfusion.jobs.drift_world import WorldTask
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.drift import Wander
from magfusion.simulation.endurance import draw_endurance
from magfusion.simulation.events import Events, Exchange, Hum, Settlement, draw_events
from magfusion.units import DAY, HOUR

SITE = demo_site()
EDGES = 60.0 * np.arange(1441.0)


def _drawn(events: Events, seed: int = 1):
    return draw_events(events, SITE, EDGES, np.random.default_rng(seed))


def test_hum_is_what_a_lock_in_takes_from_a_sine() -> None:
    drawn = _drawn(Events(hum=Hum(amplitude=1e-7, wander=Wander(0.3, 300.0))))
    tones_hz, window, middle = np.array([20.0, 35.0]), 0.4, 1234.5
    frequency_hz = np.interp(middle, drawn.hum_time, drawn.hum_frequency_hz)
    time = middle + window * (np.arange(40_000) + 0.5) / 40_000 - 0.5 * window
    turns = 2.0 * np.pi * frequency_hz * time + drawn.hum_phase
    wave = 1e-7 * np.cos(turns)
    carrier = np.exp(-2j * np.pi * tones_hz[:, None] * (time - middle))
    expected = 2.0 * np.mean(wave * carrier, axis=1)
    seen = drawn.hum(np.array([middle]), tones_hz, window)[0]
    along = seen @ drawn.hum_direction_world
    np.testing.assert_allclose(along, expected, rtol=1e-5, atol=1e-15)
    np.testing.assert_allclose(seen, along[:, None] * drawn.hum_direction_world, rtol=1e-9, atol=0)


def test_one_beacon_sinks_or_all_do() -> None:
    for whole in (False, True):
        drawn = _drawn(Events(settlement=Settlement(per_day=1e-3, whole=whole)))
        after = drawn.site_at(SITE, 2.0 * DAY)
        sunk = [
            new.position_world - old.position_world
            for new, old in zip(after.beacons, SITE.beacons, strict=True)
        ]
        expected = np.zeros((4, 3))
        expected[slice(None) if whole else drawn.beacon, 2] = -2e-3
        np.testing.assert_allclose(sunk, expected, rtol=0, atol=1e-12)


def test_a_beacon_is_another_one_after_its_exchange() -> None:
    drawn = _drawn(Events(exchange=Exchange(NOON)))
    before, after = (drawn.site_at(SITE, NOON + t) for t in (-1.0, 0.0))
    changed = [k for k in range(4) if before.beacons[k] != after.beacons[k]]
    assert changed == [drawn.beacon]
    assert before.beacons == SITE.beacons
    assert drawn.constant_since(NOON - 1.0) == 0.0
    assert drawn.constant_since(NOON + 100.0) == NOON


def test_biases_follow_the_day() -> None:
    config = endurance_config("temperature", 48.0, "current", 0.0)
    world = draw_endurance(declared_site("temperature", "current", False), config, (3, 0))
    warmest, coldest = world.events.bias(np.array([14.0, 26.0]) * HOUR).transpose(1, 0, 2)
    np.testing.assert_allclose(warmest, -coldest, rtol=1e-9, atol=0)
    np.testing.assert_allclose(warmest, 10.0 * world.events.bias_per_kelvin, rtol=1e-9, atol=0)


def test_events_do_not_change_what_else_is_drawn() -> None:
    site = declared_site("usual", "current", False)
    usual, exchange = (
        draw_endurance(site, endurance_config(c, 1.0, "current", 0.0), (3, 0))
        for c in ("usual", "exchange")
    )
    a, b = (w.stretch(0, 10, w.start()) for w in (usual, exchange))
    np.testing.assert_array_equal(a.fields.phasor_sensor, b.fields.phasor_sensor)
    np.testing.assert_array_equal(a.imu.accel_body, b.imu.accel_body)


@pytest.mark.parametrize(
    ("condition", "begin", "within"),
    [("exchange", 12.0, 1.0), ("settlement", 0.0, 24.0), ("usual", None, None)],
)
def test_what_is_to_be_reported(condition: str, begin: float, within: float) -> None:
    event = event_of(WorldTask(0, "ekf", 48.0, 1, condition=condition))
    if begin is None:
        assert event is None
    else:
        assert event is not None
        assert (event.begin / HOUR, event.within / HOUR) == (begin, within)
