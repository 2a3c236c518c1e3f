"""The fix command: what it finds beside the pose, and what it says of rival poses."""

import json
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from conftest import Refuse, Worked, run_command

from magfusion.files.site import load_site, save_site


def report_of(run: Path) -> dict[str, object]:
    result: dict[str, object] = json.loads((run / "report.json").read_text())
    return result


def test_free_phases_and_gains_make_a_fix_less_sure(worked: Worked, tmp_path: Path) -> None:
    run_command("fix", worked.log, "-o", tmp_path / "free", "--free", "phase,gain")
    fixed, free_parameters = (report_of(run) for run in (worked.fixes, tmp_path / "free"))
    assert free_parameters["epochs"] == fixed["epochs"]
    assert float(str(free_parameters["ate_m"])) > float(str(fixed["ate_m"]))
    cov = [
        pq.read_table(run / "trajectory.parquet", columns=["cov_33"]).column(0).to_numpy()
        for run in (worked.fixes, tmp_path / "free")
    ]
    assert (cov[1] > cov[0]).all()


@pytest.mark.parametrize(
    ("options", "result"),
    [
        (("--free", "phase,matrix"), "matrix"),
        (("--free", ""), "nothing"),
        (("--free", "gain", "--method", "paper-lines"), "--free belongs to --method likelihood"),
    ],
)
def test_what_cannot_be_free_is_refused(
    options: tuple[str, ...], result: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    assert result in refuse("fix", worked.log, "-o", tmp_path / "run", *options)


def test_rivals_are_told_in_the_report_the_table_and_on_the_screen(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    site = load_site(worked.log / "site.yaml")
    save_site(replace(site, beacons=site.beacons[1:2]), tmp_path / "site.yaml")
    run_command("fix", worked.log, "--site", tmp_path / "site.yaml", "-o", tmp_path / "run")
    figures = report_of(tmp_path / "run")
    sentences = figures["ambiguity"]
    assert isinstance(sentences, list)
    name = site.beacons[1].name
    assert any(f"on the opposite side of beacon {name}" in sentence for sentence in sentences)
    assert int(str(figures["ambiguity_mirror_epochs"])) > 0
    out = capfd.readouterr().out
    assert all(sentence in out for sentence in sentences)
    table = pq.read_table(tmp_path / "run" / "fixes.parquet").to_pydict()
    best = [r for r, h in zip(table["relation"], table["hypothesis"], strict=True) if h == 0]
    assert set(best) == {"best"}
    assert f"mirror {name}" in table["relation"]


def test_every_fix_has_a_verdict_a_level_and_what_was_left_out(
    worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    rows = pq.read_table(worked.fixes / "trajectory.parquet").to_pydict()
    report = report_of(worked.fixes)
    assert report["verdict"] == "trustworthy"
    assert set(rows["verdict"]) <= {"trustworthy", "doubtful"}
    levels = [level for level in rows["protection_level_m"] if level is not None]
    assert len(levels) >= 0.9 * len(rows["time_ns"])
    run_command("fix", worked.log, "-o", tmp_path / "run", "--risk", 1e-2)
    wider = pq.read_table(tmp_path / "run" / "trajectory.parquet").to_pydict()
    both = zip(rows["protection_level_m"], wider["protection_level_m"], strict=True)
    assert all(a > b for a, b in both if a is not None and b is not None)
    table = pq.read_table(worked.fixes / "fixes.parquet").to_pydict()
    assert {"protection_level_m", "protection_level_deg", "excluded", "verdict"} <= table.keys()
    assert "--risk must lie between" in refuse(
        "fix", worked.log, "-o", tmp_path / "no", "--risk", 0.0
    )
    options = ("--method", "paper-lines", "--survey", "x", "--risk", 1e-3)
    assert "no protection level" in refuse("fix", worked.log, "-o", tmp_path / "no", *options)
