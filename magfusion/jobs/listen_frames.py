"""Binary records of microcontrollers: COBS frames with counters and a CRC.

A frame is ``COBS(body + CRC-32 of it)`` and a zero byte.  The body is little-endian: a letter for
the kind (``i``, ``m``), one for the type of the values as of `struct` (``h``, ``i``, ``f``), a
counter of its samples (16 bits), one of microseconds (32 bits), and the values.
"""

import struct
from importlib.util import find_spec
from zlib import crc32

import numpy as np

from magfusion.errors import InputError
from magfusion.units import Array

HEAD, CHECK = struct.Struct("<ccHI"), struct.Struct("<I")
KINDS = {b"i": "imu", b"m": "mag"}
TYPES = {b"h": "<i2", b"i": "<i4", b"f": "<f4"}

Parsed = tuple[str, int, int, Array]  # kind, counter of samples, of microseconds, values


def parse_frame(frame: bytes) -> Parsed:
    """Return kind, both counters and values of a frame without its zero byte.

    Raises ValueError where it is garbled.
    """
    from cobs import cobs

    try:
        whole = cobs.decode(frame)
        body, check = whole[: -CHECK.size], whole[-CHECK.size :]
        kind, form, count, micros = HEAD.unpack_from(body)
        if CHECK.unpack(check)[0] != crc32(body):
            raise ValueError("the CRC differs")
        values = np.frombuffer(body, TYPES[form], offset=HEAD.size).astype(np.float64)
        return KINDS[kind], count, micros, values
    except (cobs.DecodeError, struct.error, KeyError) as error:
        raise ValueError("not a frame") from error


def check_package(place: str) -> None:
    """Raise an error if the package that decodes frames is missing."""
    if find_spec("cobs") is None:
        raise InputError(f"{place}: cobs is not installed; pip install 'magfusion[serial]'")
