"""Which beacons are detected, and how many sentences those have that are not."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.data_checks.detection import DetectionFilter, switched, without_silence
from magfusion.estimation.data_checks.signal import (
    MIN_SNR,
    BeaconDetection,
    undetected_findings,
)
from magfusion.model.samples import FieldSamples
from magfusion.model.trust import Verdict
from magfusion.simulation.demo_site import demo_site
from magfusion.units import Array

SIGMA = 1e-10  # T
STEP, WINDOW = 0.4, 0.8  # s


def epoch(time: float) -> FieldSamples:
    """Return a beacon of 60 sigma, a weak one of 8, and none."""
    amplitude = SIGMA * np.array([60.0, 8.0, 1.0])
    phasor = np.zeros((1, 3, 3), dtype=complex)
    phasor[0, :, 0] = amplitude
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), (1, 3, 3, 3))
    channels = (("strong", 0), ("weak", 0), ("none", 0))
    return FieldSamples(np.array([time]), np.array([WINDOW]), channels, phasor, cov)


def test_a_weak_tone_of_the_first_window_waits_until_it_has_lasted_a_window() -> None:
    detection = DetectionFilter()
    valid = [detection.of(epoch(STEP * k), STEP).valid[0].tolist() for k in range(4)]
    assert valid == [[True, False, False]] * 2 + [[True, True, False]] * 2


def received(amplitude: Array, window: float) -> FieldSamples:
    """Return phasors of beacons, of amplitudes (n, beacons) in sigma, NaN where not contained."""
    rng = np.random.default_rng(3)
    shape = (*amplitude.shape, 3)
    phasor = rng.normal(0.0, SIGMA, shape) + 1j * rng.normal(0.0, SIGMA, shape)
    phasor[..., 0] += SIGMA * amplitude
    phasor[np.isnan(amplitude)] = np.nan
    count, beacons = amplitude.shape
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), (count, beacons, 3, 3))
    channels = tuple((name, 0) for name in "ABCD"[:beacons])
    time = STEP * np.arange(count)
    return FieldSamples(time, np.full(count, window), channels, phasor, cov)


@pytest.mark.parametrize(("overlap", "first"), [(1, 20), (2, 19), (3, 18)])
def test_the_windows_that_contain_a_switch_are_omitted_for_all_beacons(
    overlap: int, first: int
) -> None:
    # On for ten seconds, off for eight; windows that overlap the switches contain a part.
    time, window = STEP * np.arange(60), STEP * overlap
    edges = time[:, None] + 0.5 * window * np.array([-1.0, 1.0])
    share = 1.0 - np.clip(np.minimum(edges[:, 1], 16.1) - np.maximum(edges[:, 0], 8.1), 0, None) / (
        window
    )
    samples = received(np.column_stack([np.full(60, 50.0), 40.0 * share]), window)
    partial = (share > 1e-9) & (share < 1.0 - 1e-9)
    assert np.flatnonzero(partial)[0] >= first
    omitted = switched(samples)
    assert np.all(omitted[partial])
    assert np.sum(omitted) <= 4 * overlap  # two windows' length at each switch
    valid = without_silence(samples).valid
    assert np.array_equal(valid[:, 0], ~omitted)
    assert without_silence(without_silence(samples)).valid.tolist() == valid.tolist()


def test_a_beacon_out_of_range_or_in_another_slot_costs_the_others_no_window() -> None:
    away = 1.0 + 0.05 * np.arange(100)  # times the least distance
    fading = received(np.column_stack([np.full(100, 50.0), 300.0 * away**-3]), 2 * STEP)
    assert not np.any(switched(fading))
    on = np.where(np.arange(100) < 50, 60.0, 0.0)
    slots = np.column_stack([np.full(100, 50.0), on])
    slots[::2, 0] = slots[1::2, 1] = np.nan
    taking_turns = received(slots, STEP)
    lost = taking_turns.valid & ~without_silence(taking_turns).valid
    assert np.sum(lost[:, 0]) == 0
    assert np.sum(lost[:, 1]) == pytest.approx(25, abs=2)


def test_beacons_that_are_never_detected_have_one_sentence() -> None:
    strong = np.zeros((10, 4), dtype=bool)
    strong[:, 2] = True
    snr = np.where(strong, 100.0, 1.0)
    names = tuple("ABCD")
    detection = BeaconDetection(np.arange(10.0), names, snr, 1e-9 * snr, strong)
    (finding,) = undetected_findings(detection, demo_site())
    assert finding.text.startswith("beacons A (20 Hz), B (25 Hz), D (35 Hz) are never detected")
    assert "remove them from site.yaml" in finding.text


def passing(range_m: Array) -> BeaconDetection:
    """Return the reception of A, of 5 sigma at 20 m and by the cube of the range, and of B."""
    field = np.maximum(5.0 * (20.0 / range_m) ** 3, 0.7)
    snr = np.stack([field, np.full(len(field), 100.0)], axis=1)
    time = STEP * np.arange(len(snr))
    return BeaconDetection(time, ("A", "B"), snr, SIGMA * snr, snr > MIN_SNR)


def test_who_drives_out_of_range_is_not_told_that_a_beacon_was_switched_off() -> None:
    away = 10.0 + 3.0 * STEP * np.arange(100)  # m, at 3 m/s
    (finding,) = undetected_findings(passing(np.concatenate([away, away[::-1]])), demo_site())
    assert (finding.code, finding.verdict) == ("low_signal", Verdict.TRUSTWORTHY)


def test_a_beacon_that_falls_silent_in_reach_was_switched_off() -> None:
    silent = passing(np.where(np.arange(100) < 50, 10.0, 1e3))
    (finding,) = undetected_findings(silent, demo_site())
    assert (finding.code, finding.verdict) == ("silent_beacon", Verdict.DOUBTFUL)
    assert "19.8 to 39.8 s" in finding.text


def test_epochs_without_a_beacon_are_a_doubt_unless_other_sensors_measure_the_motion() -> None:
    here = passing(np.where(np.arange(100) < 50, 10.0, 1e3))
    gap = replace(here, strong=here.strong & (np.arange(100) < 50)[:, None])
    for aided, verdict in ((False, Verdict.DOUBTFUL), (True, Verdict.TRUSTWORTHY)):
        first, *_ = undetected_findings(gap, demo_site(), aided=aided)
        assert first.text.startswith("no beacon is detected in 50 % of the epochs")
        assert first.verdict is verdict
