"""Slots of a clock of its own, found in the stream and followed."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from time_slots_and_mains import tracker

from magfusion.errors import InputError
from magfusion.files.site import save_site
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.model.site import Site, Slots
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.receivers import received
from magfusion.receiver.slot_receiver import SlotReceiver
from magfusion.receiver.slot_timing import is_searched, slot_start

SLOTS = Slots(1.0 / 480.0, 4)
RATE_HZ = 20e3


def _free_parameters(carrier_hz: float, slots: Slots = SLOTS) -> Site:
    site = tracker(carrier_hz, slots)
    return replace(site, beacons=(replace(site.beacons[0], synchronised=False),))


def _stream(
    carrier_hz: float,
    start: float,
    ppm: float,
    duration: float,
    signal: float = 1e-7,
    slots: Slots = SLOTS,
) -> Waveform:
    """Return coils that are driven by a clock of their own, in the Earth field and hum."""
    rng = np.random.default_rng(4)
    time = 1.0 + np.arange(int(duration * RATE_HZ)) / RATE_HZ
    own = (time - start) * (1.0 + 1e-6 * ppm)
    slot = np.floor(own / slots.duration).astype(int) % 4
    field = signal * np.vstack([rng.standard_normal((3, 3)), np.zeros((1, 3))])
    driven = field[slot] * np.cos(2.0 * np.pi * carrier_hz * own)[:, None]
    hum = 1.5e-7 * np.cos(2.0 * np.pi * 50.0 * time)[:, None] * [0.6, 0.0, 0.8]
    noise = 3e-9 * rng.standard_normal((len(time), 3))
    return Waveform(time, driven + hum + noise + [2e-5, 1e-5, 4e-5])


def _late(result: float, start: float, slots: Slots = SLOTS) -> float:
    """Return by how much a cycle is found late (s)."""
    return (result - start + 0.5 * slots.cycle) % slots.cycle - 0.5 * slots.cycle


@pytest.mark.parametrize("start", [0.0, 1.3e-3, 5.1e-3, 7.7e-3])
@pytest.mark.parametrize("carrier_hz", [2e3, 6e3])
def test_a_cycle_is_found_under_hum_in_the_earth_field(carrier_hz: float, start: float) -> None:
    result = slot_start(_stream(carrier_hz, start, 0.0, 0.3), _free_parameters(carrier_hz), RATE_HZ)
    assert result is not None
    # A quarter of a carrier's cycle, and a sample.
    assert abs(_late(result, start)) < 0.25 / carrier_hz + 1.0 / RATE_HZ


@pytest.mark.parametrize("cycles_hz", [250.0, 480.0, 500.0, 625.0])
@pytest.mark.parametrize("start", [0.0, 0.7e-3, 1.13e-3])
def test_a_cycle_of_few_whole_samples_is_found(cycles_hz: float, start: float) -> None:
    """Forty samples of every cycle are at the same places of it, and there are none between."""
    slots = Slots(0.25 / cycles_hz, 4)
    waveform = _stream(6e3, start, 0.0, 0.3, slots=slots)
    result = slot_start(waveform, _free_parameters(6e3, slots), RATE_HZ)
    assert result is not None
    assert abs(_late(result, start, slots)) < 0.25 / 6e3 + 1.0 / RATE_HZ


def test_where_no_coil_is_driven_none_is_found() -> None:
    assert (
        slot_start(_stream(6e3, 0.0, 0.0, 0.3, signal=0.0), _free_parameters(6e3), RATE_HZ) is None
    )


@pytest.mark.parametrize(
    ("site", "searched"),
    [
        (tracker(6e3, SLOTS), False),
        (_free_parameters(6e3), True),
        (_free_parameters(0.0), False),  # pulses have no carrier
        (_free_parameters(6e3, Slots(1e-3, 3)), False),  # none is silent
        (_free_parameters(6e3, Slots(1e-3, 6)), True),
    ],
)
def test_only_what_a_stream_can_tell_is_searched(site: Site, searched: bool) -> None:
    assert is_searched(site) is searched


def test_a_clock_that_runs_away_is_followed() -> None:
    site, ppm = _free_parameters(6e3), 100.0
    waveform = _stream(6e3, 2.2e-3, ppm, 4.0)
    time = np.arange(0.9, 5.2, 2e-3)
    imu = ImuSamples(time, np.zeros((len(time), 3)), np.zeros((len(time), 3)))
    receiver, late, parts = SlotReceiver(site), [], []
    receiver.begin(Waveform(waveform.time[:8000], waveform.measured_sensor[:8000]), imu)
    for end in range(8000, len(waveform), 2000):
        come = Waveform(waveform.time[:end], waveform.measured_sensor[:end])
        parts.append(receiver.push(come, imu, float(come.time[-1])))
        assert receiver.grid is not None
        begin = receiver.grid.centre - 0.5 * SLOTS.duration
        now = float(come.time[-1])
        begin += np.round((now - begin) / SLOTS.cycle) * SLOTS.cycle
        own = (begin - 2.2e-3) * (1.0 + 1e-6 * ppm)
        late.append(_late(own, 0.0))
    # In four seconds the clock runs a fifth of a slot away.
    assert np.max(np.abs(late)) < 0.05 * SLOTS.duration
    size = np.concatenate([np.linalg.norm(p.phasor_sensor, axis=2) for p in parts])
    assert np.nanmax(np.nanstd(size, axis=0) / np.nanmean(size, axis=0)) < 0.02


def test_a_whole_log_is_followed_as_a_stream_is() -> None:
    site, ppm = _free_parameters(6e3), 100.0
    waveform = _stream(6e3, 2.2e-3, ppm, 6.0)
    silent = waveform.time < 1.5  # the source is switched on later
    waveform.measured_sensor[silent] = np.array([2e-5, 1e-5, 4e-5]) + 3e-9 * np.sin(
        7e2 * waveform.time[silent, None]
    )
    time = np.arange(0.9, 7.2, 2e-3)
    imu = ImuSamples(time, np.zeros((len(time), 3)), np.zeros((len(time), 3)))
    result, _ = received(waveform, imu, site)
    kept = result.rows(result.time > 2.0)
    size = np.linalg.norm(kept.phasor_sensor, axis=2)
    # In six seconds the clock runs more than a quarter of a slot away.
    assert np.max(np.nanstd(size, axis=0) / np.nanmean(size, axis=0)) < 0.02
    assert np.sum(kept.valid) > 3 * 118 * 5
    epochs = whole_cycles(kept, imu, site)
    assert len(epochs) > 118 * 5
    own = (kept.time[:, None] - 2.2e-3) * (1.0 + 1e-6 * ppm) / SLOTS.duration
    slot = np.floor(own[:, 0]).astype(int) % 4
    assert np.array_equal(np.argmax(kept.valid, axis=1), slot)


def test_pulses_whose_timing_nobody_knows_are_refused() -> None:
    with pytest.raises(InputError, match=r"direct-current pulses by its own clock"):
        SlotReceiver(_free_parameters(0.0)).check()


def test_the_pipe_says_why_there_is_no_state(tmp_path: Path) -> None:
    """A stream has no end at which it could be told."""
    slots = Slots(1.0 / 480.0, 4)
    save_site(tracker(1e3, slots), tmp_path / "site.yaml")
    rate_hz, lines = 2e3, []
    for begin in np.arange(0.0, 8.0, 0.5):
        time = (begin + np.arange(0.0, 0.5, 1.0 / rate_hz)).tolist()
        inertial = (begin + np.arange(0.0, 0.5, 0.01)).tolist()
        gyro, accel = [[0.0, 0.0, 0.01 * (k % 2)] for k in range(50)], [[0.0, 0.0, 9.81]] * 50
        imu = {"time": inertial, "gyro": gyro, "accel": accel}
        field = [[2e-5, 1e-5, 1e-9 * (k % 7)] for k in range(len(time))]
        magnetometer = {"time": time, "field": field}
        lines.append(json.dumps({"imu": imu, "magnetometer": magnetometer}))
    source, sink = io.BytesIO("\n".join(lines).encode()), io.BytesIO()
    run_stream(tmp_path / "site.yaml", StreamSettings(), source, sink, io.StringIO())
    reported = [json.loads(line) for line in sink.getvalue().splitlines()]
    assert reported[0]["reasons"] == []
    (reason,) = reported[-1]["reasons"]
    assert reason["code"] == "no_start"
    assert "too slow for slots" in reason["text"]
