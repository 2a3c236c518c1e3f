"""Beacons that the site does not declare: found, fitted beside the tones, and said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.data_checks.disturbing_lines import with_disturbing_lines
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.jobs.inputs import Job
from magfusion.jobs.navigate import run_navigate
from magfusion.jobs.navigate_settings import NavigateSettings
from magfusion.jobs.smooth import run_smooth
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
from magfusion.receiver.windows import LockinSettings
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.units import Array

RADIATING = demo_site(coil_radius=None)


def declaring(count: int) -> Site:
    return replace(RADIATING, beacons=RADIATING.beacons[:count])


def simulated(site: Site, seed: int = 1, duration: float = 12.0) -> SimulatedLog:
    config = SimulationConfig(DEMO_BOX_WORLD, duration, "walk")
    return simulate_log(site, config, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def radiated() -> SimulatedLog:
    return simulated(RADIATING)


def off(log: SimulatedLog, site: Site, lockin: LockinSettings | None = None) -> Array:
    """Return by how much the phasors of A and B differ from those of the whole declaration."""
    whole = phasors(log.log, RADIATING, LockinSettings(0.4, 0.2))[0].phasor_sensor[:, :2]
    result = phasors(log.log, site, lockin)[0]
    assert result.time[0] == pytest.approx(0.2, abs=0.01)
    count = min(len(whole), len(result))
    remaining = np.abs(result.phasor_sensor[:count, :2] - whole[:count])
    return np.sqrt(np.mean(remaining**2, axis=(0, 2))) / np.sqrt(np.mean(np.abs(whole) ** 2))


def test_two_undeclared_beacons_are_fitted_beside_the_declared(radiated: SimulatedLog) -> None:
    settings = with_disturbing_lines(radiated.log, declaring(2), None)
    assert settings is not None
    np.testing.assert_allclose(sorted(settings.lines_hz), [30.0, 35.0], rtol=0.0, atol=0.05)
    # By the same window, lines fitted at what was found of their frequencies are as good as tones.
    given = LockinSettings(0.4, 0.2)
    assert np.max(off(radiated, declaring(2), given)) < 1e-3
    # The usual window, which keeps A and B apart, is lengthened by next to nothing.
    assert settings.window == pytest.approx(0.4, rel=0.01)


def test_what_is_fitted_is_said_and_no_reason_for_doubt(radiated: SimulatedLog) -> None:
    result = [
        one
        for one in recorded(radiated.log, declaring(2), BRIDGED_CODES, beacons=True)
        if one.code in ("fitted_line", "undeclared_line")
    ]
    assert [one.code for one in result] == ["fitted_line"]
    assert result[0].verdict is Verdict.TRUSTWORTHY
    assert "fitted with the tones" in result[0].text
    assert "30.0" in result[0].text
    assert "35.0" in result[0].text


def test_nothing_is_fitted_where_all_is_declared(radiated: SimulatedLog) -> None:
    assert with_disturbing_lines(radiated.log, RADIATING, None) is None
    given = LockinSettings(0.5, 0.25)
    assert with_disturbing_lines(radiated.log, RADIATING, given) is given


def test_a_window_that_was_asked_for_is_kept(radiated: SimulatedLog) -> None:
    given = LockinSettings(0.6, 0.3)
    settings = with_disturbing_lines(radiated.log, declaring(2), given)
    assert settings is not None
    assert (settings.window, settings.step) == (0.6, 0.3)
    assert len(settings.lines_hz) == 2


def test_a_line_too_close_to_a_tone_is_left_and_said() -> None:
    """At 20.9 Hz where 20 is declared: no window of use tells them apart."""
    moved = replace(RADIATING.beacons[0], frequency_hz=20.9)
    both = replace(RADIATING, beacons=(moved, *RADIATING.beacons[1:]))
    log = simulated(both).log
    settings = with_disturbing_lines(log, RADIATING, None)
    assert settings is None
    assert "undeclared_line" in {
        one.code for one in recorded(log, RADIATING, BRIDGED_CODES, beacons=True)
    }


def _errors(log: SimulatedLog, site: Site, place: Path) -> tuple[float, float]:
    """Return the position errors of batch and filter (m)."""
    write_log(log.log, place / "log")
    save_site(site, place / "log" / "site.yaml")
    smoothed = run_smooth(Job(place / "log", None, place / "smoothed"), SmootherSettings())
    settings = NavigateSettings(log=place / "log", estimator="ekf")
    navigated = run_navigate(settings, place / "navigated")
    result = [figures["ate_m"] for figures in (smoothed, navigated)]
    assert all(isinstance(one, float) for one in result)
    return float(result[0]), float(result[1])  # type: ignore[arg-type]


@pytest.mark.slow
def test_neither_batch_nor_filter_loses_by_what_is_fitted(tmp_path: Path) -> None:
    """Against the same walk, with the other two declared: two beacons know less than four."""
    fitted = _errors(simulated(RADIATING, duration=20.0), declaring(2), tmp_path / "fitted")
    alone = _errors(simulated(declaring(2), duration=20.0), declaring(2), tmp_path / "alone")
    assert fitted[0] < 1.5 * alone[0]
    assert fitted[1] < 1.5 * alone[1]
