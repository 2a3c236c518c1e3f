"""Heat that a coil gives to still air: free convection of a horizontal cylinder, and radiation.

Equilibrium is ``power = area (h (T - T_air) + emissivity sigma (T^4 - T_air^4))`` with ``h = Nu k /
D`` and ``Nu = (0.60 + 0.387 Ra^(1/6) / (1 + (0.559 / Pr)^(9/16))^(8/27))^2`` (S. W. Churchill and
H. H. S. Chu, Int. J. Heat Mass Transfer 18, 1975, 1049).
"""

import numpy as np

STEFAN_BOLTZMANN = 5.670374e-8  # W/(m^2 K^4)
EMISSIVITY = 0.9  # of enamel, lacquer and tape
PRANDTL = 0.71
GRAVITY = 9.81  # m/s^2
PRESSURE, GAS_CONSTANT = 101_325.0, 287.05  # Pa, J/(kg K)
ZERO_DEGC = 273.15  # K


def air(temperature_k: float) -> tuple[float, float]:
    """Return kinematic viscosity (m^2/s) and conductivity (W/(m K)) of air, by Sutherland's law."""
    power = (temperature_k / ZERO_DEGC) ** 1.5
    viscosity = 1.716e-5 * power * (ZERO_DEGC + 110.4) / (temperature_k + 110.4)
    conductivity = 0.0241 * power * (ZERO_DEGC + 194.0) / (temperature_k + 194.0)
    return viscosity * GAS_CONSTANT * temperature_k / PRESSURE, conductivity


def convection(diameter: float, surface_degc: float, air_degc: float) -> float:
    """Return the coefficient h of a horizontal cylinder in still air (W/(m^2 K))."""
    hot, cold = surface_degc + ZERO_DEGC, air_degc + ZERO_DEGC
    film = 0.5 * (hot + cold)
    viscosity, conductivity = air(film)
    buoyancy = GRAVITY * abs(hot - cold) / film * diameter**3
    rayleigh = buoyancy * PRANDTL / viscosity**2
    shape = (1.0 + (0.559 / PRANDTL) ** (9 / 16)) ** (8 / 27)
    return float((0.60 + 0.387 * np.cbrt(np.sqrt(rayleigh)) / shape) ** 2 * conductivity / diameter)


def heat_loss(area: float, diameter: float, surface_degc: float, air_degc: float) -> float:
    """Return the heat that a cylinder's surface (m^2) gives to air and walls around it (W)."""
    hot, cold = surface_degc + ZERO_DEGC, air_degc + ZERO_DEGC
    radiated = EMISSIVITY * STEFAN_BOLTZMANN * (hot**4 - cold**4)
    return area * (convection(diameter, surface_degc, air_degc) * (hot - cold) + radiated)
