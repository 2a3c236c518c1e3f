"""Figures: keys of the report, lines of the screen, and beacons of any legal name."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from rich.console import Console

from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.model.site import BeaconSigma, Site
from magfusion.results.figures import (
    ErrorColumn,
    Figure,
    Figures,
    ParameterEstimate,
    Section,
    heading,
)
from magfusion.results.screen import notes, show
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

NAMES = ("B.2", "sensor", "imu", "a b/c [bold] {beacon}")


def shown(figures: Figures) -> str:
    console = Console(width=200, record=True, highlight=False, emoji=False, quiet=True)
    console.quiet = False
    with console.capture() as captured:
        show(figures, None, console)
    return captured.get()


def test_keys_of_ordinary_beacons_are_their_names() -> None:
    figures = Figures(
        Figure("epochs", 3),
        Figure("residual_rms_{beacon}", 1.0, "", "B.2"),
        ParameterEstimate("{beacon}.position_x_m", 0.1, "m", "B.2", sigma=0.01, prior_sigma=0.05),
    )
    assert dict(figures) == {
        "epochs": 3,
        "residual_rms_B.2": 1.0,
        "B.2.position_x_m": 0.1,
        "B.2.position_x_m_sigma": 0.01,
        "B.2.position_x_m_prior_sigma": 0.05,
    }


@pytest.mark.parametrize("name", ["sensor", "magnetometer", "imu", "earth"])
def test_a_beacon_with_the_name_of_another_owner_has_keys_of_its_own(name: str) -> None:
    figures = Figures(
        ParameterEstimate(f"{name}.rotation_x_deg", 1.0, "deg"),
        ParameterEstimate("{beacon}.rotation_x_deg", 2.0, "deg", name),
    )
    assert figures[f"{name}.rotation_x_deg"] == 1.0
    assert figures[f"beacon:{name}.rotation_x_deg"] == 2.0


def test_a_key_that_another_figure_has_names_the_beacon_as_such() -> None:
    """No two names make one key, whatever they are."""
    rival = "hypotheses_{beacon}_rival_chi_square"
    figures = Figures(
        Figure(rival, 1.0, "", "A"),
        Figure("hypotheses_{beacon}", ["there"], "", "A_rival_chi_square"),
        Figure(rival, 2.0, "", "beacon:A"),
    )
    assert figures["hypotheses_A_rival_chi_square"] == 1.0
    assert figures["hypotheses_beacon:A_rival_chi_square"] == ["there"]
    assert figures["hypotheses_beacon:beacon:A_rival_chi_square"] == 2.0


def test_two_figures_of_one_name_are_an_error() -> None:
    with pytest.raises(ValueError, match="epochs"):
        Figures(Figure("epochs", 1), Figure("epochs", 2))


def test_the_screen_has_the_units_and_hides_what_only_the_report_needs() -> None:
    figures = heading("smooth", "walk") | Figures(
        Figure("window_s", 0.4, "s"),
        Figure("cost", 1.0, section=Section.REPORT),
        Figure("ate_m", 0.0123, "m", None, Section.ERRORS, "position", ErrorColumn.RMS),
        Figure("share", 1.0, note="Look here."),
        Figure("residual_rms_{beacon}", 0.5, "", "A", label="residual"),
        Figure("residual_rms_{beacon}", 0.7, "", "B", label="residual"),
    )
    lines = [line.split() for line in shown(figures).splitlines()]
    assert lines[0] == ["smooth", "of", "walk"]
    assert ["position", "(m)", "0.0123"] in lines
    assert ["window", "0.4", "s"] in lines
    assert ["residual", "A", "0.5,", "B", "0.7"] in lines
    assert ["note:", "Look", "here."] in lines
    assert not any("cost" in line for line in lines)
    assert notes(figures) == ["Look here."]


def oddly_named_site() -> Site:
    """Return the demo's site, roughly surveyed."""
    site = demo_site()
    rough = BeaconSigma(
        rotation_beacon=np.full(3, 0.02),
        position_world=np.full(3, 0.02),
        log_moment=np.full(2, 0.01),
    )
    beacons = zip(site.beacons, NAMES, strict=True)
    sensor = site.platform.magnetometer
    sensor = replace(sensor, sigma=replace(sensor.sigma, rotation_sensor=np.full(3, 0.02)))
    return replace(
        site,
        beacons=tuple(replace(b, name=name, sigma=rough) for b, name in beacons),
        platform=replace(site.platform, magnetometer=sensor),
    )


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("odd") / "log"
    place.mkdir()
    site = oddly_named_site()
    config = SimulationConfig(DEMO_BOX_WORLD, duration=12.0)
    write_log(simulate_log(site, config, np.random.default_rng(3)).log, place)
    save_site(site, place / "site.yaml")
    return place


def test_the_screen_of_a_calibration_names_the_largest_change_of_each_beacon() -> None:
    known = {"prior_sigma": 0.02, "sigma": 0.005}
    figures = heading("calibrate log", "walk") | Figures(
        ParameterEstimate("{beacon}.position_x_m", 0.004, "m", "B.2", **known),
        ParameterEstimate("{beacon}.position_y_m", -0.03, "m", "B.2", **known),
        Figure(
            "directions", ["A shifted.", "B shifted."], section=Section.DIRECTIONS, label="open"
        ),
    )
    [line] = [x.split() for x in shown(figures).splitlines() if x.startswith(" B.2")]
    assert line == ["B.2", "position_y_m", "-0.0300", "±", "0.005", "±", "0.02", "2", "of", "2"]
    assert "open  A shifted. (1 more: --verbose)" in shown(figures)


@pytest.mark.slow
@pytest.mark.parametrize("job", [("smooth",), ("navigate", "--lag", 2)])
def test_beacons_of_any_name_are_in_the_report_and_on_the_screen(
    job: tuple[object, ...],
    log: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    output = tmp_path / "run"
    run_command(job[0], log, *job[1:], "-o", output, "--verbose")
    screen = capfd.readouterr().out
    report = json.loads((output / "report.json").read_text())
    level = "residual_rms_{}" if job[0] == "smooth" else "distortion_{}"
    line = next(x for x in screen.splitlines() if "expected)" in x and "B.2" in x)
    for name in NAMES:
        assert f"{name} " in line
        key = f"beacon:{name}" if name in ("sensor", "imu") else name
        assert level.format(key) in report
        for parameter in ("position_x_m", "rotation_z_deg"):
            assert f"{key}.{parameter}" in report
            assert f"{key}.{parameter}" in report["determined"] + report["undetermined"]
        assert any(x.strip().startswith(f"{name}.position (m)") for x in screen.splitlines())
    assert "sensor.rotation_x_deg" in report
    assert report["sensor.rotation_x_deg"] != report["beacon:sensor.rotation_x_deg"]
    assert "imu.time_offset_s" in report
    record = load_site(output / "site.yaml").calibration
    assert record is not None
    assert record["determined"] == report["determined"]
