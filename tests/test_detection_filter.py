"""Which beacons a first window has: only those that are far above what its motion leaves."""

import numpy as np

from magfusion.estimation.data_checks.detection import DetectionFilter
from magfusion.model.samples import FieldSamples

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
