"""Where the passes over a log are: what a run that is stopped goes on from."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.calibration_data import calibration_rules
from magfusion.estimation.batch.log_graph import PreparedLog
from magfusion.estimation.posterior.noise_tuning import Tuned
from magfusion.estimation.posterior.relaxation import Step
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
class Passed:
    """What a pass over a log left for the next.

    Parameters
    ----------
    done, iterations : int
        Passes, and the iterations in them.
    tuning : bool
        Whether noise and model error are still being found.
    states : Trajectory
        At all epochs, without covariance.
    declared, calibration : Calibration
        With the noise that was found.
    segments : tuple of Calibration
        Of every segment of a long log.
    standing : bool ndarray, shape (states,)
        Where the platform is known to stand.
    tuned : tuple of Tuned
    step : Step, optional
        Of the pass.
    """

    done: int
    iterations: int
    tuning: bool
    states: Trajectory
    declared: Calibration
    calibration: Calibration
    segments: tuple[Calibration, ...]
    standing: BoolArray
    tuned: tuple[Tuned, ...]
    step: Step | None = None


@dataclass(frozen=True)
class PassFile:
    """A checkpoint of the passes over one log.

    Parameters
    ----------
    place : Path
    key : str
        Of the run (`magfusion.files.checkpoint.run_key`).
    resume : bool
        Whether to go on from what an earlier run left.
    """

    place: Path
    key: str
    resume: bool

    def begun(self, log: PreparedLog) -> Passed | None:
        """Return where an earlier run was; None where there is none, or a new one is asked for.

        Raises
        ------
        InputError
            Where the file is damaged, or of another log, site or setting, or no checkpoint.
        """
        found = read_checkpoint(self.place, self.key) if self.resume else None
        if found is None:
            claim_checkpoint(self.place)
            return None
        rules = calibration_rules(log.declared, log.blocks)
        passed = from_plain(Passed, found.content, f"{self.place}: passes", rules)
        if passed.done != found.position or not _alike(passed, log):
            raise InputError(f"{self.place}: is not of this log; run without --resume")
        return passed

    def keep(self, passed: Passed, declared: Calibration, blocks: tuple[Block, ...]) -> None:
        """Write what a pass left; until it is whole, what the pass before left is there.

        Parameters
        ----------
        declared : Calibration
            Before the first pass.
        """
        content = to_plain(passed, calibration_rules(declared, blocks))
        write_checkpoint(Checkpoint(self.key, passed.done, content), self.place)


def _alike(passed: Passed, log: PreparedLog) -> bool:
    """Return whether states are those of a log."""
    own, known = passed.states, log.states
    if not (np.array_equal(own.time, known.time) and len(passed.standing) == len(known)):
        return False
    pairs = [(vars(own)[name], value) for name, value in vars(known).items() if value is not None]
    return all(
        other is not None and other.shape == value.shape and bool(np.all(np.isfinite(other)))
        for other, value in pairs
    )
