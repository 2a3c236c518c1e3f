"""Flight logs of autopilots: their messages as tables, and what of them makes the streams of a log.

PX4 and ArduPilot use x forward, y right, z down (FRD) for the body, and north, east, down (NED) for
the world; a log uses x forward, y left, z up, and east, north, up.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.files.foreign.columns import (
    QUATERNION,
    TIME,
    ColumnMapping,
    Undecided,
    parse_entry,
    resolve,
)
from magfusion.files.foreign.dataflash import read_dataflash
from magfusion.files.foreign.plan import Findings, ImportPlan, Rate, plan_stream
from magfusion.files.foreign.source import ROWS, RowBlock, Source, SourceColumn
from magfusion.files.foreign.ulog import read_ulog
from magfusion.units import AnyArray

_TRUTH = "truth.quaternion=qw,qx,qy,qz[wxyz]"


@dataclass(frozen=True)
class FlightFormat:
    """A format of flight logs."""

    name: str
    # takes a path and the names of messages; returns the columns of each, with ``time_ns`` and, of
    # attitudes, the quaternion ned_from_frd in ``qw``, ``qx``, ``qy``, ``qz``
    read: Callable[[Path, Collection[str]], dict[str, dict[str, AnyArray]]]
    # messages, the preferred one of a stream first, and how each makes its stream
    maps: dict[str, tuple[str, ...]]


FLIGHTS = {
    ".ulg": FlightFormat(
        "PX4 ULog",
        read_ulog,
        {
            "sensor_combined": (
                "imu.gyro=gyro_rad[0],-gyro_rad[1],-gyro_rad[2][rad/s]",
                "imu.accel=accelerometer_m_s2[0],-accelerometer_m_s2[1],"
                "-accelerometer_m_s2[2][m/s^2]",
            ),
            "vehicle_imu": (
                "imu.gyro=delta_angle[0],-delta_angle[1],-delta_angle[2][rad/s]",
                "imu.accel=delta_velocity[0],-delta_velocity[1],-delta_velocity[2][m/s^2]",
            ),
            "vehicle_magnetometer": (
                "magnetometer.field=magnetometer_ga[0],-magnetometer_ga[1],"
                "-magnetometer_ga[2][gauss]",
            ),
            "sensor_mag": ("magnetometer.field=x,-y,-z[gauss]",),
            "vehicle_attitude": (
                _TRUTH,
                "truth.position=y,x,-z[m]",
                "truth.velocity=vy,vx,-vz[m/s]",
            ),
        },
    ),
    ".bin": FlightFormat(
        "ArduPilot DataFlash log",
        read_dataflash,
        {
            "IMU": ("imu.gyro=GyrX,-GyrY,-GyrZ[rad/s]", "imu.accel=AccX,-AccY,-AccZ[m/s^2]"),
            "MAG": ("magnetometer.field=MagX,-MagY,-MagZ[mG]",),
            **dict.fromkeys(
                ("XKF1", "NKF1", "ATT"),
                (_TRUTH, "truth.position=PE,PN,-PD[m]", "truth.velocity=VE,VN,-VD[m/s]"),
            ),
        },
    ),
}


def plan_flight(
    path: Path,
    entries: Mapping[str, Sequence[ColumnMapping]],
    rates: Mapping[str, Rate],
    others: Collection[str],
    declared: Findings,
) -> list[ImportPlan]:
    """Return how messages of a flight log become streams; problems are added to ``declared``.

    `entries`: the user's choice of messages (``magnetometer=sensor_mag:1``) and columns. `others`:
    streams that come from elsewhere. Raises InputError where the log cannot be read, or the package
    that reads it is not installed.
    """
    form = FLIGHTS[path.suffix.lower()]
    try:
        messages = form.read(path, form.maps)
    except InputError:
        raise
    except Exception as error:  # a damaged file makes the libraries fail in any way whatever
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: is no {form.name} ({reason}); copy the file again.") from error
    plans = []
    for stream in ("imu", "magnetometer", "truth"):
        own = entries.get(stream, ())
        name = None if stream in others else _chosen(path, stream, own, messages, form, declared)
        if name is not None:
            source = _source(path, name, messages[name], form)
            options = [f"{stream}.time=time_ns[ns]", *form.maps[name.partition(":")[0]]]
            usual = [one for option in options for one in parse_entry(option)]
            plan = plan_stream(
                stream,
                source,
                [*_possible(usual, source, stream in rates), *(one for one in own if one.column)],
                rates.get(stream),
                declared,
                {},
            )
            plans += [] if plan is None else [plan]
    return plans


def _possible(
    entries: Sequence[ColumnMapping], source: Source, counted: bool
) -> Iterator[ColumnMapping]:
    """Yield the entries of a format, without times that are counted and positions not estimated."""
    for entry in entries:
        if entry.stream == "truth" and entry.column not in (TIME, *QUATERNION):
            try:
                resolve(entry, source.columns)
            except Undecided:
                continue
        if entry.column != TIME or not counted:
            yield entry


def _chosen(
    path: Path,
    stream: str,
    entries: Sequence[ColumnMapping],
    messages: Collection[str],
    form: FlightFormat,
    declared: Findings,
) -> str | None:
    """Return the message of a stream: as mapped by the user, or the preferred one."""
    known = [kind for kind, options in form.maps.items() if options[0].startswith(f"{stream}.")]
    fitting = [name for kind in known for name in messages if name.partition(":")[0] == kind]
    wanted = [entry.value for entry in entries if not entry.column]
    for name in wanted:
        if name not in fitting:
            names = ", ".join(fitting) or "none"
            declared.problems.append(
                f"{path}: has no message {name} for {stream} (found {names}); name one of these."
            )
            return None
    if not fitting:
        if stream == "magnetometer":
            declared.problems.append(
                f"{path}: has no message {' or '.join(known)}; log the magnetometer, or give"
                " --magnetometer FILE."
            )
        return None
    first, *rest = [*wanted, *fitting]
    if rest and not wanted:
        declared.notes.append(
            f"{path}: {first} is read as {stream}; select {' or '.join(rest)} by --map"
            f" {stream}={rest[0]}."
        )
    return first


def _source(path: Path, name: str, columns: Mapping[str, AnyArray], form: FlightFormat) -> Source:
    table = dict(columns)
    if QUATERNION[0] in table:
        w, x, y, z = (table[name] for name in QUATERNION)
        # enu_from_ned * ned_from_frd * frd_from_flu; the outer two are half turns.
        rotated = np.sqrt(0.5) * np.stack([w + z, x + y, x - y, w - z])
        table |= dict(zip(QUATERNION, rotated, strict=True))
    values = list(table.values())
    count = len(table["time_ns"])

    def read(wanted: Sequence[int], _texts: Collection[int]) -> Iterator[RowBlock]:
        for begin in range(0, count, ROWS):
            rows = np.arange(begin, min(begin + ROWS, count))
            yield RowBlock([values[k][rows] for k in wanted], rows)

    known = tuple(SourceColumn(key) for key in table)
    axes = f"{form.name}, NED and FRD axes turned to east, north, up and forward, left, up"
    return Source(f"{path} message {name}", known, read, form=axes, count=count)
