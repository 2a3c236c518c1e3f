"""A calibration against what was declared, online, where more is uncertain than is estimated."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.graph.state import MOTION, State
from magfusion.estimation.online_integrity.gate import Gate
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.magnetometer_watch import MagnetometerWatch
from magfusion.estimation.online_integrity.online import OnlineMonitor
from magfusion.model.parameters import Block, choose_blocks, initial_calibration, retract
from magfusion.model.site import BeaconSigma
from magfusion.simulation.demo_site import demo_site

SURVEYED = 0.01  # m
SITE = demo_site(coil_radius=None)
SITE = replace(
    SITE,
    beacons=tuple(
        replace(b, sigma=BeaconSigma(np.full(3, SURVEYED), np.zeros(3), np.zeros(2)))
        for b in SITE.beacons
    ),
)


def state_with(moved: float, sigma: float) -> tuple[State, Block, OnlineMonitor]:
    """Return a state whose third beacon moved along x (m), of some sigma (m)."""
    blocks = choose_blocks(SITE, ("beacons",))
    block = next(b for b in blocks if b.name == "C.position")
    size = MOTION + blocks[-1].columns.stop
    variance = np.full(size, 1e-6)
    variance[MOTION:] = 0.99 * SURVEYED**2
    variance[MOTION:][block.columns] = sigma**2
    step = np.zeros(size - MOTION)
    step[block.columns.start] = moved
    calibration = retract(initial_calibration(SITE, 0.0), blocks, step)
    still = np.zeros(3)
    level = np.array([0.0, 0.0, 1.0])
    state = State(1.0, np.eye(3), level, still, still, still, calibration, np.diag(variance))
    return state, block, OnlineMonitor(SITE, blocks)


@pytest.mark.parametrize(
    ("moved", "sigma", "share", "findings"),
    [
        (0.028, 0.0135, 0.0, True),
        # Three prior sigmas: the directions of the beacons, only considered, are in it.
        (0.028, 0.0135, 0.95, False),
        (0.06, 0.002, 0.0, True),
        (0.06, 0.002, 0.95, True),
        (0.12, 0.0135, 0.95, True),
    ],
)
def test_what_was_only_considered_moves_what_is_estimated(
    moved: float, sigma: float, share: float, findings: bool
) -> None:
    state, block, monitor = state_with(moved, sigma)
    shared_offsets = {block.name: np.full(3, share * sigma**2)}
    monitor.begin(0.0, Judgement(), shared_offsets, {})
    gate = Gate(SITE.channels, (), MagnetometerWatch(SITE))
    detected = monitor.judgement(state, gate, None, Judgement())
    assert any(f.code == "prior" and "C.position" in f.text for f in detected.findings) == findings
