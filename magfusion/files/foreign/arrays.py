"""Tables that are arrays: NPY, NPZ, WAV, MATLAB, HDF5, Parquet."""

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from scipy.io import loadmat, wavfile

from magfusion.errors import InputError
from magfusion.files.foreign.source import ROWS, RowBlock, Source, SourceColumn
from magfusion.files.foreign.units import Raw
from magfusion.units import AnyArray

MAX_COLUMNS = 64  # of an array that is a table
AXES_AND_TIME, MIN_STAMPS = 4, 8  # columns of a sensor with its stamps; rows that show it
HDF5_MARK = b"\x89HDF"
ARRAYS = (".npy", ".npz", ".wav", ".mat", ".h5", ".hdf5", ".hdf", ".parquet")


@dataclass(frozen=True, eq=False)
class _Field:
    """One column of an array: how its values are taken of some rows."""

    column: SourceColumn
    array: Any
    rows: int
    block: Callable[[Any, int, int], AnyArray]
    take: Callable[[AnyArray], AnyArray]


def array_source(path: Path) -> Source:
    """Return a table whose file holds arrays; the suffix gives the format.

    Raises InputError where it cannot be read or holds no numbers.
    """
    opened = {".npy": _npy, ".npz": _npz, ".wav": _wav, ".mat": _mat, ".parquet": _parquet}.get(
        path.suffix.lower(), _hdf5
    )
    try:
        source = opened(path)
    except InputError:
        raise
    except Exception as error:  # a damaged file makes the libraries fail in any way whatever
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: cannot be read ({reason}); write the file again.") from error
    if not source.columns:
        raise InputError(f"{path}: holds no columns of numbers; write arrays of one or two axes.")
    return source


def _rows(array: Any, begin: int, end: int) -> AnyArray:
    return np.asarray(array[begin:end])


def _numeric(dtype: np.dtype[Any]) -> bool:
    kinds = (np.integer, np.floating, np.datetime64)
    return any(np.issubdtype(dtype, kind) for kind in kinds)


def _part(name: str) -> Callable[[AnyArray], AnyArray]:
    return lambda block: np.asarray(block[name])


def fields_of(name: str, array: Any, unit: str = "", by_column: bool = False) -> list[_Field]:
    """Return the columns of an array: none where it is no table of numbers.

    `array`: what has ``shape`` and ``dtype`` and is sliced, as an array or a data set of HDF5.
    `by_column`: whether the array was written column after column, as MATLAB does.
    """
    shape, dtype = array.shape, array.dtype
    parts = _COMPLEX if _is_complex(dtype) else {"": np.asarray} if _numeric(dtype) else {}
    if dtype.names and not parts and len(shape) == 1:
        return _named_parts(name, array, unit)
    if not parts or len(shape) not in (1, 2, 3) or max(shape) < 2:
        return []
    down = _rows_axis(shape, by_column)
    across = [k for k in range(len(shape)) if k != down]
    places = [()] if len(shape) == 1 else list(np.ndindex(*(shape[k] for k in across)))
    if len(places) * len(parts) > MAX_COLUMNS:
        return []
    block = partial(_block, down)
    names = [_column_name(name, place[::-1] if by_column else place) for place in places]
    if len(places) == AXES_AND_TIME and len(shape) == 2:
        first = block(array, 0, ROWS)[:, 0]
        if len(first) > MIN_STAMPS and np.all(np.diff(first) >= 0.0) and first[-1] > first[0]:
            names = [f"{name}:{one}" for one in ("time", "x", "y", "z")]
    if len(places) == 1:
        names = [name or "0"]
    return [
        _Field(
            SourceColumn(f"{own}{suffix}", unit), array, shape[down], block, _element(take, place)
        )
        for own, place in zip(names, places, strict=True)
        for suffix, take in parts.items()
    ]


def _rows_axis(shape: Sequence[int], by_column: bool) -> int:
    """Return along which axis of an array its rows are."""
    if len(shape) == 2 and 1 not in shape:
        return int(shape[0] < shape[1] if not by_column else shape[0] <= MAX_COLUMNS)
    return int(np.argmax(shape))


def _column_name(name: str, place: Sequence[int]) -> str:
    return ":".join([*([name] if name else []), *map(str, place)])


def _block(axis: int, array: Any, begin: int, end: int) -> AnyArray:
    """Return some rows of an array, first."""
    index = (*[slice(None)] * axis, slice(begin, end))
    return np.moveaxis(np.asarray(array[index]), axis, 0)


def _element(
    part: Callable[[AnyArray], AnyArray], place: tuple[int, ...]
) -> Callable[[AnyArray], AnyArray]:
    return lambda block: part(np.moveaxis(block, 0, -1)[place])


def _is_complex(dtype: np.dtype[Any]) -> bool:
    of_matlab = dtype.names == ("real", "imag")  # in HDF5
    return of_matlab or np.issubdtype(dtype, np.complexfloating)


