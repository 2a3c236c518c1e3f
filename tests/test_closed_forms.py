"""The scenario prints what the closed forms are held to."""

import json
import sys

import closed_forms
import pytest


def test_the_scenario_prints_exact_forms_solution_counts_and_coefficients(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["closed_forms.py"])
    closed_forms.main()
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert figures["direction_error"] < 1e-12
    assert figures["direction_from_phasors_error"] < 1e-12
    for axis in ("minor", "major", "rms"):
        assert figures[f"{axis}_axis_error"] < 1e-9
    assert figures["solutions_1_beacon_attitude_known"] == 2.0
    # A mirror so near the plane that both are one, or so near a beacon that noise tells them.
    assert figures["solutions_1_beacon"] == pytest.approx(4.0, abs=0.05)
    assert figures["solutions_3_beacons"] == 1.0
    assert figures["solutions_3_beacons_polarity_unknown"] == 2.0
    assert figures["coefficient_tensor"] == pytest.approx(0.170, rel=0.05)
    assert figures["coefficient_eq_7"] == pytest.approx(14.5, rel=0.05)
