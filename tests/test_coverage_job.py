"""The command that plans an installation: its files, and what it refuses."""

import json
import math
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import yaml
from conftest import Refuse, Worked, run_command
from matplotlib.image import imread
from rerun.chunk import RrdReader

from magfusion.results.coverage_colours import COLOURS

FILES = {"coverage.parquet", "coverage.png", "run.rrd", "report.html", "report.json"}


@pytest.mark.slow
def test_the_command_writes_table_picture_recording_and_report(
    worked: Worked, tmp_path: Path
) -> None:
    site, place = worked.log / "site.yaml", tmp_path / "plan"
    for options in (("--height", 1.5), ("--extra-beacon",)):  # an earlier result is replaced
        run_command("coverage", site, "-o", place, "--spacing", 1, *options)
    assert {path.name for path in place.iterdir()} == FILES
    assert (place / "coverage.png").read_bytes().startswith(b"\x89PNG")
    assert (place / "run.rrd").read_bytes().startswith(b"RRF")
    table = pyarrow.parquet.read_table(place / "coverage.parquet").to_pydict()
    report = json.loads((place / "report.json").read_text())
    assert report["points"] == len(table["position_x"])
    assert report["median_with_extra_m"] < report["median_without_extra_m"]
    for sigma, determined in zip(table["position_sigma"], table["determined"], strict=True):
        assert math.isfinite(sigma) is determined
    pixels = np.round(255 * np.asarray(imread(place / "coverage.png"))[..., :3])
    in_picture = {tuple(pixel) for pixel in pixels.reshape(-1, 3).astype(int).tolist()}
    best, *_, worst = drawn = _mean_sigma_by_colour(place, table)
    assert best[0] < worst[0]
    assert [colour for _, colour in drawn] == list(COLOURS.values())  # by growing sigma
    assert in_picture.issuperset(COLOURS.values())


def _mean_sigma_by_colour(
    place: Path, table: dict[str, list[float]]
) -> list[tuple[float, tuple[int, ...]]]:
    """Return mean sigma and colour of the recording's points, by growing sigma."""
    where = np.stack([table[f"position_{axis}"] for axis in "xyz"], axis=1)
    result = []
    for chunk in RrdReader(place / "run.rrd").stream().to_chunks():
        batch = chunk.to_record_batch()
        drawn = chunk.entity_path.startswith("/world/position_sigma/")
        if drawn and "Points3D:colors" in batch.schema.names:
            [points] = batch.column("Points3D:positions").to_pylist()
            [[packed]] = batch.column("Points3D:colors").to_pylist()
            rows = [int(np.argmin(np.abs(where - point).sum(axis=1))) for point in points]
            sigma = [table["position_sigma"][row] for row in rows]
            if sigma and np.all(np.isfinite(sigma)):
                colour = tuple(packed >> shift & 255 for shift in (24, 16, 8))
                result.append((float(np.mean(sigma)), colour))
    return sorted(result)


def test_a_volume_that_is_nowhere_determined_is_reported_as_such(
    worked: Worked, tmp_path: Path
) -> None:
    site = yaml.safe_load((worked.log / "site.yaml").read_text())
    site["beacons"] = site["beacons"][:1]
    site["beacons"][0]["synchronised"] = False
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(site))
    run_command("coverage", tmp_path / "one.yaml", "-o", tmp_path / "plan", "--height", 1.5)
    report = json.loads((tmp_path / "plan" / "report.json").read_text())
    assert report["share_determined"] == 0.0
    assert report["position_sigma_m_median"] is None


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (("--spacing", "0"), "--spacing"),
        (("--spacing", "nan"), "--spacing"),
        (("--spacing", "1e-4"), "points"),
        (("--window", "-1"), "--window"),
        (("--window", "nan"), "--window"),
        (("--height", "inf"), "--height"),
        (("--box", "0,1,0,1,0"), "--box"),
        (("--box", "0,1,1,0,0,1"), "--box"),
    ],
)
def test_an_option_that_cannot_be_is_refused(
    options: tuple[str, ...], reported: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    site = worked.log / "site.yaml"
    assert reported in refuse("coverage", site, "-o", tmp_path / "plan", *options)


def test_a_site_that_is_not_there_is_refused_by_name(tmp_path: Path, refuse: Refuse) -> None:
    missing = tmp_path / "nowhere.yaml"
    assert str(missing) in refuse("coverage", missing, "-o", tmp_path / "plan")


def test_other_files_are_not_replaced(worked: Worked, tmp_path: Path, refuse: Refuse) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    refuse("coverage", worked.log / "site.yaml", "-o", tmp_path / "mine")


def test_time_slots_ask_for_the_window(worked: Worked, tmp_path: Path, refuse: Refuse) -> None:
    site = yaml.safe_load((worked.log / "site.yaml").read_text())
    for slot, coil in enumerate(site["beacons"][0]["coils"]):
        coil["slot"] = slot
    path = tmp_path / "slots.yaml"
    path.write_text(yaml.safe_dump(site))
    assert "--window" in refuse("coverage", path, "-o", tmp_path / "plan")
