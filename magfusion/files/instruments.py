"""Instruments by name: figures of their data sheets, as keys of a site.

A site's ``gyro_noise`` and ``accel_noise`` are what an Allan deviation shows at one second; the
noise density of a sheet is one-sided, and larger by sqrt(2).  The density is taken as printed:
that margin is the difference between a typical piece on a bench and yours.  A sheet's random walk
is brought up to the same.

A sheet does not give the bias walk.  A walk ``k`` with white noise ``n`` has its
least Allan variance, ``2 n k / sqrt(3)``, at ``sqrt(3) n / k``: ``k`` is such that this is the
stability in run, and that the least is reached within `TURNS` (within `DEFAULT_TURNS` where the
sheet has none).
"""

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import Field, RootModel, model_validator

from magfusion.errors import InputError
from magfusion.files.yaml_files import StrictModel, read_yaml
from magfusion.model.site import ImuModel
from magfusion.units import DEGREE, HOUR

TURNS, DEFAULT_TURNS = 1000.0, 100.0  # s
MICRO_G = 9.80665e-6  # m/s^2
UNNAMED = "MEMS"  # what is taken where nothing is named
BODY_IRON = 2e-6  # T; iron on the body offsets any magnetometer by about that

_Positive = Annotated[float, Field(gt=0.0)]
_Sheet = TypeVar("_Sheet")


class _Gyro(StrictModel):
    noise_deg_s_rthz: _Positive | None = None
    random_walk_deg_rth: _Positive | None = None
    in_run_deg_h: _Positive | None = None
    offset_deg_s: _Positive

    @model_validator(mode="after")
    def _one_noise(self) -> Self:
        return _either(self, self.noise_deg_s_rthz, self.random_walk_deg_rth)

    @property
    def density(self) -> float:
        """One-sided (rad/s/sqrt(Hz))."""
        walk = (self.random_walk_deg_rth or 0.0) * math.sqrt(2.0 / HOUR)
        return DEGREE * (self.noise_deg_s_rthz or walk)

    @property
    def in_run(self) -> float | None:
        """Least Allan deviation (rad/s)."""
        return None if self.in_run_deg_h is None else self.in_run_deg_h * DEGREE / HOUR


class _Accel(StrictModel):
    noise_ug_rthz: _Positive | None = None
    random_walk_m_s_rth: _Positive | None = None
    in_run_ug: _Positive | None = None
    offset_mg: _Positive

    @model_validator(mode="after")
    def _one_noise(self) -> Self:
        return _either(self, self.noise_ug_rthz, self.random_walk_m_s_rth)

    @property
    def density(self) -> float:
        """One-sided (m/s^2/sqrt(Hz))."""
        walk = (self.random_walk_m_s_rth or 0.0) * math.sqrt(2.0 / HOUR)
        return walk or (self.noise_ug_rthz or 0.0) * MICRO_G

    @property
    def in_run(self) -> float | None:
        """Least Allan deviation (m/s^2)."""
        return None if self.in_run_ug is None else self.in_run_ug * MICRO_G


class _ImuEntry(StrictModel):
    source: str
    checked: list[Literal["gyro", "accel"]]
    gyro: _Gyro
    accel: _Accel


class _Noise(StrictModel):
    noise_nt_rthz: _Positive | None = None
    rms_nt: _Positive | None = None
    bandwidth_hz: _Positive | None = None

    @model_validator(mode="after")
    def _one_noise(self) -> Self:
        return _either(self, self.noise_nt_rthz, self.rms_nt and self.bandwidth_hz)

    @property
    def density(self) -> float:
        """One-sided (T/sqrt(Hz))."""
        of_white = (self.rms_nt or 0.0) / math.sqrt(self.bandwidth_hz or 1.0)
        return 1e-9 * (self.noise_nt_rthz or of_white)


class _MagnetometerEntry(StrictModel):
    source: str
    noise: _Noise
    offset_nt: _Positive
    scale: _Positive


_Entry = TypeVar("_Entry", bound=StrictModel)


