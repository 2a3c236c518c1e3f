"""Import of EuRoC MAV folders (ASL format), as visual-inertial benchmarks are published.

Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 35(10), 2016. Columns are known by
their place: the headers' wording differs between the data sets that share the format.
"""

import csv
import re
from pathlib import Path

from magfusion.errors import InputError
from magfusion.files.inertial_tables import read_if_there, read_imu, read_waveform
from magfusion.files.table import TIME, Span, find_table
from magfusion.files.trajectory_table import read_trajectory
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.trajectory import Trajectory

_IMU = (TIME, "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
_FIELD = (TIME, "field_x", "field_y", "field_z")
_TRUTH = (
    *(TIME, "position_x", "position_y", "position_z", "qw", "qx", "qy", "qz"),
    *("velocity_x", "velocity_y", "velocity_z"),
    *("gyro_bias_x", "gyro_bias_y", "gyro_bias_z"),
    *("accel_bias_x", "accel_bias_y", "accel_bias_z"),
)


def is_euroc(path: Path) -> bool:
    """Return whether a directory is a EuRoC folder."""
    streams = path / "mav0"
    if not streams.is_dir():
        return False
    return (streams / "imu0" / "data.csv").is_file() or bool(_magnetometers(path))


def read_euroc(path: Path, start: float | None = None, end: float | None = None) -> Log:
    """Read a EuRoC folder: inertial samples, and magnetometer and ground truth where they are.

    The first inertial stamp is the log's epoch, or the magnetometer's where there is no IMU.

    Parameters
    ----------
    path : Path
        The directory that holds ``mav0``.
    start, end : float, optional
        Seconds since the first inertial sample.

    Raises
    ------
    InputError
        Where a file cannot be read or holds what no instrument gives.
    """
    streams = path / "mav0"
    imu = streams / "imu0" / "data.csv"
    field = find_magnetometer(path)
    truth = find_table(streams / "state_groundtruth_estimate0", "data")
    inertial = imu.is_file() or field is None
    span = Span(_first_stamp(imu if inertial or field is None else field), start, end)
    samples, of_imu = read_imu(imu, span, _IMU) if inertial else (ImuSamples.empty(), ())
    waveform, of_waveform = read_waveform(field, span, _FIELD)
    return Log(
        name=path.resolve().name,
        epoch_ns=span.epoch_ns,
        source="EuRoC folder",
        imu=samples,
        waveform=waveform,
        truth=read_if_there(truth, _read_truth, span),
        noticed=(*of_imu, *of_waveform),
    )


def find_magnetometer(path: Path) -> Path | None:
    """Return the magnetometer's table of a EuRoC folder, whatever its folder is called.

    Raises
    ------
    InputError
        Where there are several.
    """
    result = _magnetometers(path)
    if len(result) > 1:
        names = ", ".join(table.parent.name for table in result)
        raise InputError(f"{path / 'mav0'}: holds several magnetometers: {names}; keep one.")
    return result[0] if result else None


def _magnetometers(path: Path) -> list[Path]:
    return [
        table
        for folder in sorted((path / "mav0").iterdir())
        if re.match(r"mag|compass|field|fluxgate", folder.name, re.I)
        and (table := find_table(folder, "data")) is not None
    ]


def _read_truth(path: Path, span: Span) -> Trajectory:
    return read_trajectory(path, span.epoch_ns, span.start, span.end, _TRUTH)


def _first_stamp(path: Path) -> int:
    result = "no row"
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = csv.reader(stream)
            next(rows)
            result = next(rows)[0]
        return int(result)
    except (StopIteration, IndexError, ValueError) as error:
        raise InputError(
            f"{path}: first column, row 0 (counted from 0): found {result}; write nanoseconds."
        ) from error
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); write the file again.") from error
