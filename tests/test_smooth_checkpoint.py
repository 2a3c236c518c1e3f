"""A smoother that is killed between its passes goes on to the same result, or says why not."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.files.trajectory_table import read_trajectory
from magfusion.jobs.smooth import SmoothSettings, run
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

DURATION = 6.0  # s


class Killed(BaseException):
    """What ends a process from outside: nothing catches it."""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    room = tmp_path_factory.mktemp("log")
    site = demo_site(coil_radius=None)
    config = SimulationConfig(DEMO_BOX_WORLD, duration=DURATION, time_offset=0.004)
    write_log(simulate_log(site, config, np.random.default_rng(4)).log, room / "log")
    save_site(site, room / "log" / "site.yaml")
    return room / "log"


@pytest.fixture(scope="module")
def whole(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("whole") / "run"
    run(SmoothSettings(log=log), output)
    return output


@pytest.fixture
def remaining(log: Path, tmp_path: Path) -> Path:
    """Return what a run left that was killed in its third pass."""

    def kill(stage: str, _done: int, _total: int) -> None:
        if stage == "pass 3":
            raise Killed

    place = tmp_path / "passes.bin"
    with pytest.raises(Killed):
        run(SmoothSettings(log=log, checkpoint=place), tmp_path / "run", kill)
    assert not (tmp_path / "run").exists()
    return place


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_result(
    log: Path, whole: Path, remaining: Path, tmp_path: Path
) -> None:
    reported: list[str] = []
    settings = SmoothSettings(log=log, checkpoint=remaining, resume=True)
    run(settings, tmp_path / "run", lambda stage, _done, _total: reported.append(stage))
    assert next(stage for stage in reported if stage.startswith("pass ")) == "pass 3"
    assert not remaining.exists()
    own, same = (read_trajectory(p / "trajectory.parquet", 0) for p in (tmp_path / "run", whole))
    for field in fields(own):
        np.testing.assert_array_equal(getattr(own, field.name), getattr(same, field.name))
    for name in ("site.yaml", "trajectory.tum"):
        assert (tmp_path / "run" / name).read_bytes() == (whole / name).read_bytes()


def test_a_damaged_checkpoint_is_refused_and_kept(
    log: Path, remaining: Path, tmp_path: Path
) -> None:
    sound = remaining.read_bytes()
    settings = SmoothSettings(log=log, checkpoint=remaining, resume=True)
    spoiled = bytearray(sound)
    spoiled[len(sound) // 2] ^= 1
    for damaged in (sound[:-1], bytes(spoiled)):
        remaining.write_bytes(damaged)
        with pytest.raises(InputError, match=r"passes.bin: is damaged; run without --resume"):
            run(settings, tmp_path / "run")
        assert remaining.read_bytes() == damaged
    remaining.write_bytes(sound)
    site = load_site(log / "site.yaml")
    other = replace(site, model_error=2.0 * site.model_error + 1e-4)
    save_site(other, tmp_path / "other.yaml")
    with pytest.raises(InputError, match="is the checkpoint of another log, site or setting"):
        run(replace(settings, site=tmp_path / "other.yaml"), tmp_path / "run")
    remaining.write_text("notes of mine, longer than a header " * 9)
    for resume in (True, False):
        with pytest.raises(InputError, match=r"passes\.bin: is n"):
            run(replace(settings, resume=resume), tmp_path / "run")
    assert remaining.read_text().startswith("notes of mine")


def test_what_has_no_passes_to_keep_is_refused(log: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--resume requires a file"):
        SmoothSettings(log=log, resume=True)
    with pytest.raises(InputError, match="--checkpoint stores the passes over one log"):
        SmoothSettings(log=log, more=(log,), checkpoint=tmp_path / "passes.bin")
    with pytest.raises(InputError, match="is no directory; create it"):
        run(SmoothSettings(log=log, checkpoint=tmp_path / "none" / "p.bin"), tmp_path / "run")
