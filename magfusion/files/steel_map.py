"""Maps of steel as Parquet files.

``steel.parquet`` has a row for each voxel of possible steel, with its polarisability.  The file
next to a site has a row for each voxel and coil, with the moment by which the field is predicted.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.files.plain_table import POSITION, column, integers, numbers, read_whole, refuse_rows
from magfusion.model.steel_field import SteelField
from magfusion.units import AnyArray, Array

STEEL_MAP = "steel.parquet"
_AGAIN = "omit world.steel and map the steel again (magfusion smooth --map-steel)."
_MOMENT = ("moment_x_a_m2", "moment_y_a_m2", "moment_z_a_m2")


def write_steel_map(
    path: Path, centre_world: Array, edge: Array, polarisability: Array, sigma: Array
) -> None:
    """Write the voxels of a map.

    Parameters
    ----------
    centre_world : ndarray, shape (v, 3)
        (m)
    edge : ndarray, shape (v,)
        (m)
    polarisability, sigma : ndarray, shape (v,)
        Moment over the magnetising field, rms over the beacons, and its sigma (m^3).
    """
    columns = dict(zip(POSITION, centre_world.T, strict=True))
    columns |= {"edge_m": edge, "polarisability_m3": polarisability}
    _write(path, columns | {"polarisability_sigma_m3": sigma})


def join_steel_maps(path: Path, parts: Sequence[Path]) -> None:
    """Write the voxels of several maps."""
    with whole_file(path) as unfinished:
        pa.parquet.write_table(
            pa.concat_tables([pa.parquet.read_table(part) for part in parts]), unfinished
        )


def write_steel_fields(path: Path, steel: dict[str, SteelField]) -> None:
    """Write the steel of beacons by name."""
    parts = [_rows(name, coil, own) for name, own in steel.items() for coil in range(own.coils)]
    _write(path, {key: np.concatenate([part[key] for part in parts]) for key in parts[0]})


def _rows(beacon: str, coil: int, steel: SteelField) -> dict[str, AnyArray]:
    count = len(steel.radius)
    return {
        "beacon": np.full(count, beacon, dtype=object),
        "coil": np.full(count, coil),
        **dict(zip(POSITION, steel.centre_world.T, strict=True)),
        "radius_m": steel.radius,
        **dict(zip(_MOMENT, steel.moment_world[:, coil].T, strict=True)),
    }


def read_steel_fields(path: Path, coils: dict[str, int]) -> dict[str, SteelField]:
    """Read the steel of beacons by name.

    `coils`: names of the site's beacons, and how many coils each has. Raises InputError where the
    file is missing or unreadable, lacks a column, or is of other beacons. Beacons that were
    removed from the site are left out.
    """
    table = read_whole(path, "map of steel")
    beacon = np.array([str(name) for name in column(table, "beacon", path).to_pylist()])
    coil = integers(table, "coil", path)
    centre, moment = (
        np.stack([numbers(table, name, path) for name in names], axis=1)
        for names in (POSITION, _MOMENT)
    )
    radius = numbers(table, "radius_m", path)
    refuse_rows(radius <= 0.0, path, "column radius_m", radius, "a positive number")
    mapped = list(dict.fromkeys(beacon.tolist()))
    removed, new = [n for n in mapped if n not in coils], [n for n in coils if n not in mapped]
    if removed and new:
        raise InputError(
            f"{path}: has the steel of beacon {removed[0]}, which the site does not have, and none"
            f" of beacon {new[0]}; name the beacons of the site as in the map, or {_AGAIN}"
        )
    result = {}
    for name in [n for n in mapped if n in coils]:
        rows = [np.flatnonzero((beacon == name) & (coil == k)) for k in range(coils[name])]
        if len({len(own) for own in rows}) != 1 or sum(map(len, rows)) != np.sum(beacon == name):
            raise InputError(
                f"{path}: beacon {name} has other coils here than in the site; {_AGAIN}"
            )
        first = rows[0]
        moment_world = np.stack([moment[own] for own in rows], axis=1)
        result[name] = SteelField(centre[first], radius[first], moment_world)
    return result


def _write(path: Path, columns: dict[str, AnyArray]) -> None:
    with whole_file(path) as unfinished:
        pa.parquet.write_table(pa.table(columns), unfinished)
