"""Inductance, field and warming of wound coils, by independent ways and published formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad

from magfusion.model.physics.free_convection import air, convection
from magfusion.model.physics.inductance import circle_mutual, coil_inductance, square_mutual
from magfusion.model.physics.solenoid import loop_field
from magfusion.model.physics.wire_coil import WireCoil, operating_point, resonance_capacitance

MU0 = 4e-7 * np.pi
ROUND = WireCoil("circle", 0.1, 100, 10, 1.0e-3, 1.1e-3)


def neumann(first: np.ndarray, second: np.ndarray) -> float:
    """Return the mutual inductance of closed polygons (H), by Neumann's double sum."""
    ds, dt = np.roll(first, -1, axis=0) - first, np.roll(second, -1, axis=0) - second
    middle, other = first + 0.5 * ds, second + 0.5 * dt
    apart = np.linalg.norm(middle[:, None] - other, axis=2)
    return float(1e-7 * np.sum(ds @ dt.T / apart))


def square_corners(half: float, height: float, pieces: int) -> np.ndarray:
    along = np.linspace(-half, half, pieces, endpoint=False)
    side = np.column_stack([along, np.full(pieces, -half)])
    turns = [np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), k) for k in range(4)]
    flat = np.concatenate([side @ turn.T for turn in turns])
    return np.column_stack([flat, np.full(len(flat), height)])


def test_mutual_inductance_of_circles_is_the_flux_by_biot_and_savart() -> None:
    radius, inside, height = 0.2, 0.11, 0.07
    rho, weight = np.polynomial.legendre.leggauss(24)
    rho, weight = 0.5 * inside * (rho + 1.0), 0.5 * inside * weight
    points = np.column_stack([rho, 0.0 * rho, np.full(len(rho), height)])
    unit = np.array([0.0, 0.0, np.pi * radius**2])  # A m^2 of one ampere
    flux = 2.0 * np.pi * np.sum(weight * rho * loop_field(points, unit, radius)[:, 2])
    result = circle_mutual(np.array([radius]), np.array([inside]), np.array([height]))
    assert result[0] == pytest.approx(flux, rel=1e-9)


def test_mutual_inductance_of_squares_is_neumanns_integral() -> None:
    first, second, height = 0.2, 0.13, 0.05
    polygons = [square_corners(h, z, 200) for h, z in ((first, 0.0), (second, height))]
    result = square_mutual(np.array([first]), np.array([second]), np.array([height]))
    assert result[0] == pytest.approx(neumann(*polygons), rel=1e-4)


def test_parallel_sides_are_neumanns_integral() -> None:
    """Of a square the sides across add nothing, so that four pairs of sides are all."""
    half, height = 0.1, 0.04
    integrals = [
        dblquad(lambda s, t, d=d: 1e-7 / np.sqrt((s - t) ** 2 + d), -half, half, -half, half)[0]
        for d in (height**2, height**2 + 4 * half**2)
    ]
    result = square_mutual(np.array([half]), np.array([half]), np.array([height]))
    assert result[0] == pytest.approx(4.0 * (integrals[0] - integrals[1]), rel=1e-8)


def test_a_long_coil_is_nagaokas() -> None:
    """Nagaoka's factor of a coil as long as wide is 0.6884; 500 turns are nearly a sheet."""
    radius, rows = 0.05, 500
    pitch = 2.0 * radius / rows
    sheet = 0.688423 * MU0 * np.pi * radius**2 * rows**2 / (2.0 * radius)
    result = coil_inductance("circle", np.array([radius]), rows, pitch, pitch)
    assert result == pytest.approx(sheet, rel=2e-3)


def test_a_coil_of_brooks_has_its_inductance() -> None:
    """A section of c by c at a mean radius of 1.5 c has 1.6994e-6 H/m times a N^2 (Grover)."""
    c, layers = 0.03, 30
    sizes = c + c / layers * (0.5 + np.arange(layers))
    result = coil_inductance("circle", sizes, layers, c / layers, c / layers)
    assert result == pytest.approx(1.6994e-6 * 1.5 * c * layers**4, rel=2e-3)


def test_a_coil_of_many_layers_is_wheelers() -> None:
    """Wheeler (1928) is good to 1 % where its three terms are alike (inches there)."""
    coil = replace(ROUND, inner_size=0.02, turns=400, layers=20)
    width, depth = coil.section
    radius = coil.inner_size + 0.5 * depth
    wheeler = 31.6e-6 * radius**2 * coil.turns**2 / (6.0 * radius + 9.0 * width + 10.0 * depth)
    assert coil.inductance == pytest.approx(wheeler, rel=0.02)


def test_a_square_coil_is_grovers() -> None:
    """Of side s, section b by c: 8e-7 N^2 s (ln(s / (b + c)) + 0.2235 (b + c) / s + 0.726) H."""
    coil = WireCoil("square", 0.25, 100, 10, 1.0e-3, 1.0e-3)
    side, spread = 2.0 * float(np.mean(coil.sizes)), sum(coil.section)
    form = np.log(side / spread) + 0.2235 * spread / side + 0.726
    assert coil.inductance == pytest.approx(8e-7 * 100**2 * side * form, rel=2e-3)


