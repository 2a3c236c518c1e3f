"""The command that designs an installation: its files, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import yaml
from conftest import Refuse, Worked, run_command

from magfusion.files.site import load_site
from magfusion.model.trust import Risk
from magfusion.results.coverage import coverage
from magfusion.results.design.pattern import stronger

FILES = {
    "coverage.parquet",
    "design.png",
    "error_budget.png",
    "report.html",
    "report.json",
    "run.rrd",
    "site.yaml",
}
QUICK = ("--box", "0,6,0,5,0,3", "--spacing", 1.5, "--grid", 3, "--axes", 3, "--starts", 1)


@pytest.mark.slow
def test_the_command_writes_a_site_that_has_what_the_report_says(
    worked: Worked, tmp_path: Path
) -> None:
    site, place = worked.log / "site.yaml", tmp_path / "design"
    coil = ("--coil", "wire=1e-3,turns=100,radius=0.3")
    keep = ("--beacons", 2, "--keep", "A", "--random", 5, *coil)
    run_command("design", site, "-o", place, *QUICK, *keep)
    # Goes on from an earlier result, and replaces it.
    run_command("design", site, "-o", place, *QUICK, *keep, "--continue", place / "site.yaml")
    assert {path.name for path in place.iterdir()} == FILES
    report = json.loads((place / "report.json").read_text())
    built = load_site(place / "site.yaml")
    assert [b.name for b in built.beacons] == ["A", "B1", "B2"]
    for beacon in built.beacons[1:]:
        where = [report[f"{beacon.name}.position_{axis}_m"] for axis in "xyz"]
        assert np.allclose(where, beacon.position_world, rtol=0, atol=1e-12)
    table = pyarrow.parquet.read_table(place / "coverage.parquet").to_pydict()
    points = np.stack([table[f"position_{axis}"] for axis in "xyz"], axis=1)
    result = coverage(built, points, report["window_s"], risk=Risk())
    assert result.protection_level_m is not None
    assert report["protection_level_m_worst"] == pytest.approx(np.max(result.protection_level_m))
    assert report["random_layouts"] == 5
    assert report["protection_level_m_worst"] < report["random_worst_level_m_median"]
    assert report["position_sigma_m_median"] < report["random_best_position_sigma_m_worst"]
    for beacon in built.beacons[1:]:
        current, volts = (report[f"{beacon.name}.{name}"] for name in ("current_a", "voltage_v"))
        assert 0.0 < report[f"{beacon.name}.power_w"] <= 0.5 * current * volts * (1.0 + 1e-9)
    assert report["search_complete"]


def test_the_command_says_where_to_hold_the_platform_next(worked: Worked, tmp_path: Path) -> None:
    site, place = worked.log / "site.yaml", tmp_path / "motion"
    run_command("design", site, "-o", place, "--motion", 2, "--poses", "known", *QUICK)
    assert {p.name for p in place.iterdir()} == {
        "motion.parquet",
        "motion.png",
        "report.html",
        "report.json",
    }
    report = json.loads((place / "report.json").read_text())
    table = pyarrow.parquet.read_table(place / "motion.parquet").to_pydict()
    assert len(table["parameter"]) == report["stops"] == 2
    for number, name in enumerate(table["parameter"]):
        assert table["sigma_after"][number] < table["sigma_before"][number]
        assert name in report["notes"][number]
    assert report["worst_excess_after"] <= report["worst_excess_before"]


def test_a_site_that_is_known_exactly_has_nothing_to_calibrate(
    worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    site = yaml.safe_load((worked.log / "site.yaml").read_text())
    for part in (*site["beacons"], site["platform"]["magnetometer"]):
        del part["sigma"]
    (tmp_path / "exact.yaml").write_text(yaml.safe_dump(site))
    reported = refuse(
        "design", tmp_path / "exact.yaml", "-o", tmp_path / "m", "--motion", 2, *QUICK
    )
    assert "all sigmas are zero" in reported


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (("--keep", "A,Z"), "no beacon 'Z'"),
        (("--template", "Z"), "--template Z"),
        (("--band", "20"), "--band '20'"),
        (("--band", "20,21"), "has 1 tones"),
        (("--moment", 1, "--moment-budget", 4), "not both"),
        (("--spacing", "1e-3"), "--spacing"),
        (("--grid", "1e-3"), "--grid"),
        (("--beacons", 0), "--beacons"),
        (("--apart", 100), "--apart 100 m"),
        (("--hall", "nowhere.yaml", "--box", "0,1,0,1,0,1"), "not both"),
    ],
)
def test_an_option_that_cannot_be_is_refused(
    options: tuple[object, ...], reported: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    quick = () if "--hall" in options else QUICK
    assert reported in refuse(
        "design", worked.log / "site.yaml", "-o", tmp_path / "d", *quick, *options
    )


@pytest.mark.slow
def test_an_accuracy_that_is_needed_has_the_smallest_moment(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """By `coverage` of the written site: its moment, rounded up to two digits, is the smallest."""
    need, place = 0.01, tmp_path / "design"  # m
    wanted = ("--beacons", 3, "--need", need, "--objective", "sigma")
    run_command("design", worked.log / "site.yaml", "-o", place, *QUICK, *wanted)
    report = json.loads((place / "report.json").read_text())
    table = pyarrow.parquet.read_table(place / "coverage.parquet").to_pydict()
    points = np.stack([table[f"position_{axis}"] for axis in "xyz"], axis=1)
    built = load_site(place / "site.yaml")

    def worst(factor: float) -> float:
        site = replace(built, beacons=tuple(stronger(b, factor) for b in built.beacons))
        return float(np.max(coverage(site, points, report["window_s"]).position_sigma))

    assert worst(1.0) <= need
    assert worst(0.89) > need
    screen = [line.strip() for line in capfd.readouterr().out.splitlines()]
    assert screen[:2] == ["design of site", "REACHED"]
    assert len(screen) <= 12
    row = next(line for line in screen if line.startswith("design  "))
    assert row.split()[1:3] == [f"{1e3 * report['position_sigma_m_worst']:.3g}", "mm"]
    moment = f"{report['B1.moment_a_m2']:.3g} A m^2"
    assert any(line.startswith("beacons") and f"3 of {moment} at" in line for line in screen)
    assert screen[-2].startswith(f"next: magfusion sheet {place / 'site.yaml'}")
