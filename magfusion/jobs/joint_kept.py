"""File of a log that was smoothed alone, among several; a rerun resumes from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magfusion.estimation.batch.chain import Start
from magfusion.estimation.batch.joint import LogReport
from magfusion.estimation.batch.joint_log import OfLog
from magfusion.estimation.batch.preprocessed_log import WarmStart
from magfusion.estimation.posterior.marginalized_log import MarginalizedLog
from magfusion.estimation.posterior.noise_tuning import Tuned
from magfusion.files.kept import StoredArrays, load_kept, save_kept
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import AnyArray, Array

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


class Alone(NamedTuple):
    """A log that was smoothed alone.

    Parameters
    ----------
    log : OfLog, optional
        None where it failed.
    facts : dict
        Of the table of logs.
    """

    log: OfLog | None
    facts: dict[str, Any]


def save_alone(path: Path, key: str, alone: Alone) -> None:
    """Write a log that was smoothed alone."""
    assert alone.log is not None
    log, begun = alone.log, alone.log.begun
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
        "said_step": log.report.step,
    }
    arrays |= {f"said_{name}": part for name, part in vars(log.report.part).items()}
    facts = {
        "table": alone.facts,
        "noise": [[t.owner, t.key, t.declared, t.estimated] for t in log.noise],
        "rival_chi_square": begun.rival_chi_square,
        **{name: getattr(begun.declared, name) for name in _SCALARS},
    }
    save_kept(path, key, StoredArrays(arrays, facts))


def load_alone(path: Path, key: str, site: Site) -> Alone | None:
    """Return the log smoothed alone under a key; None where there is none."""
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
    findings = LogReport(arrays["said_step"], part)
    return Alone(OfLog(begun, arrays["steps"], noise, standing, findings), facts["table"])


def _of_states(states: Trajectory, prefix: str) -> dict[str, Array]:
    result = {f"{prefix}{name}": getattr(states, name) for name in _STATES}
    return {name: value for name, value in result.items() if value is not None}


def _states_in(arrays: Any, prefix: str) -> Trajectory:
    return Trajectory(**{n: arrays[f"{prefix}{n}"] for n in _STATES if f"{prefix}{n}" in arrays})
