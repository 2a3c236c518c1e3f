"""The kit's page alone leads from parts to a trajectory, in at most twelve commands."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import soundfile
from page_blocks import blocks
from test_sound_server import PROGRAMS, server

from magfusion.errors import InputError
from magfusion.files.audio import as_recording
from magfusion.jobs.simulate import SimulateSettings
from magfusion.jobs.simulate import run as run_simulation
from magfusion.model.samples import Waveform

PAGE = (Path(__file__).parents[1] / "docs" / "kit.md").read_text()
PLAYED = re.search(r"^```\n(pactl .*\nparecord .*) &\n(paplay .*)\n```$", PAGE, re.M)
SHOWN = re.findall(r"`(magfusion view .*?)`", PAGE)
MAX_COMMANDS = 12
MAX_ERROR = 2e-3  # m, after alignment
__all__ = ["server"]


def commands() -> list[str]:
    """Return the commands that the page runs, in their order."""
    return [
        line
        for language, block in blocks(PAGE)
        if language == "sh"
        for line in block.split("\n")
        if line
    ]


def test_at_most_twelve_commands() -> None:
    assert PLAYED is not None
    assert len(SHOWN) == 1
    played = sum(len(group.splitlines()) for group in PLAYED.groups())
    assert len(commands()) + played + len(SHOWN) <= MAX_COMMANDS


def test_a_voltage_beyond_full_scale_is_refused() -> None:
    wave = Waveform(np.arange(3.0) / 48e3, np.full((3, 3), 2e-6), ac_coupled=True)
    with pytest.raises(
        InputError, match=r"reaches 2 V, beyond the full scale of 1 V; set a larger"
    ):
        as_recording(wave, "a.wav", 1.0, 0)


def test_a_rate_that_no_card_has_is_refused() -> None:
    wave = Waveform(np.arange(99.0) / 48_000.5, np.zeros((99, 3)), ac_coupled=True)
    with pytest.raises(InputError, match=r"whole number of samples a second, not 48000\.5"):
        as_recording(wave, "a.wav", 1.0, 0)


def test_a_sound_card_records_no_steady_field(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a sound card records no static field; declare coil"):
        run_simulation(SimulateSettings(full_scale=1.0, duration=1.0), tmp_path / "walk")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_stranger_plays_a_walk_and_finds_it(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """All commands of the page; where PulseAudio is there, with what is recorded of its sink."""
    assert PLAYED is not None
    plays = all(map(shutil.which, PROGRAMS))
    own = request.getfixturevalue("server") if plays else dict(os.environ)
    own |= {"PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}
    for language, block in blocks(PAGE):
        if language == "yaml":
            (tmp_path / block.split()[1]).write_text(block, encoding="utf-8")

    def run(command: str) -> str:
        done = subprocess.run(
            command, shell=True, cwd=tmp_path, env=own, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command}: {done.stdout} {done.stderr}"
        return done.stdout

    for command in commands():
        if plays and command.startswith("magfusion import"):
            (load, record), play = PLAYED[1].splitlines(), PLAYED[2]
            run(load)
            with subprocess.Popen(record.split(), cwd=tmp_path, env=own) as recorder:
                time.sleep(1.0)  # until it records
                run(play)
                recorder.terminate()
            _end_with_walk(tmp_path / "heard.wav")
            command = command.replace("walk/recording.wav", "heard.wav")
        shown = run(f"{command} --json" if command.startswith("magfusion evaluate") else command)
    assert json.loads(shown)["ate_m"] < MAX_ERROR
    report = json.loads((tmp_path / "heard_run" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"


def _end_with_walk(path: Path) -> None:
    """Cut the silence that a recorder on a busy machine records after the walk."""
    samples, rate_hz = soundfile.read(path, dtype="int32")
    last = np.flatnonzero(samples.any(axis=1))[-1]
    soundfile.write(path, samples[: last + 1], rate_hz, subtype="PCM_24")
