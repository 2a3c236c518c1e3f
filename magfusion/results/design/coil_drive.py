"""Drive of beacons with coils of a given wire and form: amperes, volts, watts and warming."""

from collections.abc import Sequence
from typing import NamedTuple

from magfusion.model.physics.wire_coil import (
    HOTTEST_DEGC,
    OperatingPoint,
    WireCoil,
    operating_point,
)
from magfusion.model.site import Beacon
from magfusion.results.design.pattern import peak_moment
from magfusion.results.figures import Figure, Figures, Section


class DriveRow(NamedTuple):
    """Drive of a beacon's strongest coil (Hz, A m^2); no operating point if it burns."""

    beacon: str
    frequency_hz: float
    moment: float
    point: OperatingPoint | None


def drive_rows(
    coil: WireCoil, beacons: Sequence[Beacon], *, tuned: bool, air_degc: float
) -> list[DriveRow]:
    """Return the drive of the strongest coil of each beacon, at its highest tone.

    `tuned`: whether a capacitor cancels the inductance.
    """
    rows = []
    for beacon in beacons:
        moment, highest = peak_moment(beacon), float(max(beacon.tone_frequencies_hz))
        point = operating_point(
            coil,
            current=moment / (coil.turns * coil.area),
            frequency_hz=highest,
            tuned=tuned and highest > 0.0,
            air_degc=air_degc,
        )
        rows.append(DriveRow(beacon.name, highest, moment, point))
    return rows


def drive_figures(rows: Sequence[DriveRow]) -> Figures:
    """Return current, voltage, power and temperature of each coil; a note on those that burn."""
    figures = [
        Figure(f"{{beacon}}.{name}", value, unit, row.beacon, label=label)
        for row in rows
        if row.point is not None
        for name, value, unit, label in (
            ("current_a", row.point.current, "A", "peak current"),
            ("voltage_v", row.point.voltage, "V", "peak voltage"),
            ("power_w", row.point.power, "W", "power"),
            ("temperature_degc", row.point.temperature_degc, "degC", "coil temperature"),
        )
    ]
    burning = [row.beacon for row in rows if row.point is None]
    if burning:
        note = (
            f"The coil of {', '.join(burning)} exceeds {HOTTEST_DEGC:g} °C in still air at this"
            " moment; give it more copper, more turns or a larger radius."
        )
        figures.append(Figure("coil_notes", [note], section=Section.NOTES))
    return Figures(*figures)
