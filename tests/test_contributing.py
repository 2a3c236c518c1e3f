"""What CONTRIBUTING.md shows is there, and its measurement is one."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from derivatives import central_difference
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.measurement import Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.model.parameters import Block, Calibration
from magfusion.units import Array

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
ANYWHERE = re.compile(r"(?<!\w)((?:\w+/)*\w+(?:/|\.py))(?=[`: ])")


def test_every_file_that_it_names_is_there() -> None:
    named = {
        path for code in re.findall(r"`([^`\n]+)`", TEXT) for path in ANYWHERE.findall(f"{code} ")
    }
    assert len(named) > 15
    for path in named:
        assert (ROOT / path).exists() or any((ROOT / "magfusion").rglob(path.rstrip("/"))), path


def test_its_measurement_has_the_derivative_that_it_says() -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```$", TEXT, re.M | re.S)
    names: dict[str, Any] = {
        "np": np,
        "dataclass": dataclass,
        "Measurement": Measurement,
        "Rows": Rows,
        "States": States,
        "Calibration": Calibration,
        "Block": Block,
        "Array": Array,
    }
    exec(block, names)
    rng = np.random.default_rng(1)
    attitude = Rotation.random(3, rng=rng).as_matrix()
    place = rng.standard_normal((3, 3))
    measured = names["Range"](np.arange(3), np.full(3, 2.0), np.full(3, 0.1), (4.0, 1.0, 2.0))

    def rows(step: Array) -> Rows:
        rotated = attitude @ Rotation.from_rotvec(step[:3]).as_matrix()
        states = States(rotated, place + attitude @ step[3:], np.zeros((3, 3)), lambda: np.zeros(6))
        result: Rows = measured.linearize(states, None, ())
        return result

    by_pose = rows(np.zeros(6)).by_pose
    assert by_pose is not None
    numeric = central_difference(lambda step: rows(step).error, 6, 1e-6)
    np.testing.assert_allclose(by_pose, numeric, rtol=0, atol=1e-7)
    distance = np.linalg.norm(place - [4.0, 1.0, 2.0], axis=1)
    np.testing.assert_allclose(rows(np.zeros(6)).error[:, 0, 0], (distance - 2.0) / 0.1, rtol=1e-12)
