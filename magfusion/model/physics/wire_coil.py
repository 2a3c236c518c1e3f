"""A coil as it is wound: what a wire and a former give in moment, volts, watts and warming."""

from bisect import bisect_left
from dataclasses import dataclass
from typing import Literal

import numpy as np

from magfusion.model.physics.free_convection import ZERO_DEGC, heat_loss
from magfusion.model.physics.inductance import coil_inductance
from magfusion.units import MU0, MU0_OVER_4PI, Array

# Annealed copper (IEC 60028): resistivity at 20 degC (ohm m), its change per kelvin, density.
COPPER_RESISTIVITY, COPPER_PER_K, COPPER_DENSITY = 1.7241e-8, 3.93e-3, 8890.0
REFERENCE_DEGC = 20.0
HOTTEST_DEGC = 300.0  # beyond any enamel
RESOLUTION_K = 1e-3
BOLTZMANN = 1.380649e-23  # J/K


@dataclass(frozen=True)
class WireCoil:
    """A coil of copper wire in layers on a former."""

    shape: Literal["circle", "square"]
    inner_size: float  # radius of the former, or half of its side (m)
    turns: int
    layers: int  # concentric ones, all equally full
    wire: float  # diameter of the copper (m)
    insulated: float  # diameter with insulation, the distance of turns and layers (m)

    @property
    def rows(self) -> int:
        """Turns along the axis."""
        return -(-self.turns // self.layers)

    @property
    def sizes(self) -> Array:
        """Radius, or half of the side, of each layer (m), shape (layers,)."""
        return self.inner_size + self.insulated * (0.5 + np.arange(float(self.layers)))

    @property
    def area(self) -> float:
        """Mean area of the turns (m^2)."""
        form = np.pi if self.shape == "circle" else 4.0
        return float(form * np.mean(self.sizes**2))

    @property
    def wire_length(self) -> float:
        """Length of the wire (m)."""
        form = 2.0 * np.pi if self.shape == "circle" else 8.0
        return float(self.turns * form * np.mean(self.sizes))

    @property
    def mass(self) -> float:
        """Mass of the copper (kg)."""
        return self.wire_length * COPPER_DENSITY * np.pi * (0.5 * self.wire) ** 2

    @property
    def section(self) -> tuple[float, float]:
        """Width along the axis and depth of the winding (m)."""
        return self.rows * self.insulated, self.layers * self.insulated

    @property
    def inductance(self) -> float:
        """Inductance (H)."""
        full = self.layers * self.rows
        whole = coil_inductance(self.shape, self.sizes, self.rows, self.insulated, self.wire)
        return whole * (self.turns / full) ** 2

    def resistance(self, temperature_degc: float = REFERENCE_DEGC) -> float:
        """Return the resistance to direct current (ohm)."""
        cold = COPPER_RESISTIVITY * self.wire_length / (np.pi * (0.5 * self.wire) ** 2)
        return float(cold * (1.0 + COPPER_PER_K * (temperature_degc - REFERENCE_DEGC)))

    def alternating_ratio(self, frequency_hz: float) -> float:
        """Return the resistance to alternating current relative to that to direct current.

        Of skin and neighbouring layers, by the field of a long coil (P. L. Dowell, Proc. IEE 113,
        1966, 1387): an estimate for a short one.
        """
        if frequency_hz == 0.0:
            return 1.0
        depth = np.sqrt(COPPER_RESISTIVITY / (np.pi * frequency_hz * MU0))
        x = np.sqrt(np.pi) / 2.0 * self.wire / depth * np.sqrt(self.wire / self.insulated)
        skin = (np.sinh(2.0 * x) + np.sin(2.0 * x)) / (np.cosh(2.0 * x) - np.cos(2.0 * x))
        layer = (np.sinh(x) - np.sin(x)) / (np.cosh(x) + np.cos(x))
        return float(x * (skin + 2.0 / 3.0 * (self.layers**2 - 1) * layer))

    def heat_loss(self, temperature_degc: float, air_degc: float) -> float:
        """Return the heat that its surface gives away (W)."""
        perimeter = 2.0 * sum(self.section)
        area = perimeter * self.wire_length / self.turns
        return heat_loss(area, perimeter / np.pi, temperature_degc, air_degc)

    def axial_field(self, current: float, distance: Array) -> Array:
        """Return the field of all turns on the axis, at distances from the middle (T)."""
        height = self.insulated * (np.arange(float(self.rows)) - 0.5 * (self.rows - 1))
        z, size = distance[..., None, None] - height[:, None], self.sizes
        if self.shape == "circle":
            turn = 2.0 * np.pi * size**2 / (z**2 + size**2) ** 1.5
        else:
            turn = 8.0 * size**2 / ((z**2 + size**2) * np.sqrt(z**2 + 2.0 * size**2))
        return np.asarray(MU0_OVER_4PI * current * self.turns * np.mean(turn, axis=(-2, -1)))

    def noise_density(self, frequency_hz: float, temperature_degc: float) -> float:
        """Return the field whose voltage is the thermal noise, used as a receiver (T/sqrt(Hz))."""
        kelvin = temperature_degc + ZERO_DEGC
        volts = np.sqrt(4.0 * BOLTZMANN * kelvin * self.resistance(temperature_degc))
        return float(volts / (2.0 * np.pi * frequency_hz * self.turns * self.area))


@dataclass(frozen=True)
class OperatingPoint:
    """A coil that is driven, when its temperature no longer rises."""

    # current, voltage: peak, at its terminals or those of coil and capacitor (A, V)
    current: float
    voltage: float
    power: float  # mean (W)
    temperature_degc: float


def resonance_capacitance(inductance: float, frequency_hz: float) -> float:
    """Return the capacitance in series, ``1 / (w^2 L)``, that leaves only the resistance (F)."""
    return 1.0 / ((2.0 * np.pi * frequency_hz) ** 2 * inductance)


def operating_point(
    coil: WireCoil,
    *,
    current: float | None = None,
    voltage: float | None = None,
    frequency_hz: float = 0.0,
    tuned: bool = False,
    air_degc: float = REFERENCE_DEGC,
) -> OperatingPoint | None:
    """Return the equilibrium of a coil in still air; None if it has none below 300 degC.

    `current`, `voltage`: peak (A, V), one of the two. `frequency_hz`: zero for direct current.
    `tuned`: whether `resonance_capacitance` is in series with it.
    """
    reactance = 0.0 if tuned else 2.0 * np.pi * frequency_hz * coil.inductance
    mean = 0.5 if frequency_hz else 1.0

    def at(temperature_degc: float) -> OperatingPoint:
        resistance = coil.resistance(temperature_degc)
        impedance = float(np.hypot(resistance, reactance))
        peak = (voltage or 0.0) / impedance if current is None else current
        return OperatingPoint(peak, peak * impedance, mean * peak**2 * resistance, temperature_degc)

    def is_cooled(step: int) -> bool:
        reached = at(air_degc + RESOLUTION_K * step)
        return reached.power <= coil.heat_loss(reached.temperature_degc, air_degc)

    steps = range(int((HOTTEST_DEGC - air_degc) / RESOLUTION_K))
    first = bisect_left(steps, True, key=is_cooled)
    return at(air_degc + RESOLUTION_K * first) if first < len(steps) else None
