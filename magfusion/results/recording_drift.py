"""Recording of days of errors for the rerun viewer: time series with their sigmas, thinned."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magfusion.results.drift import QUANTITIES, EstimatorPlot, Quantity, worlds_text
from magfusion.results.recording_file import whole_recording
from magfusion.results.recording_layout import about_zero, layout, plot, readable_range, span_of
from magfusion.results.recording_trust import BANNER, banner_text
from magfusion.units import HOUR, Array

MAX_POINTS = 5000  # of a series
_COLOURS = ([220, 60, 60], [60, 160, 60], [60, 90, 220])
_UPDATE, _MEMORY = "update_ms", "memory_mib"
_PACE = {_UPDATE: "processor time of an update (ms)", _MEMORY: "memory (MiB)"}
_SIGMA = [150, 150, 150]


def write_drift_recording(
    path: Path, courses: list[EstimatorPlot], figures: Mapping[str, object]
) -> None:
    """Write a recording of errors, memory and times over the simulated hours."""
    with whole_recording(path, "drift") as recording:
        for course in courses:
            _log_errors(recording, course)
            _log_consistency(recording, course)
            _log_pace(recording, course)
        notes = figures["notes"]
        assert isinstance(notes, list)
        _write(recording, "judgements", "\n".join(f"- {note}" for note in notes))
        text = _banner(figures, notes)
        _write(recording, BANNER, text)
        recording.send_blueprint(_blueprint(courses, (BANNER, text)))


def _write(recording: rr.RecordingStream, place: str, text: str) -> None:
    document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
    recording.log(place, document, static=True)


def _banner(figures: Mapping[str, object], notes: list[str]) -> str:
    run = f"{figures['hours']:g} h, {worlds_text(figures['worlds'])}"
    lines = [f"- {run}; errors of the first world, all judgements on the right"]
    failed = [note for note in notes if note.startswith("FAIL")]
    return banner_text(str(figures["verdict"]), [*lines, *(f"- **{note}**" for note in failed)])


def _log_errors(recording: rr.RecordingStream, course: EstimatorPlot) -> None:
    errors = course.errors
    rows = _thinned(len(errors))
    for quantity in QUANTITIES:
        place = _place(course, quantity)
        error, sigma = _drawn(course, quantity)
        _send(
            recording, f"{place}/error", errors.time[rows], error[rows], ["x", "y", "z"], _COLOURS
        )
        both = np.stack([-sigma, sigma], axis=1)[rows]
        names = ["-3 sigma", "+3 sigma"]
        _send(recording, f"{place}/sigma", errors.time[rows], both, names, [_SIGMA, _SIGMA])


def _place(course: EstimatorPlot, quantity: Quantity) -> str:
    return f"{course.name}/{quantity.name}_{quantity.unit}"


def _drawn(course: EstimatorPlot, quantity: Quantity) -> tuple[Array, Array]:
    """Return the error, shape (n, 3), and three sigmas of its widest axis, in the unit."""
    errors = course.errors
    error = quantity.scale * errors.error[:, quantity.part]
    return error, 3.0 * quantity.scale * np.max(errors.sigma[:, quantity.part], axis=1)


def _log_consistency(recording: rr.RecordingStream, course: EstimatorPlot) -> None:
    time, levels = _hourly(course)
    for (name, level), colour in zip(levels.items(), _COLOURS, strict=True):
        place = f"{course.name}/consistency/{name}"
        _send(recording, place, time, level[:, None], [name], [colour])


def _hourly(course: EstimatorPlot) -> tuple[Array, dict[str, Array]]:
    """Return hourly means, the first and the last extended to the ends: one hour is a line too."""
    hours, levels = course.hourly()
    ends = course.errors.time[[0, -1]]
    time = np.concatenate([ends[:1], np.clip(HOUR * hours, *ends), ends[1:]])
    return time, {name: np.pad(level, 1, mode="edge") for name, level in levels.items()}


def _log_pace(recording: rr.RecordingStream, course: EstimatorPlot) -> None:
    for name, (time, values) in _pace(course).items():
        place = f"{course.name}/{name}"
        _send(recording, place, time, values[:, None], [name], [_COLOURS[2]])


def _pace(course: EstimatorPlot) -> dict[str, tuple[Array, Array]]:
    built = course.pace[course.pace[:, 2] > 0.0]
    built = built[_thinned(len(built))]
    spent = 1e3 * built[:, 1] / built[:, 2]
    return {_UPDATE: (built[:, 0], spent), _MEMORY: (built[:, 0], built[:, 3])}


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
    return slice(None, None, max(1, -(-count // MAX_POINTS)))


def _blueprint(courses: list[EstimatorPlot], banner: tuple[str, str]) -> rrb.Blueprint:
    tabs = [
        _side_by_side(courses, QUANTITIES[:2], "Position and attitude"),
        _side_by_side(courses, QUANTITIES[2:], "Biases"),
        _own_columns(courses),
    ]
    verdicts = rrb.TextDocumentView(origin="judgements", name="Judgements")
    return layout(rrb.Tabs(*tabs), verdicts, shares=(3, 1), banner=banner)


def _side_by_side(
    courses: list[EstimatorPlot], quantities: tuple[Quantity, ...], name: str
) -> rrb.Horizontal:
    """Return a column per estimator, errors of one quantity on one scale."""
    columns = []
    values = {q.name: about_zero(*(s for c in courses for s in _drawn(c, q))) for q in quantities}
    for course in courses:
        views = [
            plot(
                _place(course, q),
                f"{_title(course)}: {q.name.replace('_', ' ')} error ({q.symbol})",
                span_of(course.errors.time),
                values[q.name],
            )
            for q in quantities
        ]
        columns.append(rrb.Vertical(*views))
    return rrb.Horizontal(*columns, name=name)


def _own_columns(courses: list[EstimatorPlot]) -> rrb.Horizontal:
    columns = []
    for course in courses:
        span, (_, levels) = span_of(course.errors.time), _hourly(course)
        squared = readable_range(np.ones(1), *levels.values(), zero=True)
        name = f"{_title(course)}: hourly squares relative to the estimated (1 expected)"
        views = [plot(f"{course.name}/consistency", name, span, squared)]
        for place, (_, values) in _pace(course).items():
            title = f"{_title(course)}: {_PACE[place]}"
            own = readable_range(values, zero=True)
            views.append(plot(f"{course.name}/{place}", title, span, own, legend=False))
        columns.append(rrb.Vertical(*views))
    return rrb.Horizontal(*columns, name="Consistency, time and memory")


def _title(course: EstimatorPlot) -> str:
    return course.name.upper() if course.name == "ekf" else course.name.capitalize()
