"""The job that tabulates what a coil of wire gives: moment, volts, watts, warming, fields."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from magfusion.errors import InputError
from magfusion.jobs.settings import Command, Settings, option, required
from magfusion.results.figures import Figure, Figures, Section

if TYPE_CHECKING:
    from magfusion.model.physics.wire_coil import OperatingPoint, WireCoil

DISTANCES = range(1, 11)  # m
ENAMEL = 1.08  # diameter of enamelled wire over that of its copper
MAX_RATIO = 1.1  # of resistances, without a note


@dataclass(frozen=True, kw_only=True)
class CoilSettings(Settings):
    """A coil of copper wire, and what drives it."""

    wire: float = required("Diameter of the copper", unit="m", least=1e-5, most=0.05)
    turns: int = required("Number of turns", least=1, most=100_000)
    radius: float | None = option(
        None, "Inner radius of a round coil", unit="m", least=1e-4, most=1e3
    )
    side: float | None = option(None, "Inner side of a square coil", unit="m", least=1e-4, most=1e3)
    layers: int | None = option(
        None, "Layers of turns", note="default: as many as turns in a layer", least=1, most=300
    )
    insulated: float | None = option(
        None, "Diameter of the wire with insulation", unit="m", note="default: 1.08 of the copper"
    )
    amperes: float | None = option(None, "Peak current", unit="A", above=0.0)
    volts: float | None = option(None, "Peak voltage in place of a current", unit="V", above=0.0)
    frequency: float = option(0.0, "Frequency", unit="Hz", least=0.0, most=1e6, note="0 for steady")
    series: Literal["nothing", "capacitor"] = option(
        "nothing", "What is in series: a capacitor that cancels the inductance"
    )
    air: float = option(20.0, "Temperature of the air", unit="°C", least=-60.0, most=100.0)

    def coil(self) -> WireCoil:
        """Return the coil."""
        from magfusion.model.physics.wire_coil import WireCoil

        if (self.radius is None) == (self.side is None):
            raise InputError("--radius of a round coil or --side of a square one: give one of them")
        if (self.amperes is None) == (self.volts is None):
            raise InputError("--amperes or --volts: give one of them")
        if self.series == "capacitor" and not self.frequency:
            raise InputError("--series capacitor: blocks a steady current; give a --frequency")
        insulated = ENAMEL * self.wire if self.insulated is None else self.insulated
        layers = max(round(self.turns**0.5), 1) if self.layers is None else self.layers
        if insulated < self.wire:
            raise InputError(f"--insulated must be at least --wire; got {insulated:g}")
        if layers > min(self.turns, 300):
            raise InputError(f"--layers must be at most the turns, and 300; got {layers}")
        shape: Literal["circle", "square"] = "circle" if self.side is None else "square"
        inner = 0.5 * self.side if self.side is not None else self.radius or 0.0
        return WireCoil(shape, inner, self.turns, layers, self.wire, insulated)


def run(settings: CoilSettings) -> Figures:
    """Return what a coil gives, when its temperature no longer rises.

    Raises InputError where it has no such temperature.
    """
    from magfusion.model.physics.wire_coil import HOTTEST_DEGC, operating_point

    coil = settings.coil()
    point = operating_point(
        coil,
        current=settings.amperes,
        voltage=settings.volts,
        frequency_hz=settings.frequency,
        tuned=settings.series == "capacitor",
        air_degc=settings.air,
    )
    if point is None:
        raise InputError(
            f"the coil burns: in still air it exceeds {HOTTEST_DEGC:g} °C; give less current, or"
            " more copper"
        )
    figures = Figures(Figure("job", "coil", section=Section.TITLE))
    figures |= _wound(coil) | _driven(coil, point)
    if settings.frequency:
        figures |= _alternating(coil, point, settings)
    return figures | _fields(coil, point)


def _wound(coil: WireCoil) -> Figures:
    width, depth = coil.section
    return Figures(
        Figure("turns", coil.turns),
        Figure("layers", coil.layers),
        Figure("winding_width_m", width, "m"),
        Figure("winding_depth_m", depth, "m"),
        Figure("area_m2", coil.area, "m2"),
        Figure("wire_length_m", coil.wire_length, "m"),
        Figure("mass_kg", coil.mass, "kg"),
        Figure("inductance_h", coil.inductance, "H"),
    )


def _driven(coil: WireCoil, point: OperatingPoint) -> Figures:
    moment = coil.turns * coil.area * point.current
    return Figures(
        Figure("current_a", point.current, "A", label="peak current"),
        Figure("moment_a_m2", moment, "A m^2"),
        Figure("voltage_v", point.voltage, "V", label="peak voltage"),
        Figure("power_w", point.power, "W"),
        Figure("temperature_degc", point.temperature_degc, "degC"),
        Figure("resistance_ohm", coil.resistance(point.temperature_degc), "ohm"),
    )


def _alternating(coil: WireCoil, point: OperatingPoint, settings: CoilSettings) -> Figures:
    from magfusion.model.physics.wire_coil import resonance_capacitance

    reactance = math.tau * settings.frequency * coil.inductance
    ratio = coil.alternating_ratio(settings.frequency)
    note = (
        f"At this frequency the resistance is about {ratio:.2g} times that to direct current, by"
        " skin and neighbouring layers, and the coil warms more; use thinner or stranded wire."
    )
    cold = coil.resistance(settings.air)
    return Figures(
        Figure(
            "capacitor_f",
            resonance_capacitance(coil.inductance, settings.frequency),
            "F",
            label="capacitor for resonance",
        ),
        Figure("capacitor_v", point.current * reactance, "V", label="its peak voltage"),
        Figure("quality", reactance / cold, label="quality of the resonance"),
        Figure("alternating_ratio", ratio, note=note if ratio > MAX_RATIO else ""),
        Figure(
            "sensitivity_v_t",
            math.tau * settings.frequency * coil.turns * coil.area,
            "V/T",
            label="as a receiver",
        ),
        Figure(
            "noise_t_rthz",
            coil.noise_density(settings.frequency, settings.air),
            "T/sqrt(Hz)",
            label="its thermal noise",
        ),
    )


def _fields(coil: WireCoil, point: OperatingPoint) -> Figures:
    import numpy as np

    fields = coil.axial_field(point.current, np.array(DISTANCES, dtype=np.float64))
    return Figures(
        *(
            Figure(f"field_{at}m_t", float(field), "T", label=f"field on the axis at {at} m")
            for at, field in zip(DISTANCES, fields, strict=True)
        )
    )


COMMAND = Command(
    CoilSettings,
    run,
    example="magfusion coil --wire 5e-4 --turns 100 --radius 0.1 --amperes 1 --frequency 1010"
    " --series capacitor",
)
