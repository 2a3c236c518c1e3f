"""A coil that is declared by its turns has the field of all of them, by Biot and Savart."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from magfusion.errors import InputError
from magfusion.files.site import load_site, save_site
from magfusion.files.site_beacon import WindingEntry
from magfusion.model.coil_field import alone, coil_fields
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.physics.finite_size import coil_coupling, coil_kappa
from magfusion.model.physics.solenoid import loop_field
from magfusion.model.physics.winding import Winding, wound_coil
from magfusion.units import Array

FLAT = Winding(8.0, 2, 30, 0.228, 0.002, 0.002)  # the beacon of 46 cm of paper 004
LONG = Winding(10.0, 3, 35, 0.070, 0.0024, 0.01)  # that of 15 by 35 cm of paper 002
THICK = Winding(2.0, 10, 5, 0.05, 0.005, 0.006)  # twice as wide outside as inside
SINGLE = Winding(5.0, 1, 1, 0.299, 0.002, 0.002)
AXIS = np.array([0.36, -0.48, 0.8])


def around(distance: float) -> Array:
    direction = np.random.default_rng(5).normal(size=(12, 3))
    return np.asarray(distance * direction / np.linalg.norm(direction, axis=1)[:, None])


def of_every_turn(winding: Winding, offset: Array) -> Array:
    total = np.zeros_like(offset)
    for radius in winding.radii:
        moment = winding.current * np.pi * radius**2 * AXIS
        for height in winding.heights:
            total += loop_field(offset - height * AXIS, moment, float(radius))
    return total


def worst(result: Array, true: Array) -> float:
    return float(np.max(np.linalg.norm(result - true, axis=1) / np.linalg.norm(true, axis=1)))


WOUND = """\
magfusion_site: 1
beacons:
  - name: A
    position_m: [0, 0, 0]
    rpy_deg: [0, 0, 0]
    frequency_hz: 25
    coils:
      - winding: {{axis: [0.72, -0.96, 1.6], current_a: {0.current}, layers: {0.layers},
          rows: {0.rows}, inner_radius_m: {0.inner_radius}, wire_m: {0.wire}, pitch_m: {0.pitch}}}
platform:
  imu: {{gyro_noise: 2.0e-3, accel_noise: 2.0e-2, gyro_bias_walk: 1.0e-5, accel_bias_walk: 1.0e-3,
        gyro_bias_sigma: 1.0e-2, accel_bias_sigma: 0.1}}
  magnetometer: {{noise_density_t_rthz: 2.5e-10}}
"""


@pytest.mark.parametrize(
    ("winding", "allowed"), [(FLAT, 2e-6), (LONG, 3e-6), (THICK, 1e-3), (SINGLE, 1e-9)]
)
def test_the_declared_coil_has_the_field_of_every_turn(
    winding: Winding, allowed: float, tmp_path: Path
) -> None:
    """Where a dipole is off by a per cent or more; what is left falls by the fourth power."""
    site, again = tmp_path / "site.yaml", tmp_path / "again.yaml"
    site.write_text(WOUND.format(winding))
    save_site(load_site(site), again)
    beacon = load_site(again).beacons[0]
    size = np.hypot(winding.radii[-1], np.ptp(winding.heights))
    remaining = []
    for distance in (3.0 * size, 6.0 * size):
        offset = around(distance)
        true = of_every_turn(winding, offset)
        remaining.append(worst(coil_fields(alone(beacon), offset)[:, 0], true))
        dipole = dipole_field(offset, np.tile(beacon.coils[0].moment_beacon, (len(offset), 1)))
        assert worst(dipole, true) > 0.008
    assert remaining[0] < allowed
    assert remaining[1] < max(remaining[0] / 15.0, 1e-9)


@pytest.mark.parametrize("winding", [FLAT, LONG, THICK, SINGLE])
def test_moment_and_kappa_are_those_of_every_turn(winding: Winding) -> None:
    coil = wound_coil(winding)
    radius, height = np.meshgrid(winding.radii, winding.heights)
    assert coil.moment == pytest.approx(winding.current * np.pi * np.sum(radius**2), rel=1e-12)
    own = np.sum(radius**2 * (radius**2 / 8.0 - height**2 / 2.0)) / np.sum(radius**2)
    assert coil.kappa == pytest.approx(own, rel=1e-9)
    assert coil.kappa == pytest.approx(coil_kappa(coil.radius, coil.length), rel=1e-12)
    offset = around(12.0 * float(np.hypot(winding.radii[-1], np.ptp(winding.heights))))
    true = of_every_turn(winding, offset)
    senses = np.broadcast_to(np.array([0.6, 0.0, 0.8]), offset.shape)
    term = coil_coupling(
        offset, coil.moment * np.ones((12, 1)) * AXIS, senses, np.array(coil.kappa)
    )
    error = np.abs(term.value - np.sum(true * senses, axis=1))
    assert np.max(error / np.linalg.norm(true, axis=1)) < 2e-4


COIL = "coils:\n      - "


@pytest.mark.parametrize(
    ("change", "findings"),
    [
        (("current_a: 8.0", "current_a: 0.0"), "coils[0].winding.current_a: found 0.0;"),
        (("[0.72, -0.96, 1.6]", "[0, 0, 0]"), "winding.axis: found [0, 0, 0]; give the direction"),
        (("layers: 2,", ""), "coils[0].winding.layers: is missing; add it"),
        (
            ("rows: 30", "rows: 30, turns: 30"),
            "coils[0].winding.turns: is not a known key; remove it or",
        ),
        (("pitch_m: 0.002", "pitch_m: 0.001"), "winding.pitch_m: found 0.001; give at least wire"),
        (("current_a: 8.0", "current_a: 1.0e-11"), "these turns have 9.97e-11 A m^2"),
        (
            (COIL, COIL + "moment_a_m2: [0, 0, 80]\n        "),
            "moment_a_m2: found [0.0, 0.0, 80.0];",
        ),
        ((COIL, COIL + "radius_m: 0.2\n        "), "coils[0].radius_m: found 0.2; remove it or"),
    ],
)
def test_a_winding_that_is_none_is_answered_by_its_place(
    change: tuple[str, str], findings: str, tmp_path: Path
) -> None:
    text = WOUND.format(FLAT)
    assert change[0] in text
    path = tmp_path / "site.yaml"
    path.write_text(text.replace(*change))
    with pytest.raises(InputError) as caught:
        load_site(path)
    assert findings in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_winding_in_the_table_of_formats_has_what_is_said_of_it() -> None:
    page = (Path(__file__).parents[1] / "docs" / "formats.md").read_text()
    (line,) = (line for line in page.splitlines() if line.startswith("`winding: {"))
    entry = yaml.safe_load(line.split("`")[1])["winding"]
    coil = WindingEntry.model_validate(entry).coil()
    assert coil.moment == pytest.approx(80.0, abs=0.5)
    assert coil.radius == pytest.approx(0.23, abs=5e-4)
    assert coil.length == pytest.approx(0.06, abs=5e-4)
