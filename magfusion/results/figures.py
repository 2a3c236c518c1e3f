"""Figures of a job: the objects from which ``report.json`` and the screen are generated.

A figure's key in the flat ``report.json`` is its name, in which ``{beacon}`` is the beacon's name:
``{beacon}.position_x_m`` is written ``A.position_x_m``.  A beacon may have any name.
One that is also the name of another owner of parameters (`OWNERS`), or that begins with
``beacon:``, is written ``beacon:NAME``, also if another figure of the report already has this key.
All other names are written unchanged.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

Value = float | int | str | bool | list[str] | list[dict[str, Any]] | None

OWNERS = frozenset({"earth", "imu", "magnetometer", "sensor"})  # of parameters, beside beacons
DETERMINED_RATIO = 0.5  # posterior over prior sigma below which the data, not the prior, spoke


class Section(StrEnum):
    """Where the screen shows a figure."""

    TITLE = "title"
    VERDICT = "verdict"
    LOGS = "logs"  # the value has a row for each of several logs
    AXES = "axes"  # errors and sigmas of each axis of the pose
    ERRORS = "errors"
    SUMMARY = "summary"
    CALIBRATION = "calibration"
    TRANSFER = "transfer"
    DIRECTIONS = "directions"
    NOTES = "notes"  # the value is sentences
    REMARKS = "remarks"  # the same, after the notes
    REPORT = "report"  # of interest only in report.json


class ErrorColumn(StrEnum):
    """Columns of the tables of errors, in the order in which they are shown."""

    RMS = "rms"
    ALIGNED = "aligned"
    FIXED = "survey fixed"  # with the declared calibration
    CALIBRATED = "calibrated"
    LAGGED = "lagged"
    PROPAGATED = "carried"
    SIGMA = "sigma per axis"
    NONE = ""


@dataclass(frozen=True)
class Figure:
    """One figure of a job."""

    name: str  # key of ``report.json``, with ``{beacon}`` for the beacon's name
    value: Value
    unit: str = ""  # as shown on the screen; the key has a suffix of its own
    # name of the beacon; the screen lists the same figure of several beacons in one line
    beacon: str | None = None
    section: Section = Section.SUMMARY
    label: str = ""  # title on the screen; default: the name without its unit
    column: ErrorColumn = ErrorColumn.NONE  # of the section's table
    note: str = ""  # a warning that the screen shows with the figure
    remark: str = ""  # a sentence that the screen shows after all notes
    refused: bool = False  # whether it counts rejected data; its title has the reason

    @property
    def key(self) -> str:
        """Key in the report, unless another figure already has it."""
        return self.key_of(self.beacon and owner_key(self.beacon))

    def key_of(self, owner: str | None) -> str:
        """Return the key with the beacon's name written as given."""
        return self.name if owner is None else self.name.replace("{beacon}", owner)

    @property
    def title(self) -> str:
        """Title on the screen."""
        unit = self.unit.lower().translate({ord("/"): "_", ord(" "): "_", ord("^"): None})
        plain = self.name.replace("{beacon}", "").removesuffix(f"_{unit}")
        return self.label or plain.strip("_").replace("_", " ")

    def entries(self, key: str) -> dict[str, Value]:
        """Return the report's entries for it under a key."""
        return {key: self.value}


@dataclass(frozen=True)
class ParameterEstimate(Figure):
    """One calibration parameter after the fit; the value is its change from the declared one.

    `label`: of its vector, which is one line on the screen.
    """

    section: Section = Section.CALIBRATION
    # sigma, prior_sigma: posterior and prior standard deviation; a prior of zero is none
    sigma: float = 0.0
    prior_sigma: float = 0.0
    is_open: bool = False  # whether the measurements do not determine it, whatever its sigma
    # its value before, if any: of a rotation only the change is a number
    declared: float | None = None

    @property
    def change(self) -> float:
        """Change from the declared value."""
        return number(self.value)

    @property
    def determined(self) -> bool:
        """Whether the data, rather than the prior, determined the parameter."""
        known = not self.prior_sigma or self.sigma < DETERMINED_RATIO * self.prior_sigma
        return known and not self.is_open

    def entries(self, key: str) -> dict[str, Value]:
        """Return change and sigmas under keys with a common prefix."""
        sigmas = {f"{key}_sigma": self.sigma, f"{key}_prior_sigma": self.prior_sigma}
        return {key: self.value, **sigmas}


class Figures(Mapping[str, Value]):
    """The figures of a job in their order; as a mapping, the content of ``report.json``.

    Raises ValueError where two figures without a beacon have the same key.
    """

    def __init__(self, *figures: Figure) -> None:
        self.all = figures
        self._report: dict[str, Value] = {}
        for figure in figures:
            owner = figure.beacon and owner_key(figure.beacon)
            while not self._report.keys().isdisjoint(
                entries := figure.entries(figure.key_of(owner))
            ):
                if owner is None:
                    raise ValueError(f"two figures are called {figure.name}")
                owner = f"beacon:{owner}"
            self._report |= entries

    def __getitem__(self, key: str) -> Value:
        return self._report[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._report)

    def __len__(self) -> int:
        return len(self._report)

    def __or__(self, other: "Figures") -> "Figures":
        return Figures(*self.all, *other.all)

    def prefixed(self, prefix: str) -> "Figures":
        """Return the same figures under keys with a prefix."""
        return Figures(*(replace(f, name=prefix + f.name) for f in self.all))

    def of(self, section: Section) -> list[Figure]:
        """Return the figures of one part of the screen."""
        return [figure for figure in self.all if figure.section is section]


def heading(job: str, log: str) -> Figures:
    """Return the first figures of every report: the job and its inputs."""
    return Figures(
        Figure("job", job, section=Section.TITLE), Figure("log", log, section=Section.TITLE)
    )


def determined_figures(estimates: list[ParameterEstimate]) -> Figures:
    """Return the names of the parameters that the data determined, and of the others."""
    return Figures(
        Figure("determined", [e.key for e in estimates if e.determined], section=Section.REPORT),
        Figure(
            "undetermined", [e.key for e in estimates if not e.determined], section=Section.REPORT
        ),
    )


def calibration_record(log_name: str, estimates: list[ParameterEstimate]) -> dict[str, object]:
    """Return a refined site's record of its origin."""
    return {"log": log_name, **determined_figures(estimates)}


def owner_key(name: str) -> str:
    """Return a beacon's name as in the keys of the report."""
    return f"beacon:{name}" if name in OWNERS or name.startswith("beacon:") else name


def number(value: Value) -> float:
    """Return a figure's value as a number, NaN where it is none."""
    return float(value) if isinstance(value, int | float) else float("nan")
