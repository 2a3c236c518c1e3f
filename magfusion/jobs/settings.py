"""What a job asks of its user: fields that know their help, unit and bounds.

The command line is made of them (`magfusion.cli`) before BLAS threads are set, so NumPy is not
imported here, and gtsam, rerun and matplotlib not at the top of any job but inside ``run``.
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
    """What a field is on the command line.

    Parameters
    ----------
    help : str
        Without unit, bounds, note and full stop, which are added.
    name : str, optional
        Of the option, where it is not the field's.
    unit : str
        As it is written behind a number.
    least, most, above : float, optional
        Bounds; ``above`` is the one that is excluded.
    note : str
        What else there is to say, as what the default is where it is no value.
    words : mapping, optional
        The choices: what is typed, and the value that it means.
    metavar : str, optional
        How a text is written.
    positional : bool
        An argument rather than an option.
    common : bool
        Of many jobs; listed after a job's own.
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
        """Refuse a number that is out of bounds, or none.

        Raises
        ------
        InputError
        """
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
    """Return a field that is given by its place; it must be where it has no default."""
    asked = {"option": Option(help, positional=True, **facts)}
    return dataclasses.field(default=default, metadata=asked)


def required(help: str, **facts: Any) -> Any:
    """Return a field that must be given, by its name."""
    return dataclasses.field(metadata={"option": Option(help, **facts)})


def options(settings: type[Settings]) -> list[tuple[dataclasses.Field[Any], Option]]:
    """Return the fields that are options, a job's own before those of many jobs."""
    found = [(f, f.metadata["option"]) for f in dataclasses.fields(settings) if f.metadata]
    return sorted(found, key=lambda pair: pair[1].common)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What one run of a job is asked for.

    Raises
    ------
    InputError
        Where a number is out of its bounds.
    """

    def __post_init__(self) -> None:
        for field, asked in options(type(self)):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and not isinstance(value, bool):
                asked.check(asked.name or field.name.replace("_", "-"), value)


class Command(NamedTuple):
    """How a job is called; its name and what it does are in `magfusion.jobs.JOBS`.

    Parameters
    ----------
    run : callable
        Takes the settings and, of these, what it names: ``output``, where the results go;
        ``report``, to report the progress; ``given``, the names of the options that were given.
        Returns the figures of the report, if it makes one.
    output : str, optional
        Where results go unless the user says; None names them by the log and the job.
    output_optional : bool
        Whether it writes only where the user says.
    reports : bool
        Whether it makes a report, which ``--json`` prints.
    output_help : str
        What ``--output`` is; `magfusion.cli` adds its default.
    fails : bool
        Whether a verdict that is failed ends it with exit code 1.
    after : callable, optional
        Called with settings and output when the result has been shown.
    example : str
        With which the help ends.
    """

    settings: type[Settings]
    run: Callable[..., Any]
    output: str | None = None
    output_required: bool = False
    output_optional: bool = False
    reports: bool = True
    output_help: str = "Directory of the results"
    fails: bool = True
    after: Callable[[Any, Path], None] | None = None
    example: str = ""


@dataclass(frozen=True, kw_only=True)
class TopicSettings(Settings):
    """Topics of a bag that has several of one type."""

    topics: str | None = option(
        None,
        "Topics of a bag that has several, e.g. imu=/imu/data,magnetometer=/mag,truth=/odom",
        metavar="ROLE=NAME,...",
        common=True,
    )


@dataclass(frozen=True, kw_only=True)
class PartSettings(TopicSettings):
    """Which log, and which part of it."""

    log: Path = argument("Log: a directory, a EuRoC folder, or a bag of ROS")
    start: float | None = option(
        None, "Use the log from here", unit="s since its epoch", common=True
    )
    end: float | None = option(
        None, "Use the log up to here", unit="s since its epoch", common=True
    )


@dataclass(frozen=True, kw_only=True)
class LogSettings(PartSettings):
    """A log with its site."""

    site: Path | None = option(None, "Site file", note="default: site.yaml in the log")

    def job(self, output: Path) -> Job:
        """Return what a job on a log reads and where it writes.

        Raises
        ------
        InputError
        """
        from magfusion.jobs.inputs import Job, topics_option

        if self.start is not None and self.end is not None and not self.start < self.end:
            raise InputError(f"--start must come before --end; got {self.start:g} and {self.end:g}")
        return Job(self.log, self.site, output, self.start, self.end, topics_option(self.topics))


@dataclass(frozen=True, kw_only=True)
class LogsSettings(LogSettings):
    """A log, or several of one site that are refined together."""

    more: tuple[Path, ...] = argument(
        "More logs of the same site, to refine it by all of them together", ()
    )
    cluster: str | None = option(
        None, "Dask scheduler, tcp://host:8786, whose workers see logs and results; several logs"
    )
    workers: int | None = option(
        None, "Processes on this machine; several logs", note="default: one a core"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.more and (self.cluster is not None or self.workers is not None):
            raise InputError("--cluster and --workers share out several logs; one log was given")

    def jobs(self, output: Path) -> list[Job]:
        """Return a job for every log.

        Raises
        ------
        InputError
        """
        first = self.job(output)
        return [first, *(dataclasses.replace(first, log_path=path) for path in self.more)]


LOWEST_MAINS = 10.0  # Hz; below, its harmonics would be fitted to the motion


@dataclass(frozen=True, kw_only=True)
class WindowSettings(Settings):
    """How a waveform is demodulated."""

    window: float | None = option(
        None, "Lock-in window", unit="s", note="default: from the tones' spacing", common=True
    )
    step: float | None = option(
        None, "Distance of windows", unit="s", note="default: half a window", common=True
    )
    mains_hz: float = option(
        50.0, "Mains frequency", unit="Hz", least=0.0, most=1e3, note="0 for none", common=True
    )

    def lockin(self, job: Job) -> LockinSettings | None:
        """Return window and step for the site of a job; None leaves them to the estimator.

        Raises
        ------
        InputError
            Where they do not fit the site's tones.
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
    """What the estimators of motion take for unknown, and what they measure."""

    estimate: str | None = option(
        None,
        f"Calibration to estimate: any of {','.join(GROUPS)}, or none",
        note="default: what the site's sigmas leave open",
    )

    @property
    def groups(self) -> tuple[str, ...] | None:
        """Groups of calibration parameters.

        Raises
        ------
        InputError
        """
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
    """Whether the Earth field is measured."""

    earth: bool = option(
        False, "Measure the Earth field too: it gives the heading where no beacon does"
    )


