"""The table of depths of a log: how far along its hole a magnet is, and the magnetometer."""

from pathlib import Path

from magfusion.files.readings_table import read_readings, write_readings
from magfusion.model.rotor import Depths

DEPTH = "depth_m"
DEEPEST = 2e4  # m


def read_depths(path: Path | None, epoch_ns: int) -> Depths | None:
    """Read all depths: also those before and after the part of a log that is used."""
    if path is None:
        return None
    remedy = f"write measured depth in metres, from {-DEEPEST:g} to {DEEPEST:g}"
    return Depths(read_readings(path, epoch_ns, DEPTH, (-DEEPEST, DEEPEST), remedy, "depth"))


def write_depths(depths: Depths, path: Path, epoch_ns: int) -> None:
    """Write depths as Parquet, sorted by time."""
    write_readings(depths.readings, path, epoch_ns, DEPTH)
