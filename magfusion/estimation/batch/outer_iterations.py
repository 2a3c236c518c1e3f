"""State of the passes over a log, and a checkpoint from which a stopped run is resumed."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.calibration_data import calibration_rules
from magfusion.estimation.batch.log_graph import PreprocessedLog
from magfusion.estimation.posterior.fixed_point_acceleration import Step
from magfusion.estimation.posterior.noise_tuning import Tuned
from magfusion.files.checkpoint import (
    Checkpoint,
    claim_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from magfusion.files.plain_data import from_plain, to_plain
from magfusion.model.parameters import Block, Calibration
from magfusion.model.trajectory import Trajectory
from magfusion.units import BoolArray


@dataclass(frozen=True, eq=False)
class IterationState:
    """State of a log after a pass."""

    # done, iterations: number of passes, and of the iterations in them
    done: int
    iterations: int
    tuning: bool  # whether noise and model error are still being estimated
    states: Trajectory  # at all epochs, without covariance
    # declared, calibration: with the estimated noise
    declared: Calibration
    calibration: Calibration
    segments: tuple[Calibration, ...]  # of every segment of a long log
    standing: BoolArray  # (states,), where the platform is known to be at rest
    tuned: tuple[Tuned, ...]
    step: Step | None = None  # of the pass


@dataclass(frozen=True)
class PassFile:
    """A checkpoint of the passes over one log."""

    place: Path
    key: str  # of the run (`magfusion.files.checkpoint.run_key`)
    resume: bool  # whether to continue from the state of an earlier run

    def begun(self, log: PreprocessedLog) -> IterationState | None:
        """Return the state of an earlier run; None without one, or where a new run is requested.

        Raises InputError where the file is damaged, is of another log, site or setting, or is no
        checkpoint.
        """
        result = read_checkpoint(self.place, self.key) if self.resume else None
        if result is None:
            claim_checkpoint(self.place)
            return None
        rules = calibration_rules(log.declared, log.blocks)
        passed = from_plain(IterationState, result.content, f"{self.place}: passes", rules)
        if passed.done != result.position or not _is_same_log(passed, log):
            raise InputError(f"{self.place}: belongs to another log; run without --resume")
        return passed

    def keep(
        self, passed: IterationState, declared: Calibration, blocks: tuple[Block, ...]
    ) -> None:
        """Write the state of a pass, replacing that of the pass before only when complete.

        `declared`: before the first pass.
        """
        content = to_plain(passed, calibration_rules(declared, blocks))
        write_checkpoint(Checkpoint(self.key, passed.done, content), self.place)


def _is_same_log(passed: IterationState, log: PreprocessedLog) -> bool:
    """Return whether the states belong to a log."""
    own, known = passed.states, log.states
    if not (np.array_equal(own.time, known.time) and len(passed.standing) == len(known)):
        return False
    pairs = [(vars(own)[name], value) for name, value in vars(known).items() if value is not None]
    return all(
        other is not None and other.shape == value.shape and bool(np.all(np.isfinite(other)))
        for other, value in pairs
    )
