"""Recording of days of errors for the rerun viewer: time series with their sigmas, thinned."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magfusion.results.drift import HOUR, QUANTITIES, Course
from magfusion.results.recording_file import whole_recording
from magfusion.units import Array

MOST_POINTS = 5000  # of a series
_COLOURS = ([220, 60, 60], [60, 160, 60], [60, 90, 220])
_SIGMA = [150, 150, 150]


def write_drift_recording(path: Path, courses: list[Course], figures: Mapping[str, object]) -> None:
    """Write a recording of errors, memory and times over the simulated hours."""
    with whole_recording(path, "drift") as recording:
        for course in courses:
            _log_errors(recording, course)
            _log_consistency(recording, course)
            _log_pace(recording, course)
        notes = figures["notes"]
        assert isinstance(notes, list)
        legend = rr.TextDocument(
            "\n".join(f"- {note}" for note in notes), media_type=rr.MediaType.MARKDOWN
        )
        recording.log("verdict", legend, static=True)
        recording.send_blueprint(_blueprint(courses))


def _log_errors(recording: rr.RecordingStream, course: Course) -> None:
    errors = course.errors
    rows = _thinned(len(errors))
    for quantity in QUANTITIES:
        place = f"{course.name}/{quantity.name}_{quantity.unit}"
        error = quantity.scale * errors.error[rows][:, quantity.part]
        sigma = 3.0 * quantity.scale * np.max(errors.sigma[rows][:, quantity.part], axis=1)
        _send(recording, f"{place}/error", errors.time[rows], error, ["x", "y", "z"], _COLOURS)
        both = np.stack([-sigma, sigma], axis=1)
        names = ["-3 sigma", "+3 sigma"]
        _send(recording, f"{place}/sigma", errors.time[rows], both, names, [_SIGMA, _SIGMA])


def _log_consistency(recording: rr.RecordingStream, course: Course) -> None:
    hours, levels = course.hourly()
    for (name, level), colour in zip(levels.items(), _COLOURS, strict=True):
        place = f"{course.name}/consistency/{name}"
        _send(recording, place, HOUR * hours, level[:, None], [name], [colour])


def _log_pace(recording: rr.RecordingStream, course: Course) -> None:
    made = course.pace[course.pace[:, 2] > 0.0]
    made = made[_thinned(len(made))]
    spent = 1e3 * made[:, 1] / made[:, 2]
    for name, values in (("update_ms", spent), ("memory_mib", made[:, 3])):
        place = f"{course.name}/pace/{name}"
        _send(recording, place, made[:, 0], values[:, None], [name], [_COLOURS[2]])


def _send(
    recording: rr.RecordingStream,
    place: str,
    time: Array,
    values: Array,
    names: list[str],
    colours: list[list[int]] | tuple[list[int], ...],
) -> None:
    recording.log(place, rr.SeriesLines(names=names, colors=list(colours)), static=True)
    columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
    recording.send_columns(place, [rr.TimeColumn("time", duration=time)], columns)


def _thinned(count: int) -> slice:
    return slice(None, None, max(1, -(-count // MOST_POINTS)))


def _blueprint(courses: list[Course]) -> rrb.Blueprint:
    columns = []
    for course in courses:
        parts = [f"{q.name}_{q.unit}" for q in QUANTITIES] + ["consistency", "pace"]
        views = [
            rrb.TimeSeriesView(origin=f"{course.name}/{part}", name=f"{course.name} {part}")
            for part in parts
        ]
        columns.append(rrb.Vertical(*views))
    verdict = rrb.TextDocumentView(origin="verdict", name="Verdict")
    return rrb.Blueprint(
        rrb.Horizontal(*columns, verdict),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )
