"""The table of temperatures of a log."""

from pathlib import Path

from magfusion.files.readings_table import read_readings, write_readings
from magfusion.files.site_temperature import COLDEST, HOTTEST
from magfusion.model.temperature import Temperatures

DEGC = "temperature_degc"


def read_temperatures(path: Path | None, epoch_ns: int) -> Temperatures | None:
    """Read all readings: also those before and after the part of a log that is used."""
    if path is None:
        return None
    remedy = f"write degrees Celsius, from {COLDEST:g} to {HOTTEST:g}"
    bounds = COLDEST, HOTTEST
    return Temperatures(read_readings(path, epoch_ns, DEGC, bounds, remedy, "reading"))


def write_temperatures(temperatures: Temperatures, path: Path, epoch_ns: int) -> None:
    """Write readings as Parquet, sorted by time."""
    write_readings(temperatures.readings, path, epoch_ns, DEGC)
