"""The commands that write a setting-out sheet and accept an installation, and their refusals."""

import csv
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, Worked, run_command

from magfusion.files.site import load_site


@pytest.mark.slow
def test_a_sheet_has_its_plan_marks_and_distances(
    worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    site, place = worked.log / "site.yaml", tmp_path / "sheet"
    run_command("sheet", site, "-o", place)
    run_command("sheet", site, "-o", place, "--coil", "wire=1e-3,turns=100,radius=0.3")
    assert (tmp_path / "sheet.1" / "distances.csv").is_file()  # what was measured is kept
    assert {path.name for path in place.iterdir()} == {
        "distances.csv",
        "report.html",
        "report.json",
        "sheet.pdf",
        "site.yaml",
    }
    assert (place / "sheet.pdf").read_bytes().startswith(b"%PDF")
    built = load_site(place / "site.yaml")
    points = dict(built.aiding[0].marks_world) | {b.name: b.position_world for b in built.beacons}
    with (place / "distances.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {b.name for b in built.beacons} <= {row["from"] for row in rows}
    for row in rows:
        length = float(np.linalg.norm(points[row["from"]] - points[row["to"]]))
        assert abs(float(row["declared_m"]) - length) < 1e-4  # m; as printed
        assert row["measured_m"] == ""
    # The log was recorded before there were marks, and the site of it declares none.
    assert "declares no marks" in refuse("accept", worked.log)
    marked = ("--site", place / "site.yaml")
    assert "no record of marks" in refuse("accept", worked.log, *marked)
    bad = tmp_path / "bad.csv"
    bad.write_text("from,to,measured_m\nA,Z,3.0\n")
    reported = refuse("accept", worked.log, *marked, "--distances", bad)
    assert "no beacon or mark 'Z'" in reported
