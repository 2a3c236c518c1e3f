"""The option that specifies the coils of beacons: those of `magfusion coil` in one text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from magfusion.errors import InputError
from magfusion.jobs.coil import CoilSettings
from magfusion.jobs.settings import Settings, option

if TYPE_CHECKING:
    from magfusion.model.site import Beacon
    from magfusion.results.design.coil_drive import DriveRow

EXAMPLE = "wire=2e-3,turns=200,radius=0.5"
_GIVEN_BY_SITE = ("amperes", "volts", "frequency")


@dataclass(frozen=True, kw_only=True)
class DriveSettings(Settings):
    """Wire and form of the coils."""

    coil: str | None = option(
        None,
        "Wire and form of each beacon's coil, by options of coil, to report amperes, volts, watts"
        f" and warming: {EXAMPLE},series=capacitor",
        metavar="NAME=VALUE,...",
    )

    def drives(self, beacons: Sequence[Beacon]) -> list[DriveRow]:
        """Return the drive of beacons; none without a coil.

        Raises InputError where the text specifies no coil.
        """
        from magfusion.results.design.coil_drive import drive_rows

        if self.coil is None:
            return []
        given = _coil_settings(self.coil)
        tuned = given.series == "capacitor"
        return drive_rows(given.coil(), beacons, tuned=tuned, air_degc=given.air)


def _coil_settings(text: str) -> CoilSettings:
    """Return the settings of `magfusion coil` for a text, with any current."""
    from pydantic import TypeAdapter, ValidationError

    parts = [part.strip().partition("=") for part in text.split(",")]
    given = {name.strip(): value.strip() for name, _, value in parts}
    known = [field.name for field in fields(CoilSettings) if field.name not in _GIVEN_BY_SITE]
    wrong = [name for name in given if name not in known]
    if wrong:
        raise InputError(f"--coil {text}: unknown {wrong[0]!r}; give {', '.join(known)}")
    # A capacitor requires a frequency; those of the beacons are used.
    values = {"amperes": 1.0, "frequency": 1.0, **given}
    try:
        return TypeAdapter(CoilSettings).validate_python(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        reason = {
            "missing": f"{name} is missing",
            "value_error": first["msg"].removeprefix("Value error, "),
        }.get(first["type"], f"{name}={first['input']} cannot be used")
        raise InputError(f"--coil {text}: {reason}; give e.g. --coil {EXAMPLE}") from None
