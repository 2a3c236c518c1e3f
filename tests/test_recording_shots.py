"""Recordings open in the viewer, on a virtual screen, with every part of the screen in use."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import Worked, run_command
from matplotlib.image import imread

pytestmark = pytest.mark.slow

SIZE = (1600, 1000)  # of the window
DARK = 0.075  # of full brightness: the viewer's background
TEXT = 0.6


def _shot(recording: Path, directory: Path) -> np.ndarray:
    """Return what the viewer shows at its opening: brightness, shape (rows, columns)."""
    screen = shutil.which("xvfb-run")
    if screen is None:
        pytest.skip("xvfb-run is not installed: no screenshot of a recording was looked at")
    png = directory / "shot.png"
    window = "x".join(map(str, SIZE))
    viewer = [sys.executable, "-m", "rerun", str(recording), "--screenshot-to", str(png)]
    run = subprocess.run(
        [screen, "-a", "-s", "-screen 0 1700x1100x24", *viewer, "--window-size", window],
        capture_output=True,
        text=True,
        timeout=150,
    )
    findings = run.stdout + run.stderr
    if not png.is_file() and re.search("adapter|wgpu|graphics|libGL|libEGL|xkb", findings, re.I):
        pytest.skip(f"the viewer has no graphics here: {findings.strip().splitlines()[-1]}")
    assert png.is_file(), findings
    pixels = np.asarray(imread(png))[..., :3]
    assert pixels.shape[0] / pixels.shape[1] == pytest.approx(SIZE[1] / SIZE[0], rel=0.01)
    return pixels.max(axis=2)


def _in_use(shot: np.ndarray, rows: tuple[float, float], columns: tuple[float, float]) -> float:
    """Return the share of a grid of small squares that are not all background."""
    height, width = shot.shape
    part = shot[
        int(rows[0] * height) : int(rows[1] * height),
        int(columns[0] * width) : int(columns[1] * width),
    ]
    side = width // 40
    squares = part[: len(part) // side * side, : part.shape[1] // side * side]
    squares = squares.reshape(len(squares) // side, side, -1, side)
    return float(np.mean(squares.max(axis=(1, 3)) > DARK))


def test_a_smoothed_walk_opens_with_verdict_scene_scales_and_errors(
    worked: Worked, tmp_path: Path
) -> None:
    shot = _shot(worked.smoothed / "run.rrd", tmp_path)
    height, width = shot.shape
    banner = shot[int(0.08 * height) : int(0.12 * height), : int(0.2 * width)]
    assert np.mean(banner > TEXT) > 0.01
    assert _in_use(shot, (0.25, 0.65), (0.0, 0.6)) > 0.9  # scene, its grid at least
    assert _in_use(shot, (0.25, 0.95), (0.62, 1.0)) > 0.8  # errors
    # Left of each of the plots of errors stand three numbers: of zero, above and below.
    remaining = shot[
        int(0.24 * height) : int(0.96 * height), int(0.602 * width) : int(0.616 * width)
    ]
    rows = np.flatnonzero((remaining > TEXT).any(axis=1))
    groups = 1 + int(np.sum(np.diff(rows) > 0.008 * height))
    assert groups >= 9


def test_a_coverage_opens_with_its_points_and_their_colours(worked: Worked, tmp_path: Path) -> None:
    built = tmp_path / "coverage"
    run_command("coverage", worked.log / "site.yaml", "-o", built, "--spacing", 1)
    shot = _shot(built / "run.rrd", tmp_path)
    assert _in_use(shot, (0.3, 0.9), (0.1, 0.7)) > 0.9
    legend = shot[int(0.07 * len(shot)) : int(0.3 * len(shot)), int(0.76 * shot.shape[1]) :]
    assert np.mean(legend > TEXT) > 0.005
