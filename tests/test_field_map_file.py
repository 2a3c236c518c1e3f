"""Field maps come back from their file as they were; a file that is wrong says so in a sentence."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import yaml
from conftest import change_table

from magfusion.errors import InputError
from magfusion.files.field_map import read_field_maps, write_field_maps
from magfusion.files.site import load_site, save_site
from magfusion.model.field_map import FieldMap
from magfusion.model.site import Site
from magfusion.simulation.demo_site import demo_site

MAX_EPOCHS = np.array([[1.0, 2.0, 0.5], [3.0, 1.0, 1.5]])


def _map(seed: int, count: int) -> FieldMap:
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 30.0, (count, 4, 4))
    return FieldMap(
        points_world=rng.uniform(0.0, 4.0, (count, 3)),
        weights=rng.normal(size=(count, 4)),
        information=root @ np.swapaxes(root, 1, 2),
        length_scale=0.8 + seed,
        gain_sigma=0.1,
        rotation_sigma=0.05,
        residual=0.003,
    )


def _mapped_site() -> Site:
    """Return a site of which two beacons have a map, the second before the first."""
    site = demo_site()
    first, second, *others = site.beacons
    beacons = (replace(first, field_map=_map(1, 5)), replace(second, field_map=_map(2, 7)), *others)
    return replace(site, beacons=beacons)


def _assert_same(result: FieldMap | None, wanted: FieldMap | None) -> None:
    assert result is not None
    assert wanted is not None
    for name in FieldMap.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(result, name), getattr(wanted, name), err_msg=name)
    np.testing.assert_array_equal(result.variance(MAX_EPOCHS), wanted.variance(MAX_EPOCHS))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    place = tmp_path / "map.parquet"
    write_field_maps({"A": _map(1, 5), "B": _map(2, 7)}, place)
    return place


def test_maps_come_back_to_the_last_bit(path: Path) -> None:
    result = read_field_maps(path)
    assert list(result) == ["A", "B"]
    _assert_same(result["A"], _map(1, 5))
    _assert_same(result["B"], _map(2, 7))


# Refusals --------------------------------------------------------------------------------------


def _refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_field_maps(path)
    findings = str(caught.value)
    assert findings.startswith(f"{path}: ")
    assert "\n" not in findings
    return findings


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    findings = _refusal(tmp_path / "none.parquet")
    assert "there is no such field map; learn it by calibrate fieldmap" in findings


def test_a_file_that_is_no_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    path.write_text("x,y\n1,2\n")
    assert "is no field map" in _refusal(path)


COLUMNS = ("beacon", "position_y", "weight_3", "information_02", "length_scale", "residual")


@pytest.mark.parametrize("column", COLUMNS)
def test_a_missing_column_is_named(path: Path, column: str) -> None:
    change_table(path, lambda table: table.pop(column))
    assert f"column {column} is missing; learn the field map again" in _refusal(path)


def _put(column: str, value: object) -> Callable[[dict[str, Any]], object]:
    return lambda table: table[column].__setitem__(3, value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None])
@pytest.mark.parametrize("column", COLUMNS[1:])
def test_what_is_no_number_is_refused(path: Path, column: str, value: float | None) -> None:
    change_table(path, _put(column, value))
    assert f"column {column} holds what no map does" in _refusal(path)


@pytest.mark.parametrize("column", ["length_scale", "gain_sigma", "rotation_sigma", "residual"])
def test_a_process_without_a_size_is_refused(path: Path, column: str) -> None:
    change_table(path, _put(column, 0.0))
    assert f"column {column} holds what no map does" in _refusal(path)


def test_words_for_numbers_are_refused(path: Path) -> None:
    change_table(path, lambda table: table.update(weight_0=["much"] * 12))
    assert "holds no numbers" in _refusal(path)


def test_a_table_without_rows_is_refused(path: Path) -> None:
    pa.parquet.write_table(pa.parquet.read_table(path)[:0], path)
    assert "holds no rows" in _refusal(path)


# Beside a site ---------------------------------------------------------------------------------


def test_a_site_carries_its_maps_on_beside_it(tmp_path: Path) -> None:
    site = _mapped_site()
    save_site(site, tmp_path / "refined.yaml")
    assert (tmp_path / "refined_field_map.parquet").is_file()
    content = yaml.safe_load((tmp_path / "refined.yaml").read_text())
    assert content["world"]["field_map"] == "refined_field_map.parquet"
    result = load_site(tmp_path / "refined.yaml")
    for again, beacon in zip(result.beacons, site.beacons, strict=True):
        if beacon.field_map is None:
            assert again.field_map is None
        else:
            _assert_same(again.field_map, beacon.field_map)


def test_a_site_without_maps_has_no_file_beside_it(tmp_path: Path) -> None:
    save_site(demo_site(), tmp_path / "site.yaml")
    assert [p.name for p in tmp_path.iterdir()] == ["site.yaml"]


def test_a_site_whose_map_was_left_behind_is_refused(tmp_path: Path) -> None:
    save_site(_mapped_site(), tmp_path / "site.yaml")
    (tmp_path / "site_field_map.parquet").unlink()
    with pytest.raises(InputError, match=r"site_field_map\.parquet: there is no such field map"):
        load_site(tmp_path / "site.yaml")


def test_a_map_of_a_beacon_that_the_site_does_not_have_is_refused(tmp_path: Path) -> None:
    save_site(_mapped_site(), tmp_path / "site.yaml")
    maps = read_field_maps(tmp_path / "site_field_map.parquet")
    write_field_maps(maps | {"Z": _map(3, 4)}, tmp_path / "site_field_map.parquet")
    with pytest.raises(InputError) as caught:
        load_site(tmp_path / "site.yaml")
    findings = str(caught.value)
    assert findings.startswith(f"{tmp_path / 'site_field_map.parquet'}: maps beacon Z, which ")
    assert "does not have (it has " in findings
