"""Innovation test of aiding sensors: slips are left out, a long contradiction is named."""

from collections import Counter
from collections.abc import Sequence

from scipy.stats import chi2

from magfusion.estimation.graph.measurement import Measurement, group_distances
from magfusion.estimation.graph.state import State, states_of
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.model.parameters import Block
from magfusion.model.trust import Finding, Verdict

FALSE_REJECTIONS = 1e-3  # of true samples, which costs a thousandth of the information
REJECTED_LONG = 5.0  # s of nothing but rejections; slips and reflections are shorter
GATE = {k: float(chi2.isf(FALSE_REJECTIONS, k)) for k in (1, 2, 3)}  # by degrees of freedom


class AidingGate:
    """Rejects samples of aiding sensors that the predicted state does not explain.

    Attributes
    ----------
    rejected_since : dict of str to float
        Of each sensor whose last sample was rejected, the time of the first such in a row (s).
    """

    rejected_since: dict[str, float]

    def __init__(self, blocks: Sequence[Block], counts: Counter[str]) -> None:
        self.blocks, self.counts = tuple(blocks), counts
        self.rejected_since = {}

    def passed(self, measurements: list[Measurement], state: State) -> list[Measurement]:
        """Return the measurements of one epoch without those that fail the test."""
        return [one for one in measurements if self._is_explained(one, state)]

    def _is_explained(self, measurement: Measurement, state: State) -> bool:
        if not isinstance(measurement, AidingMeasurement):
            return True
        rows = measurement.linearize(states_of([state]), state.calibration, self.blocks)
        measured = int((measurement.sigma < float("inf")).sum())
        explained = bool(group_distances(rows, state.cov)[0, 0] <= GATE[measured])
        if explained:
            self.rejected_since.pop(measurement.sensor, None)
        else:
            self.counts[f"outlier of {measurement.sensor}"] += 1
            self.rejected_since.setdefault(measurement.sensor, state.time)
        return explained

    def findings(self, time: float) -> tuple[Finding, ...]:
        """Return the sensors that contradict the state for long."""
        return tuple(
            Finding(
                "aiding_disagrees",
                f"{sensor} contradicts the estimate since {start_time:.1f} s, and is not used: it"
                " slips or is blocked, or its scale, mounting or clock is not as declared; correct"
                " them in the site's aiding, or leave it out.",
                Verdict.DOUBTFUL,
                (time - start_time) / REJECTED_LONG,
            )
            for sensor, start_time in self.rejected_since.items()
            if time > start_time + REJECTED_LONG
        )
