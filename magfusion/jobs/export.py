"""The job that exports a result: as a ROS 2 bag, TUM, KITTI or CSV."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

from magfusion.errors import InputError
from magfusion.files.odometry_bag import Frames
from magfusion.files.result_states import read_result_states
from magfusion.files.trajectory_formats import (
    BAGS,
    FORMATS,
    Format,
    format_of,
    refuse_place,
    write_states,
)
from magfusion.jobs.settings import Command, FrameSettings, argument, option
from magfusion.model.progress import Report, quiet
from magfusion.results.figures import Figure, Figures, Section

_NAMESPACE = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)


@dataclass(frozen=True, kw_only=True)
class ExportSettings(FrameSettings):
    """Settings of the export."""

    result: Path = argument("Result directory, or a table of states in it")
    format: Format | None = option(None, "File format", note="default: from the file's extension")
    namespace: str = option("/magfusion", "Namespace of the topics odometry and pose, in a bag")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAMESPACE.fullmatch(self.namespace):
            raise InputError(f"--namespace must be of the form /robot/nav; got {self.namespace!r}")

    def format_of(self, output: Path) -> Format:
        """Return the format of a file."""
        if self.format is not None:
            return self.format
        form = format_of(output)
        if form is not None:
            return form
        raise InputError(
            f"{output}: unknown file extension; use one of"
            f" {', '.join('.' + one for one in FORMATS)}, or give --format"
        )


def run_export(settings: ExportSettings, output: Path, report: Report = quiet) -> Figures:
    """Write the states of a result that have a pose, with stamps of the log's clock."""
    from magfusion.jobs.inputs import named

    form = settings.format_of(output)
    path, reported = _source(settings.result)
    refuse_place(output)
    states = read_result_states(path)
    if output.exists() and output.samefile(path):
        raise InputError(f"{output}: is the result itself; give another path")
    total = len(states.stamp_ns)
    frames = None
    if form in BAGS:
        frames = Frames(settings.frame, settings.child, settings.namespace)
    with named(path):
        write_states(states, output, form, frames, lambda k: report("writing", k, total))
    figures = [
        Figure("job", "export", section=Section.TITLE),
        Figure("result", settings.result.name or str(settings.result), section=Section.TITLE),
        Figure("file", str(output)),
        Figure("format", form),
        Figure("states", total, label="states written"),
        Figure("states_failed", states.left_out, label="states without a pose, omitted"),
    ]
    lost_epochs = reported.get("lost_epochs")
    if isinstance(lost_epochs, int):
        figures.append(Figure("lost_epochs", lost_epochs, label="states lost, without a row"))
    if "verdict" in reported:
        figures.append(
            Figure("result_verdict", str(reported["verdict"]), label="verdict of the result")
        )
    return Figures(*figures)


def _source(result: Path) -> tuple[Path, dict[str, object]]:
    """Return the table of a result, and its report if there is one."""
    if not result.is_dir():
        if result.suffix not in (".parquet", ".csv"):
            raise InputError(
                f"{result}: is not a result; give the directory of a job's result, or a table of"
                " states (.parquet, .csv)"
            )
        return result, {}
    try:
        reported = json.loads((result / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        reported = {}
    reported = reported if isinstance(reported, dict) else {}
    table = result / "trajectory.parquet"
    if not table.is_file():
        if reported.get("verdict") == "failed":
            raise InputError(
                f"{result}: its verdict is failed, so that there is no trajectory to export; see"
                " its report.json for the reason"
            )
        raise InputError(
            f"{result}: has no trajectory.parquet; give the result of smooth, fix or navigate"
        )
    return table, reported


COMMAND = Command(
    ExportSettings,
    run_export,
    output_required=True,
    output_file="Output file, which is replaced",
    example="magfusion export run -o run.mcap --frame map --child base_link",
)
