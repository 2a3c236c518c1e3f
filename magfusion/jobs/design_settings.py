"""Settings of the design of an installation."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from magfusion.errors import InputError
from magfusion.jobs.coil_drive import DriveSettings
from magfusion.jobs.settings import RandomSettings, RiskSettings, argument, option

ALL = "all"
MAX_BEACONS, USUAL_BEACONS = 30, 4


@dataclass(frozen=True, kw_only=True)
class NeedSettings(RiskSettings):
    """Protection levels that a user needs."""

    need: str | None = option(
        None,
        "Protection level that is needed: position in m, and attitude in deg after a comma",
        metavar="POSITION[,ATTITUDE]",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.limits

    @property
    def limits(self) -> tuple[float, ...]:
        """Return the needed levels: of position (m), and of attitude (deg) where it is given."""
        if self.need is None:
            return ()
        try:
            result = tuple(float(part) for part in self.need.split(","))
        except ValueError:
            result = ()
        if len(result) not in (1, 2) or not all(0.0 < value < 1e6 for value in result):
            raise InputError(
                f"--need {self.need!r}: give a length in m, and an angle in deg after a comma where"
                " it matters, e.g. --need 0.1,2"
            )
        return result


@dataclass(frozen=True, kw_only=True)
class DesignSettings(NeedSettings, DriveSettings, RandomSettings):
    """Hall, number and kind of beacons, and search time."""

    site: Path = argument("Site file: its platform, and a beacon of which copies are placed")
    beacons: int | None = option(
        None,
        "New beacons to place",
        least=1,
        most=MAX_BEACONS,
        note="default: 4; with --need as few as reach it",
    )
    hall: Path | None = option(
        None, "YAML file of the hall: walls, mounting, forbidden places, where to navigate"
    )
    box: str | None = option(
        None,
        "A hall without a file, m: xmin,xmax,ymin,ymax,zmin,zmax",
        note="default: around the site's beacons",
    )
    keep: str | None = option(
        None,
        f"Beacons of the site that stay: their names, or {ALL}",
        metavar="NAME,...",
        note="default: none; all are placed again",
    )
    template: str | None = option(
        None, "Beacon of the site of which copies are placed", note="default: the first"
    )
    objective: Literal["worst", "sigma", "D", "A"] = option(
        "worst",
        "Criterion to minimise: the worst protection level; the worst position sigma; the mean"
        " logarithm of the determinant (D) or the mean trace (A) of the position's covariance",
    )
    axes: Literal["3", "7", "13"] = option(
        "7", "Directions of a beacon's axis: the world's, and diagonals"
    )
    grid: float | None = option(
        None, "Spacing of the mounting places", unit="m", above=0.0, note="default: as --spacing"
    )
    spacing: float | None = option(
        None,
        "Spacing of the points of use",
        unit="m",
        above=0.0,
        note="default: a twentieth of the hall's longer side",
    )
    apart: float = option(1.0, "Minimum distance of two beacons", unit="m", least=0.2, most=1e4)
    clearance: float = option(
        0.5, "Minimum distance of a beacon from the points of use", unit="m", least=0.2, most=1e4
    )
    moment: float | None = option(
        None,
        "Moment of each new beacon's strongest coil",
        unit="A m^2",
        least=1e-6,
        most=1e6,
        note="default: as the template; with --need the smallest that reaches it",
    )
    moment_budget: float | None = option(
        None,
        "Total moment of all new beacons, distributed optimally",
        unit="A m^2",
        least=1e-6,
        most=1e7,
    )
    band: str = option("10,100", "Frequency band of tones, Hz: low,high")
    window: float = option(
        0.4, "Time over which tones are averaged and separated", unit="s", least=0.02, most=4.0
    )
    mains_hz: float = option(
        50.0, "Mains (harmonics are avoided)", unit="Hz", least=0.0, most=1e3, note="0: none"
    )
    starts: int = option(8, "Random initial layouts of the search", least=1, most=1000)
    random: int = option(0, "Random layouts to compare with", least=0, most=10_000)
    minutes: float = option(10.0, "Time limit of the search", least=0.01, most=1e5)
    motion: int | None = option(
        None,
        "Place no beacons: propose this number of stops of the platform for a calibration",
        least=1,
        most=100,
    )
    stop: float = option(2.0, "Length of such a stop", unit="s", least=0.02, most=3600.0)
    poses: Literal["open", "known"] = option(
        "open", "Whether the stops' poses are measured (known, for calibrate beacon)"
    )
    earlier: Path | None = option(
        None, "Start from the site.yaml of an earlier design of the same hall", name="continue"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.moment is not None and self.moment_budget is not None:
            raise InputError("give --moment, or --moment-budget to distribute it; not both")
        if self.hall is not None and self.box is not None:
            raise InputError("give --hall, or --box where there is no file; not both")
        if self.moment_budget is not None and self.beacons is None and self.limits:
            raise InputError("--moment-budget with --need requires a number; give --beacons")

    @property
    def count(self) -> int:
        """Number of new beacons, where it is not searched."""
        return USUAL_BEACONS if self.beacons is None else self.beacons

    @property
    def poses_known(self) -> bool:
        """Whether the stops' poses are measured."""
        return self.poses == "known"
