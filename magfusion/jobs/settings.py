"""Settings of jobs: fields with help, unit and bounds.

The command line is generated from them (`magfusion.cli`) before BLAS threads are set, so NumPy is
not imported here, and gtsam, rerun and matplotlib only inside ``run``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from magfusion.errors import InputError
from magfusion.model.groups import GROUPS

if TYPE_CHECKING:
    from magfusion.jobs.inputs import Job
    from magfusion.model.trust import Risk
    from magfusion.receiver.windows import LockinSettings


class Option(NamedTuple):
    """Command-line properties of a field.

    Parameters
    ----------
    help : str
        Without unit, bounds, note and full stop, which are appended.
    name : str, optional
        Of the option, if not the field's.
    unit : str
        Written after a number.
    least, most, above : float, optional
        Bounds; ``above`` is the one that is excluded.
    note : str
        Additional remark, such as a default that is not a value.
    words : mapping, optional
        The choices: typed word and its value.
    metavar : str, optional
        Placeholder of a text.
    positional : bool
        An argument rather than an option.
    common : bool
        Used by many jobs; listed after a job's own.
    """

    help: str
    name: str | None = None
    unit: str = ""
    least: float | None = None
    most: float | None = None
    above: float | None = None
    note: str = ""
    words: Mapping[str, object] | None = None
    metavar: str | None = None
    positional: bool = False
    common: bool = False

    @property
    def sentence(self) -> str:
        """Help with unit, bounds and note."""
        bounded = self.least is not None and self.most is not None
        bounds = f"{self.least:g} to {self.most:g}" if bounded else ""
        quantity = " ".join(filter(None, (bounds, self.unit)))
        text = f"{self.help}, {quantity}" if quantity else self.help
        return (f"{text}; {self.note}" if self.note else text) + "."

    def check(self, name: str, value: float) -> None:
        """Raise an error for a number out of bounds, or NaN."""
        unit = f" {self.unit}" if self.unit else ""
        least, most, above = self.least, self.most, self.above
        if least is not None and most is not None:
            wrong, rule = not least <= value <= most, f"lie between {least:g} and {most:g}{unit}"
        elif above is not None:
            wrong, rule = not above < value < math.inf, f"be above {above:g}{unit}"
        elif least == 0.0 and isinstance(value, int):
            wrong, rule = value < 0, "not be negative"
        elif least is not None:
            wrong, rule = not least <= value < math.inf, f"be at least {least:g}{unit}"
        else:
            return
        if wrong:
            raise InputError(f"--{name} must {rule}; got {value:g}")


def option(default: Any, help: str, **facts: Any) -> Any:
    """Return a field that is an option; for ``facts`` see `Option`."""
    return dataclasses.field(default=default, metadata={"option": Option(help, **facts)})


def argument(help: str, default: Any = dataclasses.MISSING, **facts: Any) -> Any:
    """Return a positional field; it is required if it has no default."""
    requested = {"option": Option(help, positional=True, **facts)}
    return dataclasses.field(default=default, metadata=requested)


def required(help: str, **facts: Any) -> Any:
    """Return a required option."""
    return dataclasses.field(metadata={"option": Option(help, **facts)})


def options(settings: type[Settings]) -> list[tuple[dataclasses.Field[Any], Option]]:
    """Return the fields that are options, a job's own before those of many jobs."""
    result = [(f, f.metadata["option"]) for f in dataclasses.fields(settings) if f.metadata]
    return sorted(result, key=lambda pair: pair[1].common)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of one run of a job.

    Raises InputError where a number is out of its bounds.
    """

    def __post_init__(self) -> None:
        for field, requested in options(type(self)):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and not isinstance(value, bool):
                requested.check(requested.name or field.name.replace("_", "-"), value)


OVERWRITE = "Replace an earlier result there, instead of moving it to the next free name (.1, .2)"


class Command(NamedTuple):
    """Call of a job; its name and description are in `magfusion.jobs.JOBS`.

    Parameters
    ----------
    run : callable
        Takes the settings and, of these, those it names: ``output``, the directory of results;
        ``report``, to report the progress; ``given``, the names of the given options.  Returns the
        figures of the report, if any.
    output : str, optional
        Default directory of results; if None, it is named by the log and the job.
    output_optional : bool
        Whether it writes only if ``--output`` is given.
    reports : bool
        Whether it returns a report, which ``--json`` prints.
    output_file : str
        Help of ``--output`` of a job that writes one file instead of a directory of results.
    fails : bool
        Whether a failed verdict ends it with exit code 1.
    after : callable, optional
        Called with settings and output after the result is shown.
    example : str
        Example at the end of the help.
    """

    settings: type[Settings]
    run: Callable[..., Any]
    output: str | None = None
    output_required: bool = False
    output_optional: bool = False
    reports: bool = True
    output_file: str = ""
    fails: bool = True
    after: Callable[[Any, Path], None] | None = None
    example: str = ""

    @property
    def output_help(self) -> str:
        """Help of ``--output``; `magfusion.cli` appends its default."""
        return self.output_file or "Directory of the results"


@dataclass(frozen=True, kw_only=True)
class TopicSettings(Settings):
    """Topics of a bag with several of one type."""

    topics: str | None = option(
        None,
        "Topics for a bag with several of a type, e.g. imu=/imu/data,magnetometer=/mag,truth=/odom",
        metavar="ROLE=NAME,...",
        common=True,
    )


@dataclass(frozen=True, kw_only=True)
class PartSettings(TopicSettings):
    """A log, and the part of it to use."""

    log: Path = argument("Log: a directory, a EuRoC folder, or a bag of ROS")
    start: float | None = option(
        None, "Start of the part to use", unit="s since its epoch", common=True
    )
    end: float | None = option(
        None, "End of the part to use", unit="s since its epoch", common=True
    )


@dataclass(frozen=True, kw_only=True)
class LogSettings(PartSettings):
    """A log with its site."""

    site: Path | None = option(None, "Site file", note="default: site.yaml in the log")

    def job(self, output: Path) -> Job:
        """Return inputs and output of a job on a log."""
        from magfusion.jobs.inputs import Job, topics_option

        if self.start is not None and self.end is not None and not self.start < self.end:
            raise InputError(f"--start must come before --end; got {self.start:g} and {self.end:g}")
        return Job(self.log, self.site, output, self.start, self.end, topics_option(self.topics))


@dataclass(frozen=True, kw_only=True)
class LogsSettings(LogSettings):
    """A log, or several of one site that are refined together."""

    more: tuple[Path, ...] = argument("More logs of the same site, to refine it jointly", ())
    cluster: str | None = option(
        None, "Dask scheduler, tcp://host:8786, with access to logs and results; for several logs"
    )
    workers: int | None = option(
        None, "Processes on this machine; for several logs", note="default: one a core"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.more and (self.cluster is not None or self.workers is not None):
            raise InputError("--cluster and --workers are for several logs; one log was given")

    def jobs(self, output: Path) -> list[Job]:
        """Return a job for every log."""
        first = self.job(output)
        return [first, *(dataclasses.replace(first, log_path=path) for path in self.more)]


LOWEST_MAINS = 10.0  # Hz; below, its harmonics would be fitted to the motion


@dataclass(frozen=True, kw_only=True)
class WindowSettings(Settings):
    """Settings of the demodulation of a waveform."""

    window: float | None = option(
        None, "Lock-in window", unit="s", note="default: from the tones' spacing", common=True
    )
    step: float | None = option(
        None, "Interval of windows", unit="s", note="default: half a window", common=True
    )
    mains_hz: float = option(
        50.0, "Mains frequency", unit="Hz", least=0.0, most=1e3, note="0 for none", common=True
    )

    def lockin(self, job: Job) -> LockinSettings | None:
        """Return window and step for the site of a job; None selects the default.

        Raises InputError where they do not suit the site's tones.
        """
        if 0.0 < self.mains_hz < LOWEST_MAINS:
            raise InputError(
                f"--mains-hz must be 0 for none, or at least {LOWEST_MAINS:g} Hz; got"
                f" {self.mains_hz:g}"
            )
        if self.window is None and self.step is None and self.mains_hz == WindowSettings.mains_hz:
            return None
        from magfusion.jobs.inputs import read_site
        from magfusion.receiver.receivers import usual_lockin
        from magfusion.receiver.windows import LockinSettings

        site = read_site(job, unknown=True, several=True)
        usual = usual_lockin(site, self.mains_hz)
        least = usual.window / 2.0
        length = usual.window if self.window is None else self.window
        if not least <= length <= 60.0:
            raise InputError(
                f"--window must lie between {least:.3g} s, below which the tones cannot be"
                f" separated, and 60 s; got {length:g}"
            )
        distance = length / 2.0 if self.step is None else self.step
        if not length / 20.0 <= distance <= 60.0:
            raise InputError(
                f"--step must lie between a twentieth of the window, {length / 20.0:.3g} s, and"
                f" 60 s; got {distance:g}"
            )
        return LockinSettings(length, distance, self.mains_hz)


@dataclass(frozen=True, kw_only=True)
class EstimateSettings(Settings):
    """Parameters estimated by the estimators of motion, and the Earth field."""

    estimate: str | None = option(
        None,
        f"Calibration to estimate: any of {','.join(GROUPS)}, or none",
        note="default: the uncertain ones, by the site's sigmas",
    )

    @property
    def groups(self) -> tuple[str, ...] | None:
        """Groups of calibration parameters."""
        if self.estimate is None:
            return None
        chosen = tuple(part.strip() for part in self.estimate.split(",") if part.strip())
        if chosen == ("none",):
            return ()
        unknown = [group for group in chosen if group not in GROUPS]
        if unknown or not chosen:
            raise InputError(
                f"--estimate {self.estimate!r}: {', '.join(unknown) or 'nothing'} is not a"
                f" calibration group; choose from {', '.join(GROUPS)}, or none"
            )
        return chosen


@dataclass(frozen=True, kw_only=True)
class EarthSettings(Settings):
    """Option to use the Earth field."""

    earth: bool = option(False, "Use the Earth field as well: it gives the heading without beacons")


@dataclass(frozen=True, kw_only=True)
class RiskSettings(Settings):
    """Specification of protection levels."""

    risk: float = option(
        1e-4,
        "Probability per epoch of an undetected error beyond its protection level",
        least=1e-9,
        most=0.1,
    )
    fault_prior: float = option(
        1e-3, "Probability per epoch of a faulty beacon", least=0.0, most=0.1
    )

    @property
    def risks(self) -> Risk:
        """Return them in the form of the estimators."""
        from magfusion.model.trust import Risk

        return Risk(total=self.risk, fault=self.fault_prior)


@dataclass(frozen=True, kw_only=True)
class ReplayedSettings(Settings):
    """Format and pace of data in a pipe."""

    form: Literal["json", "msgpack"] = option("json", "Records in the pipe", name="format")
    realtime: bool = option(False, "Pace by the log's clock")


@dataclass(frozen=True, kw_only=True)
class FrameSettings(Settings):
    """Frame names for ROS and Foxglove."""

    frame: str = option("world", "Frame of the poses, for ROS and Foxglove")
    child: str = option("body", "Child frame of the poses, for ROS and Foxglove")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("frame", "child"):
            if not getattr(self, name).strip():
                raise InputError(f"--{name} must not be empty; give a frame")
        if self.frame == self.child:
            raise InputError(f"--frame and --child must differ; got {self.frame!r} for both")


@dataclass(frozen=True, kw_only=True)
class RandomSettings(Settings):
    """Random seed."""

    seed: int = option(0, "Seed of the random numbers", least=0)
