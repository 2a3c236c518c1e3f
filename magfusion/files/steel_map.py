"""Map of steel as a Parquet file: a row for each voxel of possible steel."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet

from magfusion.files.atomic import whole_file
from magfusion.units import Array

STEEL_MAP = "steel.parquet"


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
    names = ("position_x", "position_y", "position_z")
    columns = dict(zip(names, centre_world.T, strict=True))
    columns |= {"edge_m": edge, "polarisability_m3": polarisability}
    with whole_file(path) as unfinished:
        pa.parquet.write_table(pa.table(columns | {"polarisability_sigma_m3": sigma}), unfinished)
