"""ULog, the flight log of PX4: messages of uORB as tables."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.units import AnyArray

_POSITION = "vehicle_local_position"
_MEANS = {  # of messages that are means over an interval before their stamp, its length (us)
    "sensor_combined": "gyro_integral_dt",
    "vehicle_imu": "delta_angle_dt",
}


def read_ulog(path: Path, names: Collection[str]) -> dict[str, dict[str, AnyArray]]:
    """Return the columns of messages; a further instance of a message is NAME:INSTANCE.

    Times of means are the middle of their interval; integrals become means, in their columns.
    Attitudes have the local position, interpolated to their times. Raises InputError where pyulog
    is not installed.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise InputError(
            f"{path}: is a ULog, which the package pyulog reads; install it with"
            " pip install 'magfusion[ulog]'."
        ) from error
    log = ULog(str(path), [*names, _POSITION])
    messages = {
        f"{one.name}:{one.multi_id}" if one.multi_id else one.name: _timed(one.name, one.data)
        for one in sorted(log.data_list, key=lambda one: one.multi_id)
    }
    positions = messages.pop(_POSITION, None)
    for name, columns in messages.items():
        if name.startswith("vehicle_attitude"):
            quaternion = {f"q{axis}": columns.pop(f"q[{k}]") for k, axis in enumerate("wxyz")}
            columns |= quaternion | _positions(columns["time_ns"], positions)
    return {name: one for name, one in messages.items() if name.partition(":")[0] in names}


def _timed(name: str, data: dict[str, AnyArray]) -> dict[str, AnyArray]:
    """Return columns with ``time_ns``: when the sample was taken, if the log has it."""
    columns = {key: np.asarray(values) for key, values in data.items()}
    stamp = columns["timestamp"].astype(np.int64)
    sampled = columns.get("timestamp_sample", stamp).astype(np.int64)
    time_ns = 1000 * np.where(sampled > 0, sampled, stamp)
    if _MEANS.get(name, "") in columns:
        time_ns -= 500 * columns[_MEANS[name]].astype(np.int64)
    for part in ("delta_angle", "delta_velocity"):
        for key in [key for key in columns if key.startswith(f"{part}[")]:
            columns[key] = columns[key] / (1e-6 * columns[f"{part}_dt"])
    return {"time_ns": time_ns} | columns


def _positions(time_ns: AnyArray, positions: dict[str, AnyArray] | None) -> dict[str, AnyArray]:
    """Return NED position (m) and velocity (m/s) at the times of attitudes, NaN where invalid."""
    if positions is None:
        return {}
    known = np.ones(len(positions["time_ns"]), dtype=bool)
    for flag in ("xy_valid", "z_valid"):
        known &= positions.get(flag, known).astype(bool)
    if not known.any():
        return {}
    return {
        name: np.interp(
            time_ns,
            positions["time_ns"],
            np.where(known, positions[name], np.nan),
            left=np.nan,
            right=np.nan,
        )
        for name in ("x", "y", "z", "vx", "vy", "vz")
    }
