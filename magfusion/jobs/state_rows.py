"""The states of a run along a log as rows of a file, with their findings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.estimation.online_integrity.levels import Levels, find
from magfusion.model.site import Site
from magfusion.units import Array

if TYPE_CHECKING:
    from magfusion.estimation.online.navigator import Navigator
    from magfusion.estimation.online_integrity.judgement import JudgedState
    from magfusion.files.row_file import RowFile, RowPosition

# Kind of a row: an epoch's state as first estimated, as it left the window, or propagated.
CURRENT, LAGGED, PROPAGATED = 0.0, 1.0, 2.0
STATE = {
    "time": 1,
    "world_from_body": 9,
    "position_world": 3,
    "velocity_world": 3,
    "accel_bias_body": 3,
    "gyro_bias_body": 3,
}
TOGETHER = 32  # rows whose levels are found at once


def row_columns(site: Site) -> dict[str, int]:
    """Return the stored columns of each state, with their number of values."""
    beacons = len(site.beacons)
    reported = {
        "lagged": 1,
        "reset_counter": 1,
        "latency": 1,
        "verdict": 1,
        "levels": 2,
        "pose_cov": 36,
    }
    return reported | STATE | {"distortion": beacons, "excluded": beacons, "heard": beacons}


class StateRows:
    """Rows of a run, of which the newest are buffered.

    `rows`: of `row_columns`.
    """

    def __init__(self, rows: RowFile) -> None:
        self._rows = rows
        self._waiting: list[tuple[dict[str, Array | float], Levels]] = []

    def add(self, navigator: Navigator, state: JudgedState, latency: float, kind: float) -> None:
        """Add a new state of a navigator; the latency (s) is NaN if there is none."""
        levels = state.judgement.levels or Levels((None, None))
        self._waiting.append((_row(navigator, state, latency, kind), levels))
        if len(self._waiting) == TOGETHER:
            self._write()

    @property
    def path(self) -> Path:
        """The file."""
        return self._rows.path

    def rows(self) -> dict[str, Array]:
        """Return all rows by column, shape (rows, numbers) each."""
        self._write()
        return self._rows.rows()

    def settle(self) -> RowPosition:
        """Write all rows to the disk; return the length of the file."""
        self._write()
        return self._rows.settle()

    def close(self) -> None:
        """Close the file."""
        self._rows.close()

    def _write(self) -> None:
        if not self._waiting:
            return
        own, levels = zip(*self._waiting, strict=True)
        self._waiting = []
        find(levels)
        rows = {name: np.array([row[name] for row in own]) for name in own[0]}
        rows["levels"] = np.array([one.values for one in levels], dtype=np.float64)
        self._rows.extend(rows)


def _row(
    navigator: Navigator, state: JudgedState, latency: float, kind: float
) -> dict[str, Array | float]:
    """Return a state as a row of `row_columns`, without its levels."""
    level, names = navigator.distortion, [b.name for b in navigator.site.beacons]
    excluded, detected = state.judgement.excluded, state.judgement.detected
    return {name: getattr(state, name) for name in STATE} | {
        "lagged": kind,
        "reset_counter": float(state.reset_counter),
        "latency": latency,
        "verdict": float(state.verdict.rank),
        "pose_cov": state.cov[:6, :6].copy(),
        "distortion": np.array([level.get(name, np.nan) for name in names]),
        "excluded": np.array([float(name in excluded) for name in names]),
        "heard": np.array([float(name in detected) for name in names]),
    }
