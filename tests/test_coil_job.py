"""The command that tabulates coils, and what it refuses."""

from typing import Any

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.jobs.coil import CoilSettings, run
from magfusion.jobs.coil_drive import DriveSettings
from magfusion.results.design.coil_drive import drive_figures
from magfusion.results.design.pattern import peak_moment, stronger
from magfusion.results.figures import number
from magfusion.simulation.demo_site import demo_site

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


def test_beacons_are_driven_as_the_coil_that_gives_their_moment() -> None:
    """Volts, watts and warming are those of `magfusion coil` with the current of that moment."""
    beacon = demo_site().beacons[0]
    settings = DriveSettings(coil="wire=2e-3, turns=200, radius=0.5, series=capacitor, air=30")
    (row,) = settings.drives([stronger(beacon, 280.0 / peak_moment(beacon))])
    form: dict[str, Any] = {"wire": 2e-3, "turns": 200, "radius": 0.5, "series": "capacitor"}
    assert row.point is not None
    figures = run(
        CoilSettings(**form, air=30.0, amperes=row.point.current, frequency=row.frequency_hz)
    )
    assert figures["moment_a_m2"] == pytest.approx(280.0)
    reported = drive_figures([row])
    for name in ("current_a", "voltage_v", "power_w", "temperature_degc"):
        assert reported[f"{row.beacon}.{name}"] == pytest.approx(number(figures[name]))


def test_a_coil_that_burns_is_named_with_the_remedy() -> None:
    rows = DriveSettings(coil="wire=1e-4,turns=10,radius=0.05").drives(demo_site().beacons[:1])
    assert rows[0].point is None
    assert "more copper" in str(drive_figures(rows)["coil_notes"])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("wire=1e-3,turns=200", "--radius of a round coil or --side"),
        ("wire=1e-3,turns=many,radius=1", "turns=many cannot be used; give e.g."),
        ("turns=200,radius=1", "wire is missing; give e.g. --coil wire="),
        ("wire=1e-3,turns=200,radius=1,amperes=2", "unknown 'amperes'; give wire, turns"),
        ("wire=9,turns=200,radius=1", "--wire must lie between"),
    ],
)
def test_a_text_of_no_coil_is_refused(text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        DriveSettings(coil=text).drives(())