@dataclass(frozen=True, kw_only=True)
class RiskSettings(Settings):
    """What protection levels promise."""

    risk: float = option(
        1e-4,
        "Probability, an epoch, that an error beyond its protection level goes unnoticed",
        least=1e-9,
        most=0.1,
    )
    fault_prior: float = option(
        1e-3, "Probability, an epoch, that a beacon is false", least=0.0, most=0.1
    )

    @property
    def risks(self) -> Risk:
        """Return them as the estimators take them."""
        from magfusion.model.trust import Risk

        return Risk(total=self.risk, fault=self.fault_prior)


@dataclass(frozen=True, kw_only=True)
class ReplayedSettings(Settings):
    """How a log comes as data, and what data in a pipe look like."""

    form: Literal["json", "msgpack"] = option("json", "Records in the pipe", name="format")
    realtime: bool = option(False, "Pace by the log's clock")


@dataclass(frozen=True, kw_only=True)
class FrameSettings(Settings):
    """What ROS and Foxglove call the frames."""

    frame: str = option("world", "Frame of the poses, for ROS and Foxglove")
    child: str = option("body", "Frame that they are the poses of, for ROS and Foxglove")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("frame", "child"):
            if not getattr(self, name).strip():
                raise InputError(f"--{name} must name a frame; got nothing")
        if self.frame == self.child:
            raise InputError(f"--frame and --child must differ; got {self.frame!r} for both")


@dataclass(frozen=True, kw_only=True)
class RandomSettings(Settings):
    """What is drawn."""

    seed: int = option(0, "Of every random draw", least=0)
