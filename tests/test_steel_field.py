"""Steel of a room as part of a beacon's field: physics, and the file beside a site."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import magpylib
import numpy as np
import pyarrow.parquet
import pytest
import yaml
from conftest import change_table, run_command
from derivatives import central_difference, relative_to_group

from magfusion.errors import InputError
from magfusion.files.site import load_site, save_site
from magfusion.model.site import Site
from magfusion.model.steel_field import SteelField
from magfusion.results.design.pattern import template_of
from magfusion.simulation.demo_site import demo_site

CENTRE_WORLD = np.array([[1.0, 2.0, 0.5], [3.0, 1.0, 1.5], [2.0, 2.5, 2.0]])  # m
RADIUS = np.array([0.25, 0.3, 0.1])  # m
OUTSIDE_WORLD = np.array([2.1, 1.3, 1.4])  # m


def _steel(coils: int = 2) -> SteelField:
    moment = np.random.default_rng(3).normal(0.0, 5.0, (len(RADIUS), coils, 3))
    return SteelField(CENTRE_WORLD, RADIUS, moment)


def _site() -> Site:
    """Return a site of which the first two beacons have steel, each its own."""
    site = demo_site()
    first, second, *others = site.beacons
    more = _steel(len(second.coils)).joined(_steel(len(second.coils)))
    beacons = replace(first, steel=_steel(len(first.coils))), replace(second, steel=more)
    return replace(site, beacons=(*beacons, *others))


def test_a_voxel_is_a_uniformly_magnetised_sphere() -> None:
    """As magpylib has it, outside and inside."""
    steel, rng = _steel(), np.random.default_rng(1)
    magnets: Any = magpylib.magnet
    place = CENTRE_WORLD[0] + rng.uniform(-0.3, 0.3, (40, 3))
    distance = np.linalg.norm(place[:, None] - CENTRE_WORLD, axis=2)
    assert np.sum(distance < RADIUS) > 3  # inside
    wanted = np.zeros((40, 2, 3))
    for centre, radius, moment in zip(CENTRE_WORLD, RADIUS, steel.moment_world, strict=True):
        volume = 4.0 / 3.0 * np.pi * radius**3
        for k in range(2):
            sphere = magnets.Sphere(
                diameter=2.0 * radius, position=centre, magnetization=moment[k] / volume
            )
            wanted[:, k] += sphere.getB(place)
    np.testing.assert_allclose(steel.fields(place), wanted, rtol=1e-9, atol=1e-18)


def test_the_gradient_is_that_of_the_field() -> None:
    steel = _steel()
    field, gradient = steel.fields_and_gradients(OUTSIDE_WORLD)
    np.testing.assert_array_equal(field, steel.fields(OUTSIDE_WORLD))
    expected = central_difference(lambda step: steel.fields(OUTSIDE_WORLD + step), 3, 1e-5)
    assert relative_to_group(gradient, expected) < 1e-8
    # Neither curl nor divergence.
    np.testing.assert_allclose(gradient, np.swapaxes(gradient, 1, 2), rtol=1e-9, atol=1e-18)
    assert steel.fields_and_gradients(np.zeros((0, 3)))[1].shape == (0, 2, 3, 3)
    np.testing.assert_allclose(np.trace(gradient, axis1=1, axis2=2), 0.0, rtol=0.0, atol=1e-15)


def test_far_from_the_origin_no_digits_are_lost() -> None:
    """A mine's coordinates are of its country's grid."""
    far_world = np.array([5e5, -4e6, 300.0])  # m
    steel = _steel()
    away = SteelField(CENTRE_WORLD + far_world, RADIUS, steel.moment_world)
    field, gradient = away.fields_and_gradients(OUTSIDE_WORLD + far_world)
    near_field, near_gradient = steel.fields_and_gradients(OUTSIDE_WORLD)
    np.testing.assert_allclose(field, near_field, rtol=1e-6, atol=0.0)
    np.testing.assert_allclose(gradient, near_gradient, rtol=1e-5, atol=1e-15)


def test_a_site_keeps_its_steel(tmp_path: Path) -> None:
    site = _site()
    save_site(site, tmp_path / "site.yaml")
    result = load_site(tmp_path / "site.yaml")
    for beacon, wanted in zip(result.beacons, site.beacons, strict=True):
        assert (beacon.steel is None) == (wanted.steel is None)
        if beacon.steel is not None and wanted.steel is not None:
            np.testing.assert_array_equal(beacon.steel.centre_world, wanted.steel.centre_world)
            np.testing.assert_array_equal(beacon.steel.radius, wanted.steel.radius)
            np.testing.assert_array_equal(beacon.steel.moment_world, wanted.steel.moment_world)
    bare = result.without_steel()
    assert all(beacon.steel is None for beacon in bare.beacons)
    assert bare.without_steel() is bare


def _change_radius(path: Path) -> None:
    change_table(path, lambda table: table.update(radius_m=[0.0] * len(table["coil"])))


def _drop_moment(path: Path) -> None:
    change_table(path, lambda table: table.pop("moment_y_a_m2"))


def _rename_beacon(path: Path) -> None:
    change_table(path, lambda table: table.update(beacon=["Z"] * len(table["coil"])))


def _drop_coil(path: Path) -> None:
    change_table(path, lambda table: table.update(coil=[0] * len(table["coil"])))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_change_radius, "column radius_m, row 0: found 0.0; write a positive number"),
        (_drop_moment, "column moment_y_a_m2 is missing"),
        (_rename_beacon, "has the steel of beacon Z, which the site does not have, and none of"),
        (_drop_coil, "beacon A has other coils here than in the site; omit world.steel and map"),
        (Path.unlink, "there is no such file; give the path of a map of steel"),
    ],
)
def test_a_wrong_map_of_steel_is_refused(
    tmp_path: Path, change: Callable[[Path], None], said: str
) -> None:
    save_site(_site(), tmp_path / "site.yaml")
    change(tmp_path / "site_steel.parquet")
    with pytest.raises(InputError) as error:
        load_site(tmp_path / "site.yaml")
    assert str(error.value).startswith(f"{tmp_path / 'site_steel.parquet'}: ")
    assert said in str(error.value)


def test_a_removed_beacon_takes_its_steel_with_it(tmp_path: Path) -> None:
    """Its moments are of no other beacon's field; one of a new name may be the same, renamed."""
    save_site(_site(), tmp_path / "site.yaml")
    content = yaml.safe_load((tmp_path / "site.yaml").read_text())
    first, second = content["beacons"][:2]
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(content | {"beacons": [second]}))
    (known,) = load_site(tmp_path / "site.yaml").beacons
    assert known.steel is not None
    assert len(known.steel.radius) == 2 * len(RADIUS)
    renamed = content | {"beacons": [first | {"name": "Z"}, second]}
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(renamed))
    with pytest.raises(InputError, match=r"beacon A, .* none of beacon Z; .* omit world\.steel"):
        load_site(tmp_path / "site.yaml")
    del renamed["world"]["steel"]
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(renamed))
    assert load_site(tmp_path / "site.yaml").beacons[1].steel is None


def test_a_copied_beacon_induces_nothing_in_the_steel_of_its_model() -> None:
    assert template_of(_site(), "A").steel is None


def test_a_simulated_log_has_no_map_of_steel(tmp_path: Path) -> None:
    """The simulator does not know the estimators' model."""
    save_site(_site(), tmp_path / "site.yaml")
    simulate = "simulate", "--site", tmp_path / "site.yaml", "--duration", 2
    run_command(*simulate, "-o", tmp_path / "log")
    assert load_site(tmp_path / "log" / "site.yaml").beacons[0].steel is None
    assert not (tmp_path / "log" / "site_steel.parquet").exists()


def test_the_file_has_a_row_for_each_voxel_and_coil(tmp_path: Path) -> None:
    site = _site()
    save_site(site, tmp_path / "site.yaml")
    table = pyarrow.parquet.read_table(tmp_path / "site_steel.parquet")
    first, second = site.beacons[:2]
    assert table.num_rows == len(RADIUS) * (len(first.coils) + 2 * len(second.coils))
