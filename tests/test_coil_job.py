"""The command that tabulates coils, and what it refuses."""

from typing import Any

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.jobs.coil import CoilSettings, run
from magfusion.results.figures import number

BEACON: dict[str, Any] = {"wire": 5e-4, "turns": 100, "radius": 0.1, "amperes": 1.0}


def test_the_figures_agree_with_each_other() -> None:
    """Volts that a tuned coil needs are those that give the same moment, in equilibrium."""
    figures = run(CoilSettings(**BEACON, frequency=1010.0, series="capacitor"))
    volts = {**BEACON, "amperes": None, "volts": figures["voltage_v"]}
    again = run(CoilSettings(**volts, frequency=1010.0, series="capacitor"))
    assert again["moment_a_m2"] == pytest.approx(figures["moment_a_m2"], rel=1e-5)
    omega = 2.0 * np.pi * 1010.0
    resonance = omega**2 * number(figures["inductance_h"]) * number(figures["capacitor_f"])
    assert resonance == pytest.approx(1.0)
    assert figures["field_10m_t"] == pytest.approx(
        2e-10 * number(figures["moment_a_m2"]),
        rel=2e-4,
    )
    untuned = run(CoilSettings(**BEACON, frequency=1010.0))
    assert untuned["voltage_v"] == pytest.approx(32.0, rel=0.02)


def test_thick_wire_in_many_layers_is_noted() -> None:
    figures = run(CoilSettings(**{**BEACON, "wire": 2e-3, "frequency": 1010.0}))
    note = next(f.note for f in figures.all if f.name == "alternating_ratio")
    assert "use thinner or stranded wire" in note


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"side": 0.2}, "--radius of a round coil or --side of a square one: give one"),
        ({"volts": 1.0}, "--amperes or --volts: give one"),
        ({"series": "capacitor"}, "blocks a steady current; give a --frequency"),
        ({"insulated": 4e-4}, "--insulated must be at least --wire"),
        ({"layers": 101}, "--layers must be at most the turns"),
        ({"amperes": 30.0}, "the coil burns: in still air it exceeds 300 °C; give less current"),
    ],
)
def test_what_is_no_coil_is_refused(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        run(CoilSettings(**{**BEACON, **change}))