@pytest.mark.parametrize("shape", ["circle", "square"])
def test_the_axial_field_is_that_of_every_turn(shape: str) -> None:
    coil = WireCoil(shape, 0.1, 6, 2, 2.0e-3, 3.0e-3)  # type: ignore[arg-type]
    at = 0.17
    angle = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    total = 0.0
    for size in coil.sizes:
        for height in (-3.0e-3, 0.0, 3.0e-3):
            wire = np.column_stack([size * np.cos(angle), size * np.sin(angle), 0.0 * angle])
            wire = wire if shape == "circle" else square_corners(size, 0.0, 400)
            step = np.roll(wire, -1, axis=0) - wire
            offset = np.array([0.0, 0.0, at - height]) - (wire + 0.5 * step)
            away = np.linalg.norm(offset, axis=1)[:, None]
            total += 1e-7 * np.sum(np.cross(step, offset) / away**3, axis=0)[2]
    assert coil.axial_field(2.0, np.array([at]))[0] == pytest.approx(2.0 * total, rel=1e-4)
    moment = 2.0 * coil.turns * coil.area
    assert coil.axial_field(2.0, np.array([50.0]))[0] == pytest.approx(2e-7 * moment / 50.0**3)


def test_copper_is_that_of_the_tables() -> None:
    """Wire of 1 mm has 21.95 ohm and 6.98 kg per km; copper gains 39.3 % from 20 to 120 degC."""
    per_km = 1000.0 / ROUND.wire_length
    assert ROUND.resistance() * per_km == pytest.approx(21.95, rel=1e-3)
    assert ROUND.mass * per_km == pytest.approx(6.98, rel=1e-3)
    assert ROUND.resistance(120.0) / ROUND.resistance() == pytest.approx(1.393)


def test_air_is_that_of_the_tables() -> None:
    """At 350 K: 208.2e-7 Pa s and 30.0e-3 W/(m K) (Incropera, table A.4), by the gas law."""
    density = 101_325.0 * 28.96e-3 / (8.314 * 350.0)
    assert air(350.0) == pytest.approx((208.2e-7 / density, 30.0e-3), rel=0.01)


@pytest.mark.parametrize("diameter", [0.02, 0.05])
def test_convection_is_morgans(diameter: float) -> None:
    """V. T. Morgan (1975): Nu = 0.48 Ra^(1/4); such correlations scatter by 15 %."""
    viscosity, diffusivity, conductivity = 18.1e-6, 25.7e-6, 28.0e-3  # of air at 50 degC
    rayleigh = 9.81 * 60.0 / 323.15 * diameter**3 / (viscosity * diffusivity)
    morgan = 0.48 * rayleigh**0.25 * conductivity / diameter
    assert convection(diameter, 80.0, 20.0) == pytest.approx(morgan, rel=0.15)


def test_a_driven_coil_is_in_equilibrium() -> None:
    point = operating_point(ROUND, current=3.0, frequency_hz=1000.0, tuned=True)
    assert point is not None
    assert 30.0 < point.temperature_degc < 90.0
    assert point.power == pytest.approx(0.5 * 9.0 * ROUND.resistance(point.temperature_degc))
    assert point.power == pytest.approx(ROUND.heat_loss(point.temperature_degc, 20.0), rel=1e-3)
    again = operating_point(ROUND, voltage=point.voltage, frequency_hz=1000.0, tuned=True)
    assert again is not None
    assert again.current == pytest.approx(3.0, rel=1e-5)


def test_without_a_capacitor_the_inductance_limits_the_current() -> None:
    """At 1 kHz the volts are those of w L; the capacitor takes them away."""
    free = operating_point(ROUND, voltage=10.0, frequency_hz=1000.0)
    assert free is not None
    assert free.current == pytest.approx(10.0 / (2e3 * np.pi * ROUND.inductance), rel=0.01)
    farad = resonance_capacitance(ROUND.inductance, 1000.0)
    assert 1.0 / (2e3 * np.pi * farad) == pytest.approx(2e3 * np.pi * ROUND.inductance)


def test_a_coil_that_burns_has_no_equilibrium() -> None:
    assert operating_point(ROUND, current=40.0) is None


def test_neighbouring_layers_raise_the_resistance() -> None:
    """Dowell's series: 1 + (5 p^2 - 1) / 45 x^4 of p layers, of a thickness of x skin depths."""
    depth = 0.0661 / np.sqrt(200.0)  # m, of copper at 200 Hz
    x = 0.886 * ROUND.wire / depth * np.sqrt(1.0 / 1.1)
    series = 1.0 + (5.0 * ROUND.layers**2 - 1.0) / 45.0 * x**4
    assert ROUND.alternating_ratio(200.0) == pytest.approx(series, rel=2e-3)
    assert ROUND.alternating_ratio(1e-3) == pytest.approx(1.0, abs=1e-6)
