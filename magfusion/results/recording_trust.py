"""What a recording shows of trust: the verdict above all, doubtful states, protection levels."""

import numpy as np
import rerun as rr

from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import StateTrust, Trust, Verdict
from magfusion.results.errors import TrajectoryErrors
from magfusion.results.recording_plots import AXES, SIGMA, log_series, rows_of
from magfusion.units import Array

BANNER = "verdict"  # entity
LEVELS = {
    "plots/position_level_mm": "Position: level (mm)",
    "plots/attitude_level_deg": "Attitude: level (deg)",
}
_DOUBTFUL, _FAILED = (250, 190, 40), (235, 60, 60)
_LEVEL = (250, 190, 40)


def log_verdict(recording: rr.RecordingStream, trust: Trust) -> None:
    """Write the verdict, its reasons, and what nothing has checked."""
    lines = [f"## {str(trust.verdict).upper()}", ""]
    lines += [f"- {reason.text}" for reason in trust.reasons]
    lines += [f"- *noticed:* {remark.text}" for remark in trust.remarks]
    if trust.unverified:
        names = ", ".join(one.name for one in trust.unverified)
        lines.append(f"- *held, and not checked by these data:* {names}")
    document = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    recording.log(BANNER, document, static=True)


def log_doubtful(
    recording: rr.RecordingStream, trajectory: Trajectory, states: StateTrust, radius: float
) -> None:
    """Mark the states that are not trusted on the path, where they are not all alike."""
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
    """Draw the protection levels beside three sigmas, and as a band about the errors."""
    if not has_levels(states):
        return
    kinds = (
        ("position", "mm", 1e3, 1e3 * states.protection_level_m, slice(3, 6)),
        ("attitude", "deg", np.rad2deg(1.0), states.protection_level_deg, slice(0, 3)),
    )
    for name, unit, scale, shown, part in kinds:
        place = f"plots/{name}_level_{unit}"
        style = rr.SeriesLines(colors=_LEVEL, names="protection level", widths=1.5)
        log_series(recording, f"{place}/level", trajectory.time, shown, style)
        if trajectory.pose_cov is not None:
            widest = np.linalg.eigvalsh(trajectory.pose_cov[:, part, part])[:, -1]
            style = rr.SeriesLines(colors=SIGMA, names="3 sigma, widest", widths=1.0)
            sigma = 3.0 * scale * np.sqrt(widest)
            log_series(recording, f"{place}/three_sigma", trajectory.time, sigma, style)
        if errors is None:
            continue
        size = scale * np.linalg.norm(_error(errors, name), axis=1)
        style = rr.SeriesLines(colors=AXES["x"], names="error", widths=1.5)
        log_series(recording, f"{place}/error", errors.time, size, style)
        names = ["+ protection level", "- protection level"]
        band = rr.SeriesLines(colors=[_LEVEL, _LEVEL], names=names, widths=[1.0, 1.0])
        both = shown[:, None] * np.array([1.0, -1.0])
        for axis in AXES:
            own = f"plots/{name}_error_{unit}/{axis}/protection_level"
            log_series(recording, own, trajectory.time, both, band)


def _error(errors: TrajectoryErrors, name: str) -> Array:
    return errors.position_world if name == "position" else errors.attitude_body
