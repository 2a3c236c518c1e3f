"""How well beacons are heard, before and after the motion inside the windows is taken off."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.data_checks.signal import (
    detect_beacons,
    detected_in,
    undetected_findings,
    with_motion_compensation,
)
from magfusion.model.samples import FieldSamples
from magfusion.model.trust import Verdict
from magfusion.simulation.demo_site import demo_site

SITE = demo_site()
TIME = np.arange(50) * 0.2
SIGNAL, NOISE = 30e-9, 1e-9  # T


def phasors(noise: float, time: np.ndarray = TIME) -> FieldSamples:
    shape = (len(time), len(SITE.channels), 3)
    cov = np.broadcast_to(noise**2 * np.eye(3), (*shape, 3)).copy()
    window = np.full(len(time), 0.4)
    return FieldSamples(time, window, SITE.channels, np.full(shape, SIGNAL + 0j), cov)


def doubts(result) -> list[str]:
    return [
        f.code for f in undetected_findings(result, SITE) if f.verdict is not Verdict.TRUSTWORTHY
    ]


def test_what_only_motion_hides_is_no_lack_of_signal() -> None:
    moving = phasors(NOISE)
    moving.phasor_cov[10:40] *= 1e4  # the motion of a strong beacon, taken for noise
    raw = detect_beacons(moving, SITE)
    assert "low_signal" in doubts(raw)
    released = phasors(NOISE, TIME[5:])
    assert doubts(with_motion_compensation(raw, detected_in(released, SITE))) == []


def test_what_is_far_away_stays_so() -> None:
    raw = detect_beacons(phasors(100.0 * SIGNAL), SITE)
    assert doubts(with_motion_compensation(raw, detected_in(phasors(50.0 * SIGNAL), SITE))) == [
        "low_signal"
    ]


def test_windows_of_another_length_tell_nothing() -> None:
    raw = detect_beacons(phasors(100.0 * SIGNAL), SITE)
    elsewhere = phasors(NOISE, TIME + 0.07)
    assert not np.any(with_motion_compensation(raw, detected_in(elsewhere, SITE)).strong)
    here = detected_in(replace(elsewhere, time=TIME), SITE)
    assert np.all(with_motion_compensation(raw, here).strong)
