"""Several magnetometers through the pipe: the states of the log, whatever comes late."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_several_magnetometers import two_magnetometers

from magfusion.estimation.demodulated_apart import demodulated_apart
from magfusion.estimation.navigator import NavigatorSettings
from magfusion.files.fields import by_own_clocks
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.files.site import save_site
from magfusion.files.stream import json_line
from magfusion.files.trajectory_table import read_trajectory
from magfusion.jobs.navigate import NavigateSettings, run_navigate
from magfusion.jobs.replay import run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

BOX = np.array([[1.0, 1.0, 0.5], [4.0, 3.0, 1.5]])
EKF = NavigatorSettings("ekf")


@pytest.fixture(scope="module")
def site() -> Site:
    return two_magnetometers(demo_site(coil_radius=None))


@pytest.fixture(scope="module")
def raw(site: Site) -> Log:
    config = SimulationConfig(box_world=BOX, duration=9.0)
    return simulate_log(site, config, np.random.default_rng(5)).log


@pytest.fixture(scope="module")
def demodulated(site: Site, raw: Log) -> Log:
    fields = demodulated_apart(raw, site).log.fields
    assert fields is not None
    return replace(raw, waveforms={}, fields=by_own_clocks(fields, site))


def written(log: Log, site: Site, place: Path) -> Path:
    write_log(log, place / "log")
    save_site(site, place / "log" / "site.yaml")
    return place / "log"


def records(directory: Path) -> list[dict[str, Any]]:
    """Return a log as the records that `replay` prints."""
    sink = io.BytesIO()
    run_replay(open_log(directory), sink, "json", realtime=False)
    return [json.loads(line) for line in sink.getvalue().splitlines()]


def piped(
    lines: list[dict[str, Any]], directory: Path, settings: StreamSettings | None = None
) -> list[dict[str, Any]]:
    """Return the states that a stream leads to."""
    settings = StreamSettings(EKF) if settings is None else settings
    source, sink = io.BytesIO(b"".join(map(json_line, lines))), io.BytesIO()
    run_stream(directory / "site.yaml", settings, source, sink, io.StringIO())
    told = [json.loads(line) for line in sink.getvalue().splitlines()]
    return [state for state in told if state["started"]]


@pytest.mark.parametrize("kind", ["raw", "demodulated"])
def test_a_log_and_its_records_lead_to_the_same_states(
    kind: str, site: Site, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    log: Log = request.getfixturevalue(kind)
    directory = written(log, site, tmp_path)
    settings = NavigateSettings(log=directory, estimator="ekf")
    run_navigate(settings, tmp_path / "out")
    expected = read_trajectory(tmp_path / "out" / "trajectory.parquet", log.epoch_ns)
    found = piped(records(directory), directory)
    assert len(found) == len(expected.time) > 10
    for name, values in (("time", expected.time), ("position", expected.position_world)):
        told = np.array([state[name] for state in found])
        np.testing.assert_allclose(told, values, rtol=0.0, atol=1e-7)
