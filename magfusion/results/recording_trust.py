"""Trust in a recording: the verdict above all, doubtful states, protection levels."""

from typing import NamedTuple

import numpy as np
import rerun as rr

from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import StateTrust, Trust, Verdict
from magfusion.results.errors import TrajectoryErrors
from magfusion.results.recording_plots import AXES, SIGMA, log_series, rows_of
from magfusion.results.verdict import look_of
from magfusion.units import Array

BANNER = "verdict"  # entity
_MARK = {Verdict.TRUSTWORTHY: "✔", Verdict.DOUBTFUL: "⚠", Verdict.FAILED: "✖"}
_DOUBTFUL, _FAILED = (250, 190, 40), (235, 60, 60)
_LEVEL = (250, 190, 40)


class LevelPlot(NamedTuple):
    """A plot of the length of an error and its protection level."""

    place: str
    name: str
    scale: float  # from SI to the unit
    part: slice  # of the pose's covariance

    def of(self, states: StateTrust) -> Array:
        """Return the protection level in the plot's unit, shape (n,)."""
        position = "position" in self.place
        return 1e3 * states.protection_level_m if position else states.protection_level_deg

    def error(self, errors: TrajectoryErrors) -> Array:
        """Return the length of the error in the plot's unit, shape (n,)."""
        own = errors.position_world if "position" in self.place else errors.attitude_body
        return np.asarray(self.scale * np.linalg.norm(own, axis=1))


LEVELS = (
    LevelPlot("plots/position_level_mm", "Protection (mm)", 1e3, slice(3, 6)),
    LevelPlot("plots/attitude_level_deg", "Protection (deg)", float(np.rad2deg(1.0)), slice(0, 3)),
)


def banner_text(verdict: str, lines: list[str]) -> str:
    """Return the verdict as a heading, and lines below it."""
    return "\n".join([f"## {_MARK[look_of(verdict)]} {verdict.upper()}", "", *lines])


def log_verdict(recording: rr.RecordingStream, trust: Trust, summary: str) -> tuple[str, str]:
    """Write the verdict, its reasons, and unverified parameters; return entity and text."""
    lines = [f"- {summary}", *(f"- **{reason.text}**" for reason in trust.reasons)]
    lines += [f"- *findings:* {remark.text}" for remark in trust.remarks]
    if trust.unverified:
        names = ", ".join(one.name for one in trust.unverified)
        lines.append(f"- *fixed, not observable in this log:* {names}")
    text = banner_text(trust.verdict, lines)
    recording.log(BANNER, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
    return BANNER, text


def log_doubtful(
    recording: rr.RecordingStream, trajectory: Trajectory, states: StateTrust, radius: float
) -> None:
    """Mark the untrusted states on the path, where not all have the same verdict."""
    if len(set(states.verdict)) < 2:
        return
    for verdict, colour in ((Verdict.DOUBTFUL, _DOUBTFUL), (Verdict.FAILED, _FAILED)):
        own = trajectory.position_world[[v is verdict for v in states.verdict]]
        if len(own):
            points = rr.Points3D(own[rows_of(len(own))], radii=radius, colors=colour)
            recording.log(f"world/estimate/{verdict}", points, static=True)


def has_levels(states: StateTrust | None) -> bool:
    """Return whether any state has a protection level."""
    return states is not None and bool(np.any(np.isfinite(states.protection_level_m)))


def log_levels(
    recording: rr.RecordingStream,
    trajectory: Trajectory,
    states: StateTrust,
    errors: TrajectoryErrors | None,
) -> None:
    """Draw the protection levels with three sigmas and the errors' lengths."""
    if not has_levels(states):
        return
    for kind in LEVELS:
        style = rr.SeriesLines(
            colors=_LEVEL, names="protection level: bound of undetected errors", widths=1.5
        )
        log_series(recording, f"{kind.place}/level", trajectory.time, kind.of(states), style)
        if trajectory.pose_cov is not None:
            widest = np.linalg.eigvalsh(trajectory.pose_cov[:, kind.part, kind.part])[:, -1]
            style = rr.SeriesLines(colors=SIGMA, names="3 sigma of the widest axis", widths=1.0)
            sigma = 3.0 * kind.scale * np.sqrt(widest)
            log_series(recording, f"{kind.place}/three_sigma", trajectory.time, sigma, style)
        if errors is not None:
            style = rr.SeriesLines(colors=AXES["x"], names="error", widths=1.5)
            log_series(recording, f"{kind.place}/error", errors.time, kind.error(errors), style)