_COMPLEX: dict[str, Callable[[AnyArray], AnyArray]] = {
    ".re": lambda block: np.asarray(block["real"] if block.dtype.names else block.real),
    ".im": lambda block: np.asarray(block["imag"] if block.dtype.names else block.imag),
}


def _named_parts(name: str, array: Any, unit: str) -> list[_Field]:
    """Return the columns of an array of records, shape (n,)."""
    return [
        _Field(
            SourceColumn(f"{name}:{part}" if name else part, unit),
            *(array, array.shape[0], _rows, _part(part)),
        )
        for part in array.dtype.names
        if _numeric(array.dtype[part]) and not array.dtype[part].shape
    ]


def _source(
    place: str, fields: list[_Field], rate_hz: float | None = None, form: str = ""
) -> Source:
    def read(wanted: Sequence[int], _texts: Collection[int]) -> Iterator[RowBlock]:
        chosen = [fields[k] for k in wanted]
        for begin in range(0, max((f.rows for f in chosen), default=0), ROWS):
            blocks: dict[int, AnyArray] = {}
            columns: list[Raw] = []
            for one in chosen:
                if id(one.array) not in blocks:
                    blocks[id(one.array)] = one.block(one.array, begin, begin + ROWS)
                columns.append(one.take(blocks[id(one.array)]))
            yield RowBlock(columns, begin + np.arange(len(columns[0])))

    lengths = tuple(f.rows for f in fields)
    return Source(place, tuple(f.column for f in fields), read, rate_hz, lengths, form)


def _npy(path: Path) -> Source:
    return _source(str(path), fields_of("", np.load(path, mmap_mode="r", allow_pickle=False)))


def _npz(path: Path) -> Source:
    with np.load(path, allow_pickle=False) as arrays:
        fields = [one for name in arrays.files for one in fields_of(name, arrays[name])]
    return _source(str(path), fields)


def _wav(path: Path) -> Source:
    rate, samples = wavfile.read(path, mmap=True)
    if samples.ndim == 1:
        samples = samples[:, np.newaxis]
    middle = 128 if samples.dtype == np.uint8 else 0
    full = 1.0 if samples.dtype.kind == "f" else float(2 ** (8 * samples.dtype.itemsize - 1))

    def share(k: int) -> Callable[[AnyArray], AnyArray]:
        return lambda block: (block[:, k].astype(np.float64) - middle) / full

    fields = [
        _Field(SourceColumn(str(k)), samples, len(samples), _rows, share(k))
        for k in range(samples.shape[1])
    ]
    form = f"{rate} Hz, samples as shares of full scale"
    return _source(str(path), fields, float(rate), form)


def _mat(path: Path) -> Source:
    with path.open("rb") as stream:
        later = b"MATLAB 7.3" in stream.read(128) or _is_hdf5(path)
    if later:
        return _hdf5(path, by_column=True)
    content = loadmat(path, simplify_cells=True)
    fields = [one for name, array in _flat(content) for one in fields_of(name, array)]
    return _source(str(path), fields)


def _flat(content: Mapping[str, Any], lead: str = "") -> Iterator[tuple[str, AnyArray]]:
    for name, value in content.items():
        if name.startswith("__"):
            continue
        if isinstance(value, Mapping):
            yield from _flat(value, f"{lead}{name}.")
        elif isinstance(value, np.ndarray):
            yield f"{lead}{name}", value


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(4) == HDF5_MARK


def _hdf5(path: Path, by_column: bool = False) -> Source:
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            f"{path}: is HDF5, which the package h5py reads; install it with"
            " pip install 'magfusion[import]'."
        ) from error
    file = h5py.File(path, "r")
    fields: list[_Field] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#refs#"):
            unit = item.attrs.get("units", item.attrs.get("unit", ""))
            unit = unit.decode() if isinstance(unit, bytes) else str(unit)
            known = re.sub(r"/", ".", name) if by_column else name
            fields.extend(fields_of(known, item, unit, by_column))

    file.visititems(visit)
    return _source(str(path), fields)


def _parquet(path: Path) -> Source:
    file = pa.parquet.ParquetFile(path, memory_map=True, pre_buffer=False)
    schema = file.schema_arrow

    def read(wanted: Sequence[int], texts: Collection[int]) -> Iterator[RowBlock]:
        names = [schema.names[k] for k in wanted]
        row = 0
        for batch in file.iter_batches(ROWS, columns=names):
            columns: list[Raw] = []
            for k in wanted:
                column = batch.column(batch.schema.get_field_index(schema.names[k]))
                stays = k in texts and not pa.types.is_floating(column.type)
                if stays and pa.types.is_integer(column.type):
                    columns.append(column.cast(pa.int64()).to_numpy(zero_copy_only=False))
                elif stays:
                    columns.append(column)
                else:
                    columns.append(column.cast(pa.float64()).to_numpy(zero_copy_only=False))
            yield RowBlock(columns, row + np.arange(len(batch)))
            row += len(batch)

    columns = tuple(
        SourceColumn(field.name, ((field.metadata or {}).get(b"unit", b"")).decode())
        for field in schema
    )
    return Source(str(path), columns, read)
