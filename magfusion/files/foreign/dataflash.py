"""DataFlash, the flight log of ArduPilot: its messages as tables."""

from collections import defaultdict
from collections.abc import Collection
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.units import AnyArray

_HEAD = b"\xa3\x95\x80"  # of a message that defines a format, with which a log begins
_INSTANCES = ("I", "C")  # columns that number sensors, and cores of the EKF
_ANGLES = ("Yaw", "Pitch", "Roll")


def read_dataflash(path: Path, names: Collection[str]) -> dict[str, dict[str, AnyArray]]:
    """Return the columns of messages; a further instance of a message is NAME:INSTANCE.

    Attitudes in angles have the quaternion, too. Raises InputError where pymavlink is not
    installed. Raises ValueError where the file is no such log.
    """
    try:
        from pymavlink.DFReader import DFReader_binary
    except ImportError as error:
        raise InputError(
            f"{path}: is a DataFlash log, which the package pymavlink reads; install it with"
            " pip install 'magfusion[mavlink]'."
        ) from error
    with path.open("rb") as file:
        if file.read(len(_HEAD)) != _HEAD:
            raise ValueError("it does not begin with a format")
    rows: dict[str, list[list[float]]] = defaultdict(list)
    fields: dict[str, list[str]] = {}
    with DFReader_binary(str(path)) as log:
        while (message := log.recv_match(type=set(names))) is not None:
            known = message.get_fieldnames()
            instance = next((getattr(message, one) for one in _INSTANCES if one in known), 0)
            name = f"{message.get_type()}:{instance}" if instance else message.get_type()
            fields.setdefault(name, known)
            rows[name].append([getattr(message, field) for field in known])
    return {name: _columns(fields[name], rows[name]) for name in sorted(rows)}


def _columns(fields: list[str], rows: list[list[float]]) -> dict[str, AnyArray]:
    columns = {fields[k]: np.array(column) for k, column in enumerate(zip(*rows, strict=True))}
    columns = {"time_ns": 1000 * columns["TimeUS"].astype(np.int64)} | columns
    if set(_ANGLES) <= set(columns):
        angles = np.stack([columns[name] for name in _ANGLES], axis=1)
        quaternion = Rotation.from_euler("ZYX", angles, degrees=True).as_quat(scalar_first=True)
        columns |= dict(zip(("qw", "qx", "qy", "qz"), quaternion.T, strict=True))
    return columns
