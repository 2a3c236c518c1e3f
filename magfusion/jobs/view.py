"""The job that opens the recording of a result in the viewer."""

from dataclasses import dataclass
from pathlib import Path

from magfusion.errors import InputError
from magfusion.jobs.settings import Command, Settings, argument


@dataclass(frozen=True, kw_only=True)
class ViewSettings(Settings):
    """Recording to show."""

    result: Path = argument("Result directory, or its run.rrd")


def run_view(settings: ViewSettings) -> None:
    """Open a recording in a separate viewer."""
    from magfusion.results.recording import open_viewer

    result = settings.result
    path = result / "run.rrd" if result.is_dir() else result
    if not path.is_file():
        raise InputError(f"{path}: has no recording; run magfusion smooth first")
    with path.open("rb") as stream:
        if stream.read(3) != b"RRF":
            raise InputError(f"{path}: not a recording; give a result's directory or its run.rrd")
    open_viewer(path)


COMMAND = Command(ViewSettings, run_view, reports=False, example="magfusion view run")
