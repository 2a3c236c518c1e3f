"""Files of the logs among several: one alone or after a round, and what some know together.

A rerun resumes from those that were smoothed alone.  The others are how the workers of a round
exchange data, so that the driver passes names of files.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.calendar import BlockName, Calendar, LogBlocks
from magfusion.estimation.batch.chain import Start
from magfusion.estimation.batch.joint import LogInformation
from magfusion.estimation.batch.joint_log import OfLog
from magfusion.estimation.batch.preprocessed_log import WarmStart
from magfusion.estimation.posterior.marginalized_log import MarginalizedLog
from magfusion.estimation.posterior.noise_tuning import Tuned
from magfusion.files.kept import StoredArrays, load_kept, save_kept
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import AnyArray, Array

File = TypeVar("File")

_STATES = (
    "time",
    "world_from_body",
    "position_world",
    "velocity_world",
    "gyro_bias_body",
    "accel_bias_body",
)
_RIVAL = "rival_"
_SCALARS = ("reference_time", "imu_begin", "time_offset", "clock_rate")


class Kept(NamedTuple):
    """A log alone, or after a round.

    `facts`: of the table of logs, when it was smoothed alone.
    """

    log: OfLog
    facts: dict[str, Any]


class StoredInformation(NamedTuple):
    """Information of a log, or of several, on the shared calibration.

    `blocks`: those of one log; None of a sum, which is on the parameters of all logs.
    """

    information: LogInformation
    blocks: LogBlocks | None

    def whole(self, calendar: Calendar) -> LogInformation:
        """Return the information on the parameters of all logs."""
        if self.blocks is None:
            return self.information
        return calendar.whole(self.information, self.blocks)


def save_information(
    path: Path, information: LogInformation, blocks: LogBlocks | None = None
) -> None:
    """Write the information of one log, or of several, on the shared calibration."""
    logs = np.broadcast_to(information.logs, information.step.shape)
    arrays = {"step": information.step, "logs": logs, **vars(information.part)}
    save_kept(path, "", StoredArrays(arrays, {"blocks": blocks}))


def load_information(path: Path) -> StoredInformation:
    """Return the information of one log, or of several, on the shared calibration."""
    arrays, facts = written_by_worker(path, load_kept(path, ""))
    part = MarginalizedLog(**{k: v for k, v in arrays.items() if k not in ("step", "logs")})
    information = LogInformation(arrays["step"], part, arrays["logs"])
    if facts["blocks"] is None:
        return StoredInformation(information, None)
    time, platform, *names = facts["blocks"]
    shared, considered = (tuple(BlockName(*name) for name in part) for part in names)
    return StoredInformation(information, LogBlocks(time, platform, shared, considered))


def written_by_worker(path: Path, stored: File | None) -> File:
    """Return what was stored in a file that a worker has written.

    Raises InputError where there is nothing.
    """
    if stored is None:
        raise InputError(
            f"{path}: cannot be read, though another worker wrote it; choose an --output on a file"
            " system that all workers share"
        )
    return stored


def save_log(path: Path, key: str, kept: Kept) -> None:
    """Write a log alone or after a round."""
    log, begun = kept.log, kept.log.begun
    arrays: dict[str, AnyArray] = {**_of_states(begun.states, "")}
    if begun.rival is not None:
        arrays |= _of_states(begun.rival, _RIVAL)
    arrays |= {
        "steps": log.steps,
        "standing": log.standing,
        "phase": begun.declared.phase,
        "drift": begun.declared.drift,
        "chosen": begun.start.chosen,
        "determined": begun.start.determined,
        "said_step": log.information.step,
    }
    arrays |= {f"said_{name}": part for name, part in vars(log.information.part).items()}
    facts = {
        "table": kept.facts,
        "noise": [[t.owner, t.key, t.declared, t.estimated] for t in log.noise],
        "rival_chi_square": begun.rival_chi_square,
        **{name: getattr(begun.declared, name) for name in _SCALARS},
    }
    save_kept(path, key, StoredArrays(arrays, facts))


def load_log(path: Path, key: str, site: Site) -> Kept | None:
    """Return the log written under a key; None where there is none."""
    kept = load_kept(path, key)
    if kept is None:
        return None
    arrays, facts = kept
    declared = initial_calibration(site, facts["reference_time"], facts["imu_begin"])
    declared = replace(
        declared,
        phase=arrays["phase"],
        drift=arrays["drift"],
        time_offset=facts["time_offset"],
        clock_rate=facts["clock_rate"],
    )
    states = _states_in(arrays, "")
    start = Start(
        states=states,
        phase=np.zeros((len(arrays["chosen"]), len(site.channels))),
        chosen=np.asarray(arrays["chosen"], dtype=np.int64),
        cost=0.0,
        determined=np.asarray(arrays["determined"], dtype=bool),
    )
    rival = _states_in(arrays, _RIVAL) if f"{_RIVAL}time" in arrays else None
    begun = WarmStart(states, declared, start, facts["rival_chi_square"], rival)
    part = MarginalizedLog(
        **{name: arrays[f"said_{name}"] for name in MarginalizedLog.__dataclass_fields__}
    )
    noise = tuple(Tuned(*one) for one in facts["noise"])
    standing = np.asarray(arrays["standing"], dtype=bool)
    information = LogInformation(arrays["said_step"], part)
    return Kept(OfLog(begun, arrays["steps"], noise, standing, information), facts["table"])


def _of_states(states: Trajectory, prefix: str) -> dict[str, Array]:
    result = {f"{prefix}{name}": getattr(states, name) for name in _STATES}
    return {name: value for name, value in result.items() if value is not None}


def _states_in(arrays: Any, prefix: str) -> Trajectory:
    return Trajectory(**{n: arrays[f"{prefix}{n}"] for n in _STATES if f"{prefix}{n}" in arrays})