class _Imus(RootModel[dict[str, _ImuEntry]]):
    pass


class _Magnetometers(RootModel[dict[str, _MagnetometerEntry]]):
    pass


def _either(entry: _Entry, first: float | None, second: float | None) -> _Entry:
    if (first is None) is (second is None):
        raise ValueError("give its noise in one way")
    return entry


@dataclass(frozen=True)
class ImuSheet:
    """One inertial sensor: its noise as a site has it, and where the figures come from."""

    name: str
    source: str
    checked: tuple[str, ...]
    model: ImuModel
    turns: tuple[bool, bool]


@dataclass(frozen=True)
class MagnetometerSheet:
    """One magnetometer."""

    name: str
    source: str
    noise_density: float  # one-sided (T/sqrt(Hz))
    offset: float  # of the sensor and of iron on the body, one sigma (T)
    scale: float  # of gains and axes, relative, one sigma


def bias_walk(density: float, in_run: float | None) -> float:
    """Return the random walk of a bias, by the rule of this module, in density's unit per second.

    `density`: one-sided, of the white noise. `in_run`: the least Allan deviation.
    """
    white = density / math.sqrt(2.0)
    if in_run is None:
        return math.sqrt(3.0) * white / DEFAULT_TURNS
    return math.sqrt(3.0) * max(in_run**2 / (2.0 * white), white / TURNS)


@cache
def imus() -> Mapping[str, ImuSheet]:
    """Return the inertial sensors that are known by name."""
    result = read_yaml(Path(__file__).with_name("imus.yaml"), _Imus).root
    return {name: _imu_sheet(name, entry) for name, entry in result.items()}


def _imu_sheet(name: str, entry: _ImuEntry) -> ImuSheet:
    gyro, accel = entry.gyro, entry.accel
    model = ImuModel(
        gyro_noise=_rounded(gyro.density),
        accel_noise=_rounded(accel.density),
        gyro_bias_walk=_rounded(bias_walk(gyro.density, gyro.in_run)),
        accel_bias_walk=_rounded(bias_walk(accel.density, accel.in_run)),
        gyro_bias_sigma=_rounded(gyro.offset_deg_s * DEGREE),
        accel_bias_sigma=_rounded(1e3 * accel.offset_mg * MICRO_G),
    )
    declared = gyro.in_run is not None, accel.in_run is not None
    return ImuSheet(name, entry.source, tuple(entry.checked), model, declared)


@cache
def magnetometers() -> Mapping[str, MagnetometerSheet]:
    """Return the magnetometers that are known by name."""
    result = read_yaml(Path(__file__).with_name("magnetometers.yaml"), _Magnetometers).root
    return {
        name: MagnetometerSheet(
            name,
            entry.source,
            _rounded(entry.noise.density),
            max(1e-9 * entry.offset_nt, BODY_IRON),
            entry.scale,
        )
        for name, entry in result.items()
    }


def named_imu(name: str) -> ImuSheet:
    """Return an inertial sensor, in whatever way its name is written.

    Raises InputError where none has this name.
    """
    return _named(imus(), name, "--imu", "--list-imus")


def named_magnetometer(name: str) -> MagnetometerSheet:
    """Return a magnetometer, in whatever way its name is written.

    Raises InputError where none has this name.
    """
    return _named(magnetometers(), name, "--magnetometer", "--list-magnetometers")


def _named(known: Mapping[str, _Sheet], name: str, option: str, listing: str) -> _Sheet:
    plain = {_plain(one): one for one in known}
    if _plain(name) in plain:
        return known[plain[_plain(name)]]
    near = difflib.get_close_matches(_plain(name), plain, n=3, cutoff=0.5)
    within = [key for key in plain if _plain(name) and _plain(name) in key]
    close = [plain[key] for key in dict.fromkeys([*within, *near])][:4]
    meant = f"did you mean {', '.join(close)}? " if close else ""
    raise InputError(
        f"{option} {name}: no such instrument in the table; {meant}{listing} lists them all, and"
        f" {UNNAMED} is any of its kind"
    )


def _plain(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum())


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
