"""Test of the residuals of short windows, in which close tones are measured jointly."""

import numpy as np

from magfusion.estimation.integrity.test_result import NOTHING, Case, TestResult
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.snapshot.priors import NOTHING_EXPLAINED
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.windows import LONGEST_WINDOW

EXPLAINED = 1.5  # mean square, one where noise and model are as declared
MIN_COUNT = 3  # windows per mean


def together(case: Case) -> TestResult:
    """Test the short windows, in pieces of some seconds."""
    graph = case.result.graph
    measured = next((m for m in graph.measurements if isinstance(m, JointPhasors)), None)
    if measured is None or len(measured.time) < MIN_COUNT:
        return NOTHING
    residual = graph.residual(measured, case.result.estimate)
    square = np.mean(residual**2, axis=(1, 2))
    piece = np.floor((measured.time - measured.time[0]) / LONGEST_WINDOW).astype(np.int64)
    count = np.bincount(piece)
    mean = np.bincount(piece, square) / np.maximum(count, 1)
    mean = np.where(count >= MIN_COUNT, mean, np.mean(square))
    worst = float(np.max(mean))
    if worst <= EXPLAINED:
        return NOTHING
    time = case.result.states.time
    at = np.floor((time - measured.time[0]) / LONGEST_WINDOW).astype(np.int64)
    factor = np.maximum(mean[np.clip(at, 0, len(mean) - 1)], 1.0)
    rms, share = np.sqrt(worst), 100.0 * float(np.mean(mean > EXPLAINED))
    finding = Finding(
        "field_residuals",
        f"The jointly measured fields deviate by up to {rms:.2g} times the noise and model error,"
        f" in {share:.0f} % of the log. A beacon is not as declared, iron is near the path, or the"
        " start is wrong. Record a longer log to identify the beacon.",
        Verdict.FAILED if rms > NOTHING_EXPLAINED else Verdict.DOUBTFUL,
        20.0 + rms,
    )
    return TestResult((finding,), factor=factor)
