"""Time division: each slot at its own time, the ambient field off, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from time_slots_and_mains import UNIT, tracker

from magfusion.errors import InputError
from magfusion.files.site import load_site, save_site
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site, Slots
from magfusion.receiver.ambient import Removal, ambient_weights, subtraction_gain
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.receivers import received, receiver_of
from magfusion.receiver.slots import (
    SlotSettings,
    default_slot_settings,
    schedule,
    slot_settings_of,
)
from magfusion.receiver.turn import on_clock
from magfusion.receiver.windows import LockinSettings, sent_frequencies_hz
from magfusion.simulation.field import synchronised_drives
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.motion import Rests, SimulatedMotion, static_motion, turning_motion
from magfusion.simulation.waveform import simulate_waveform

BOX_WORLD = np.array([[0.25, -0.25, -0.25], [0.75, 0.25, 0.25]])  # m
EARTH_WORLD = np.array([0.0, 2e-5, -5e-5])  # T


def _still(duration: float) -> ImuSamples:
    time = np.arange(int(duration * 200) + 3) / 200.0
    return ImuSamples(time, np.zeros((len(time), 3)), np.tile([0.0, 0.0, 9.81], (len(time), 1)))


def _hum(slot: float, hum_hz: float, removal: Removal, cycles: int = 20) -> list[float]:
    """Return what is left of a unit tone in slots 1 to 3, at the worst of its phases."""
    site, rate = tracker(0.0, Slots(slot, 4)), 48e3
    time = np.arange(round(cycles * 4 * slot * rate)) / rate
    worst = np.zeros(3)
    for phase in np.linspace(0.0, np.pi, 24, endpoint=False):
        hum = np.cos(2.0 * np.pi * hum_hz * time + phase)[:, None] * [1.0, 0.0, 0.0]
        settings = SlotSettings(removal, "rectangular")
        result, _ = received(Waveform(time, hum), _still(time[-1]), site, settings)
        inner = result.phasor_sensor[15:-15, :, 0]
        worst = np.maximum(worst, np.nanmax(np.abs(inner), axis=0))
    return [float(20.0 * np.log10(w + 1e-12)) for w in worst]


@pytest.mark.parametrize(
    ("slot", "left_db"),  # 50 Hz, silent slot subtracted
    [
        (0.5e-3, (-6.6, -10.1, -16.1)),
        (1e-3, (-0.9, -4.2, -10.1)),
        (5e-3, (2.1, 5.1, 2.1)),
    ],
)
def test_subtracting_the_silent_slot_leaves_what_the_formula_says(
    slot: float, left_db: tuple[float, ...]
) -> None:
    formula = [20.0 * np.log10(subtraction_gain(50.0, slot, 3 - k)) for k in range(3)]
    assert formula == pytest.approx(left_db, abs=0.06)
    # Stamps lie half a sample before the middle of a slot, and phases 7.5 degrees apart.
    assert _hum(slot, 50.0, "subtract") == pytest.approx(formula, abs=0.1)


@pytest.mark.slow
def test_slots_of_a_mains_cycle_average_the_mains_out() -> None:
    assert subtraction_gain(50.0, 20e-3, 1) < 1e-12
    assert max(_hum(20e-3, 50.0, "none", 12)) < -200.0
    assert max(_hum(20e-3, 49.8, "subtract", 12)) == pytest.approx(-70.4, abs=0.3)


def test_neighbouring_silent_slots_help_a_short_cycle() -> None:
    assert max(_hum(0.5e-3, 50.0, "interpolate")) == pytest.approx(-26.2, abs=0.1)
    assert max(_hum(1e-3, 50.0, "interpolate")) == pytest.approx(-14.4, abs=0.1)
    assert max(_hum(5e-3, 50.0, "interpolate")) == pytest.approx(5.1, abs=0.1)


def test_a_state_that_knows_the_mains_takes_them_off() -> None:
    assert max(_hum(1e-3, 50.0, "state")) < -200.0
    assert max(_hum(1e-3, 49.8, "state")) < -40.0
    # Each cycle sees the same phase of the mains: nothing tells them from a static field.
    assert max(_hum(5e-3, 50.0, "state")) == pytest.approx(5.1, abs=0.1)


@pytest.mark.parametrize("removal", ["subtract", "interpolate", "state"])
def test_a_steady_field_and_a_drift_weigh_nothing(removal: Removal) -> None:
    numbers = np.arange(60)
    driven, silent = numbers[numbers % 4 != 3], numbers[numbers % 4 == 3]
    index, weight = ambient_weights(driven, silent, 4, removal)
    assert np.nansum(weight, axis=1) == pytest.approx(1.0)
    if removal != "subtract":
        inner = slice(3, -3)
        reported = np.sum(weight * silent[index], axis=1)
        assert reported[inner] == pytest.approx(driven[inner])


def _turning(duration: float) -> SimulatedMotion:
    rests = Rests(start=0.2, move=duration, pause=0.1)
    rng = np.random.default_rng(2)
    return turning_motion(rng, duration, BOX_WORLD, 0.3, rate_rms=1.5, rests=rests)


def _recorded(
    site: Site, motion: SimulatedMotion, rate_hz: float, duration: float, gyro_bias: float = 0.0
) -> tuple[Waveform, ImuSamples]:
    imu = replace(site.platform.imu, gyro_noise=0.0, gyro_bias_sigma=0.0, gyro_bias_walk=0.0)
    rng = np.random.default_rng(3)
    samples = simulate_imu(motion, imu, site.gravity, 1000.0, duration, rng).samples
    waveform = simulate_waveform(motion, site, synchronised_drives(site), rate_hz, duration, rng)
    return waveform, replace(samples, gyro_body=samples.gyro_body + gyro_bias)


def _wrong(site: Site, result: FieldSamples, motion: SimulatedMotion) -> float:
    """Return the largest error of a field, relative to K/R^3 at half a metre."""
    at = motion.trajectory(result.time)
    calibration = initial_calibration(site, 0.0)
    true = predict_channels(calibration, at.time, at.world_from_body, at.position_world)
    return float(np.max(np.abs((result.phasor_sensor - true)[result.valid]))) / UNIT


def _with_earth(site: Site) -> Site:
    rotated = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    matrix = np.eye(3) + 0.05 * np.arange(9.0).reshape(3, 3) / 9.0
    sensor = replace(
        site.platform.magnetometer,
        matrix=matrix,
        offset=np.array([3e-7, -2e-7, 1e-7]),
        body_from_sensor=rotated,
        position_body=np.array([0.02, 0.01, -0.03]),
    )
    platform = replace(site.platform, magnetometer=sensor)
    return replace(site, platform=platform, earth_field_world=EARTH_WORLD)


@pytest.mark.parametrize("removal", ["subtract", "interpolate", "state"])
def test_a_turning_body_measures_pulses_free_of_the_earth_field(removal: Removal) -> None:
    site = _with_earth(tracker(0.0, Slots(2.5e-3, 4, start=0.4e-3)))
    motion = _turning(2.0)
    waveform, imu = _recorded(site, motion, 16e3, 2.0)
    result, _ = received(waveform, imu, site, SlotSettings(removal, "rectangular"))
    # The Earth field is 70 times K/R^3 and turns by a quarter degree in a slot.
    assert len(result) > 590
    assert _wrong(site, result, motion) < 1e-4
    assert np.all(np.sum(result.valid, axis=1) == 1)
    assert np.all(np.diff(result.time) > 2.4e-3)


def _without_ends(result: FieldSamples) -> FieldSamples:
    """Return what has silent slots on both sides."""
    rows = slice(3, -3)
    return replace(
        result,
        time=result.time[rows],
        window=result.window[rows],
        phasor_sensor=result.phasor_sensor[rows],
        phasor_cov=result.phasor_cov[rows],
    )


def test_a_gyro_bias_costs_the_paper_dearly_and_its_neighbours_nothing() -> None:
    site = _with_earth(tracker(0.0, Slots(2.5e-3, 4)))
    motion = _turning(2.0)
    waveform, imu = _recorded(site, motion, 16e3, 2.0, gyro_bias=0.02)
    wrong = {}
    for removal in ("subtract", "interpolate"):
        settings = SlotSettings(removal, "rectangular")
        result, _ = received(waveform, imu, site, settings)
        wrong[removal] = _wrong(site, _without_ends(result), motion)
    receiver = receiver_of(site, SlotSettings("subtract", "rectangular"))
    windows, _ = receiver.whole(waveform, imu)
    known = on_clock(imu, site.platform.imu.time_offset, np.full(3, 0.02))
    cleaned, _ = receiver.phasors(waveform, known, windows, site)
    assert wrong["subtract"] > 5e-3
    assert wrong["interpolate"] < 1e-4
    assert _wrong(site, cleaned, motion) < 1e-4


@pytest.mark.parametrize("taper", ["rectangular", "hann"])
def test_a_carrier_needs_no_whole_number_of_cycles(taper: Any) -> None:
    site = _with_earth(tracker(3.3e3, Slots(2.5e-3, 4), phase=0.7))
    motion = _turning(1.0)
    waveform, imu = _recorded(site, motion, 16e3, 1.0)
    result, dropped = received(waveform, imu, site, SlotSettings("none", taper))
    assert not dropped
    assert _wrong(site, result, motion) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("carrier_hz", "removal", "taper"),
    [
        (0.0, "subtract", "rectangular"),
        (2e3, "none", "rectangular"),
        (2e3, "none", "hann"),
    ],
)
def test_the_covariance_is_that_of_the_noise(
    carrier_hz: float, removal: Removal, taper: Any
) -> None:
    site = tracker(carrier_hz, Slots(5e-3, 4), density=1e-10)
    motion = static_motion(np.array([0.5, 0.1, -0.2]), Rotation.identity())
    waveform, imu = _recorded(site, motion, 8e3, 20.0)
    result, _ = received(waveform, imu, site, SlotSettings(removal, taper))
    at = motion.trajectory(result.time)
    true = predict_channels(
        initial_calibration(site, 0.0), at.time, at.world_from_body, at.position_world
    )
    wrong = (result.phasor_sensor - true)[result.valid].real
    share = np.einsum("ni,nij,nj->n", wrong, np.linalg.inv(result.phasor_cov[result.valid]), wrong)
    # 3000 slots of three components scatter by 1.5 %; the inverse of a covariance measured with 128
    # degrees of freedom is too large by 128 / 124.
    assert np.mean(share) / 3.0 == pytest.approx(128.0 / 124.0, abs=0.045)
    # A mean has half the variance of a quadrature, and subtracting one doubles that again.
    assert np.var(wrong) == pytest.approx(
        1e-20 / 5e-3 * (1.5 if taper == "hann" else 1.0), rel=0.05
    )


# 4130 Hz make 20.65 cycles of a slot: what is seen beside the carrier is at no zero of the taper.
@pytest.mark.parametrize("carrier_hz", [0.0, 4e3, 4130.0])
def test_what_turns_in_the_earth_field_is_no_noise(carrier_hz: float) -> None:
    slots = Slots(5e-3, 4)
    site = _with_earth(tracker(carrier_hz, slots, density=1e-10))
    waveform, imu = _recorded(site, _turning(3.0), 16e3, 3.0)
    settings = SlotSettings("none" if carrier_hz else "subtract", "rectangular")
    result, _ = received(waveform, imu, site, settings)
    matrix = site.platform.magnetometer.matrix
    # White noise enters after the matrix; 128 degrees of freedom give a variance within a third.
    expected = 1e-20 / slots.duration
    share = np.diagonal(result.phasor_cov[result.valid], axis1=1, axis2=2) / expected
    assert np.linalg.cond(matrix) < 1.2
    assert np.median(share) == pytest.approx(1.0, abs=0.15)


def test_a_cycle_as_one_epoch_is_turned_to_its_own_time() -> None:
    """About a still point the gyro undoes all of the skew."""
    site = tracker(4e3, Slots(5e-3, 4))
    moving = _turning(1.0)
    motion = replace(
        moving, position=static_motion(np.array([0.5, 0, 0]), moving.attitude(0.0)).position
    )
    waveform, imu = _recorded(site, motion, 16e3, 1.0)
    result, _ = received(waveform, imu, site, default_slot_settings(site))
    cycles = whole_cycles(result, imu, site)
    assert len(cycles) == len(result) // 3
    assert np.all(cycles.valid)
    assert _wrong(site, cycles, motion) < 1e-4
    again = whole_cycles(cycles, imu, site)
    np.testing.assert_allclose(again.phasor_sensor, cycles.phasor_sensor, rtol=1e-12)


def test_a_gap_costs_the_slots_in_it_and_no_others() -> None:
    site = tracker(0.0, Slots(5e-3, 4), density=1e-10)
    motion = static_motion(np.array([0.5, 0.1, -0.2]), Rotation.identity())
    waveform, imu = _recorded(site, motion, 8e3, 2.0)
    kept = (waveform.time < 0.5) | (waveform.time >= 0.6)
    short = Waveform(waveform.time[kept], waveform.measured_sensor[kept])
    whole, none = received(waveform, imu, site, default_slot_settings(site))
    result, dropped = received(short, imu, site, default_slot_settings(site))
    assert not none
    lost_epochs = (whole.time > 0.5) & (whole.time < 0.6)
    np.testing.assert_allclose(result.time, whole.time[~lost_epochs], rtol=1e-12)
    assert _wrong(site, result, motion) < 0.02
    assert set(dropped) <= {"gap in the magnetometer stream"}


# What is refused


def _refused(site: Site, rate_hz: float = 8e3, settings: SlotSettings | None = None) -> str:
    waveform = Waveform(
        np.arange(4000) / rate_hz, 1e-9 * np.random.default_rng(1).normal(size=(4000, 3))
    )
    chosen = default_slot_settings(site) if settings is None else settings
    with pytest.raises(InputError) as caught:
        received(waveform, _still(4000 / rate_hz), site, chosen)
    return str(caught.value)


def test_a_schedule_must_fit_the_sampling_rate() -> None:
    assert "too slow for slots of 0.0005 s; at least 1.6e+04 Hz" in _refused(
        tracker(0.0, Slots(0.5e-3, 4))
    )
    assert "too slow for the carrier at 5000 Hz" in _refused(tracker(5e3, Slots(5e-3, 4)))
    assert "less than 1 cycles in a slot" in _refused(tracker(100.0, Slots(5e-3, 4)))


def test_a_log_shorter_than_a_slot_is_refused() -> None:
    assert "no slot of 10 s is usable (the log is too short)" in _refused(
        tracker(0.0, Slots(10.0, 4))
    )


def test_pulses_need_a_silent_slot() -> None:
    assert "all 3 time slots are driven" in _refused(tracker(0.0, Slots(5e-3, 3)))
    site = tracker(2e3, Slots(5e-3, 3))
    assert "all 3 time slots" in _refused(site, settings=SlotSettings("subtract", "hann"))


def test_silent_slots_have_one_carrier() -> None:
    site = tracker(2e3, Slots(5e-3, 4))
    beacon = site.beacons[0]
    coils = (replace(beacon.coils[0], frequency_hz=2500.0), *beacon.coils[1:])
    several = replace(site, beacons=(replace(beacon, coils=coils),))
    assert "several carriers" in _refused(several, settings=SlotSettings("state", "hann"))


def test_beacons_keep_one_schedule_and_a_slot_each() -> None:
    site = tracker(2e3, Slots(5e-3, 4))
    first = site.beacons[0]
    for other, findings in (
        (replace(first, name="U", slots=None), "and beacon U none"),
        (replace(first, name="U", slots=Slots(4e-3, 4)), "and beacon U another one"),
        (replace(first, name="U"), "beacons T and U are both driven in slot 0"),
    ):
        with pytest.raises(InputError, match=findings):
            schedule(replace(site, beacons=(first, other)))


def test_the_lock_in_names_what_separates_slots() -> None:
    site = tracker(2e3, Slots(5e-3, 4))
    with pytest.raises(InputError, match="which the lock-in cannot separate; give its demodulated"):
        sent_frequencies_hz(site)
    bare = replace(site, beacons=(replace(site.beacons[0], slots=None),))
    with pytest.raises(InputError, match=r"declare its slots: \{duration_s, count\}, or give"):
        sent_frequencies_hz(bare)


def test_a_window_that_is_no_slot_is_refused() -> None:
    site = tracker(0.0, Slots(5e-3, 4))
    assert slot_settings_of(site, LockinSettings(5e-3, 2.5e-3, 60.0)).mains_hz == 60.0
    with pytest.raises(InputError, match=r"--window 0.4 s: the time slots of 0.005 s"):
        slot_settings_of(site, LockinSettings(0.4, 0.2))


def test_slots_too_short_to_simulate_are_refused() -> None:
    site = tracker(0.0, Slots(5e-3, 4))
    motion = static_motion(np.array([0.5, 0.0, 0.0]), Rotation.identity())
    with pytest.raises(InputError, match="give at least 800 Hz"):
        simulate_waveform(
            motion, site, synchronised_drives(site), 400.0, 1.0, np.random.default_rng(1)
        )


# In a site's file


def test_a_schedule_survives_its_file(tmp_path: Path) -> None:
    site = tracker(0.0, Slots(2.5e-3, 4, start=1e-3))
    save_site(site, tmp_path / "site.yaml")
    again = load_site(tmp_path / "site.yaml").beacons[0]
    assert again.slots == Slots(2.5e-3, 4, 1e-3)
    assert again.frequency_hz == 0.0
    assert [coil.slot for coil in again.coils] == [0, 1, 2]


@pytest.mark.parametrize(
    ("change", "findings"),
    [
        ({"slots": {"duration_s": 0.005, "count": 2}}, "beacons[0].coils[2].slot: found 2; give"),
        ({"slots": {"duration_s": 0.0, "count": 4}}, "beacons[0].slots.duration_s: found 0.0"),
        ({"slots": {"duration_s": 0.005}}, "beacons[0].slots.count"),
        ({"slots": None}, "beacons[0].frequency_hz: found 0"),
        ({"synchronised": False}, "beacons[0].synchronised: found False; write true"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused(
    change: dict[str, Any], findings: str, tmp_path: Path
) -> None:
    path = tmp_path / "site.yaml"
    save_site(tracker(0.0, Slots(5e-3, 4)), path)
    content = yaml.safe_load(path.read_text())
    content["beacons"][0] |= change
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError) as caught:
        load_site(path)
    assert findings in str(caught.value)


def test_rounding_does_not_take_a_slots_first_sample() -> None:
    slots = Slots(2.5e-3, 4, start=0.1)
    time = 0.1 + 2.5e-3 * np.arange(4000)
    np.testing.assert_array_equal(slots.running(time), np.arange(4000))
    assert slots.cycle == pytest.approx(0.01)
