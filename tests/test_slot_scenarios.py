"""Slots of paper 000 against the mains and against motion."""

import json
import sys

import numpy as np
import pytest
import time_slots_and_mains as mains
import tracker_motion_skew as moving

from magfusion.papers.register import paper

CONFIG = mains.Config(runs=40)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slot", "attitude_deg"),  # hum of 0.15 uT at 50 Hz: nothing, subtracted, interpolated
    [(1e-3, (9.7, 6.1, 1.5)), (5e-3, (8.4, 14.0, 13.9))],
)
def test_pulses_under_hum_are_wrong_by_what_the_analysis_found(
    slot: float, attitude_deg: tuple[float, ...]
) -> None:
    result = mains.pulsed(CONFIG, slot, 50.0)
    ours = [result[removal][1] for removal in ("none", "subtract", "interpolate")]
    # 40 poses and directions of a skewed error: a tenth.
    assert ours == pytest.approx(attitude_deg, rel=0.2)
    if slot == 5e-3:
        assert result["subtract"][1] > 1.3 * result["none"][1]
    else:
        assert result["state"][1] < 1e-6


@pytest.mark.slow
def test_slots_of_a_mains_cycle_stand_hum_that_is_off_its_frequency() -> None:
    result = mains.pulsed(mains.Config(runs=12, cycles=9), 20e-3, 49.8)
    assert result["none"][1] == pytest.approx(0.037, abs=0.012)
    assert result["subtract"][1] < 0.004


@pytest.mark.slow
@pytest.mark.parametrize(
    ("carrier_hz", "slot", "taper", "left_db", "tolerance"),
    [
        (1e3, 5e-3, "rectangular", -38.5, 1.0),
        (1e4, 5e-3, "rectangular", -59.8, 1.0),
        (1e4, 1e-3, "rectangular", -59.0, 1.0),
        # The last decibels of a taper depend on where between two samples it begins.
        (1e4, 5e-3, "hann", -129.5, 2.0),
    ],
)
def test_a_carrier_keeps_hum_out(
    carrier_hz: float, slot: float, taper: str, left_db: float, tolerance: float
) -> None:
    row = mains.carrier_row(CONFIG, carrier_hz, slot, taper)
    assert row.residual_db == pytest.approx(left_db, abs=tolerance)
    if taper == "hann":
        assert row.attitude_deg < 1e-3


def test_three_carriers_at_once_go_through_the_ordinary_lock_in() -> None:
    row = mains.frequency_division(mains.Config(runs=5))
    assert row.residual_db < -120.0
    assert row.attitude_deg < 1e-4


@pytest.mark.slow
def test_each_removal_costs_the_noise_that_it_should() -> None:
    noise = mains.noise_deg(mains.Config(runs=60))
    assert noise["none"] == pytest.approx(0.122, abs=0.012)
    assert noise["subtract"] == pytest.approx(0.172, abs=0.017)
    # Many cycles tell the ambient field better than one.
    assert noise["none"] < noise["state"] < noise["interpolate"] < noise["subtract"]


@pytest.mark.slow
def test_what_coils_of_true_size_turn_the_closed_form_by_is_taken_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The next term of a coil's field goes with the square of its radius over the distance."""
    result = mains.taken_for_dipoles_deg(CONFIG)
    monkeypatch.setattr(mains, "COIL_RADIUS", 0.5 * mains.COIL_RADIUS)
    smaller = mains.taken_for_dipoles_deg(CONFIG)
    assert result["dipoles"] / smaller["dipoles"] == pytest.approx(4.0, rel=0.01)
    noise_deg = mains.noise_deg(CONFIG)["none"]  # at 60 dB
    assert mains.COIL_RADIUS == 0.01  # halved
    assert result["dipoles"] == pytest.approx(2.0 * noise_deg, rel=0.1)
    assert result["coils"] < 1e-6


@pytest.mark.parametrize(("slot_ms", "skew_deg"), [(1.0, 0.125), (5.0, 0.626), (20.0, 2.502)])
def test_slots_at_their_own_times_have_no_skew(slot_ms: float, skew_deg: float) -> None:
    result = moving.skew(moving.Config(), slot_ms)
    assert result.together_deg == pytest.approx(skew_deg, rel=0.01)
    assert result.apart_deg < 1e-6


@pytest.mark.slow
def test_the_register_has_the_figures_of_slots() -> None:
    reported = paper("000").select("claim 5")[0].entry.why
    noise = mains.noise_deg(mains.Config())
    skew = moving.skew(moving.Config(), 5.0).together_deg
    assert f"{noise['subtract']:.3f} instead of {noise['none']:.3f} degrees" in reported
    assert f"by {skew:.2f} degrees at 100 deg/s and 5 ms" in reported


def test_the_scenario_prints_its_figures_as_the_last_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = mains.Config(runs=2, slots=(1e-3, 20e-3), mains_hz=(50.0,), cycles=9)
    monkeypatch.setattr(mains, "Config", lambda **_: small)
    monkeypatch.setattr(mains.Config, "seed", 0, raising=False)
    monkeypatch.setattr(mains.Config, "runs", 2, raising=False)
    monkeypatch.setattr(sys, "argv", ["time_slots_and_mains.py"])
    mains.main()
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(figures["pulsed"]) == 8
    assert np.isfinite([row["attitude_deg"] for row in figures["carriers"]]).all()
