"""Which beacons are detected, and how many sentences those have that are not."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.data_checks.detection import DetectionFilter
from magfusion.estimation.data_checks.signal import (
    LEAST_SNR,
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
    return BeaconDetection(time, ("A", "B"), snr, SIGMA * snr, snr > LEAST_SNR)


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
