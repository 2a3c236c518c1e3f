"""The option for the rate of states."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magfusion.errors import InputError
from magfusion.jobs.settings import Settings, option

if TYPE_CHECKING:
    from magfusion.model.samples import Log
    from magfusion.units import Rate

LOWEST_RATE, HIGHEST_RATE = 0.1, 1e4  # Hz


@dataclass(frozen=True, kw_only=True)
class RateSettings(Settings):
    """Rate of states."""

    rate: str = option(
        "field",
        "States at the field epochs, at every inertial sample, or at this rate",
        note=f"{LOWEST_RATE:g} to {HIGHEST_RATE:g} Hz",
        metavar="field|imu|HZ",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rate not in ("field", "imu") and not self._is_number():
            raise InputError(
                f"--rate {self.rate!r}: give 'field', 'imu', or a number from {LOWEST_RATE:g} to"
                f" {HIGHEST_RATE:g} (Hz)"
            )

    def _is_number(self) -> bool:
        try:
            return LOWEST_RATE <= float(self.rate) <= HIGHEST_RATE
        except ValueError:
            return False

    @property
    def rates(self) -> Rate:
        """Return the rate as the estimators take it, a number in Hz."""
        if self.rate == "field":
            return "field"
        return "imu" if self.rate == "imu" else float(self.rate)


def refuse_rate(path: Path, log: Log, rate: Rate) -> None:
    """Reject states at inertial samples for a log without any."""
    if rate == "imu" and not log.inertial:
        raise InputError(f"{path}: has no inertial samples for the states; give --rate HZ")
