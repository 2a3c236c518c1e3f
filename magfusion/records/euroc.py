"""Import of EuRoC MAV folders (ASL format), as visual-inertial benchmarks are published.

Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 35(10), 2016. Columns are known by
their place: the headers' wording differs between the data sets that share the format.
"""

import csv
from pathlib import Path

from magfusion.errors import InputError
from magfusion.records.samples import Log
from magfusion.records.streams import read_imu, read_waveform
from magfusion.records.table import TIME, Span
from magfusion.records.trajectory_table import read_trajectory

_GYRO_ACCEL = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
_FIELD = ("field_x", "field_y", "field_z")
_POSE = ("position_x", "position_y", "position_z", "qw", "qx", "qy", "qz")
_MOTION = ("velocity_x", "velocity_y", "velocity_z")
_BIASES = tuple(f"{sensor}_bias_{axis}" for sensor in ("gyro", "accel") for axis in "xyz")


def is_euroc(path: Path) -> bool:
    """Tell whether a directory is a EuRoC folder."""
    return (path / "mav0" / "imu0" / "data.csv").is_file()


def read_euroc(path: Path, start: float | None = None, end: float | None = None) -> Log:
    """Read a EuRoC folder: inertial samples, and magnetometer and ground truth where they are.

    The first inertial stamp is the log's epoch.

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
    field = streams / "mag0" / "data.csv"
    truth = streams / "state_groundtruth_estimate0" / "data.csv"
    span = Span(_first_stamp(imu), start, end)
    poses = (TIME, *_POSE, *_MOTION, *_BIASES)
    return Log(
        name=path.resolve().name,
        epoch_ns=span.epoch_ns,
        source="EuRoC folder",
        imu=read_imu(imu, span, (TIME, *_GYRO_ACCEL)),
        waveform=read_waveform(field, span, (TIME, *_FIELD)) if field.is_file() else None,
        truth=read_trajectory(truth, span.epoch_ns, start, end, poses) if truth.is_file() else None,
    )


def _first_stamp(path: Path) -> int:
    found = "no row"
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = csv.reader(stream)
            next(rows)
            found = next(rows)[0]
        return int(found)
    except (StopIteration, IndexError, ValueError) as error:
        raise InputError(
            f"{path}: first column, row 0 (counted from 0): found {found}; write nanoseconds."
        ) from error
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); write the file again.") from error
