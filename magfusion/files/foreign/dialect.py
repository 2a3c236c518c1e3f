"""How a table of text is written: delimiter, decimal sign, encoding, and where its rows begin."""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from magfusion.errors import InputError
from magfusion.files.foreign.source import SourceColumn
from magfusion.files.foreign.units import MISSING, Dimension, parse_unit

HEAD = 1 << 18  # bytes that are looked at
SAMPLE = 100  # lines
SPACES = " "  # runs of them
DELIMITERS = (",", ";", "\t", "|", SPACES)
WORDS = {"comma": ",", "semicolon": ";", "tab": "\t", "pipe": "|", "space": SPACES}
COMMENTS = ("#", "%", "//", "!")
MIN_SCORE = 0.5
_NUMBER = {
    sign: re.compile(
        rf"[-+]?(\d+{re.escape(sign)}?\d*|{re.escape(sign)}\d+)([eE][-+]?\d+)?|[-+]?inf"
    )
    for sign in ".,"
}
_CLOCK = r"\d\d:\d\d(:\d\d([.,]\d+)?)?(Z|[-+]\d\d:?\d\d)?"
_DATE = re.compile(rf"(\d{{4}}[-/]\d\d[-/]\d\d|\d\d\.\d\d\.\d{{4}})([T ]{_CLOCK})?|{_CLOCK}")


@dataclass(frozen=True)
class Dialect:
    """How a table of text is written."""

    delimiter: str  # a space means runs of spaces and tabulators
    decimal: str
    encoding: str
    offset: int  # of the first row of data in the file (bytes)
    line: int  # the same as a line, counted from 1
    columns: tuple[SourceColumn, ...]
    missing: tuple[str, ...] = MISSING  # what is written where there is no number

    def __str__(self) -> str:
        words = {sign: word for word, sign in WORDS.items()}
        parts = [f"delimiter {words.get(self.delimiter, self.delimiter)}"]
        parts += ["decimal comma"] if self.decimal == "," else []
        parts += [self.encoding] if self.encoding != "utf-8" else []
        return ", ".join([*parts, f"data from line {self.line}"])


def find_dialect(path: Path, delimiter: str | None = None, markers: Sequence[str] = ()) -> Dialect:
    """Return how a file of text is written.

    `delimiter`: one of `WORDS` or a character; found where it is not given. `markers`: of missing
    values, in addition to `MISSING`. Raises InputError where no table is found in it.
    """
    content = _head(path)
    encoding, mark = _encoding(content, path)
    text = codecs.getincrementaldecoder(encoding)("replace").decode(content[mark:])
    lines = re.findall(r"[^\r\n]*(?:\r\n|\n|\r)|[^\r\n]+$", text)
    if len(content) == HEAD and len(lines) > 1:
        lines.pop()  # cut
    bare = [line.strip() for line in lines]
    requested = None if delimiter is None else WORDS.get(delimiter, delimiter)
    if requested is not None and len(requested) != 1:
        raise InputError(
            f"--delimiter {delimiter!r}: write one character, or one of {', '.join(WORDS)}"
        )
    missing = (*MISSING, *markers)
    sign, decimal, width = _way_of_writing(
        bare, DELIMITERS if requested is None else (requested,), path, missing
    )
    begin = next(k for k, line in enumerate(bare) if _is_data(line, sign, decimal, width, missing))
    offset = mark + len("".join(lines[:begin]).encode(encoding))
    names, units = _header(bare[:begin], sign, width)
    columns = tuple(
        SourceColumn(name or str(k), unit)
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
    )
    return Dialect(sign, decimal, encoding, offset, begin + 1, columns, missing)


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            content = stream.read(HEAD)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); allow it.") from error
    if not content.strip():
        raise InputError(f"{path}: is empty; record it again, or leave it out.")
    return content


def _encoding(content: bytes, path: Path) -> tuple[str, int]:
    """Return the encoding and the length of its mark."""
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8"),
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
    ):
        if content.startswith(mark):
            return name, len(mark)
    if content.startswith((b"PK\3\4", b"\x1f\x8b", b"\xd0\xcf\x11\xe0")):
        raise InputError(
            f"{path}: is a spreadsheet or an archive; save its table as CSV, or unpack it."
        )
    if b"\0" in content:
        raise InputError(
            f"{path}: is no text; name a binary table by its suffix: .npy, .npz, .wav, .h5, .hdf5,"
            " .mat or .parquet."
        )
    try:
        codecs.getincrementaldecoder("utf-8")().decode(content, final=len(content) < HEAD)
    except UnicodeDecodeError:
        return "cp1252", 0
    return "utf-8", 0


def cells_of(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line."""
    if delimiter == SPACES:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]


def _is_number(cell: str, decimal: str, missing: Sequence[str]) -> bool:
    return bool(_NUMBER[decimal].fullmatch(cell) or cell in missing or _DATE.fullmatch(cell))


def _way_of_writing(
    lines: Sequence[str], delimiters: Sequence[str], path: Path, missing: Sequence[str]
) -> tuple[str, str, int]:
    """Return delimiter, decimal sign and number of columns that make most cells numbers."""
    filled = [line for line in lines if line and not line.startswith(COMMENTS)]
    sample = filled[len(filled) // 3 :][-SAMPLE:]  # the first are names, if there are any
    best, result = 0.0, None
    for sign in delimiters:
        rows = [cells_of(line, sign) for line in sample]
        width = Counter(map(len, rows)).most_common(1)[0][0] if rows else 0
        for decimal in ".," if width else "":
            score = _share_of_numbers(rows, width, decimal, missing)
            score *= 1.0 if width > 1 else MIN_SCORE  # of one column only where no other reads
            if score > best:
                best, result = score, (sign, decimal, width)
    if result is None or best < MIN_SCORE:
        shown = next((line for line in lines if line), "")[:60]
        raise InputError(
            f"{path}: holds no table of numbers (first line: {shown!r}); write a row of names and"
            " rows of numbers, or import it with --delimiter."
        )
    return result


def _share_of_numbers(
    rows: Sequence[Sequence[str]], width: int, decimal: str, missing: Sequence[str]
) -> float:
    """Return how many of all cells are numbers in a row of some width."""
    cells = [cell for row in rows if len(row) == width for cell in row]
    return sum(_is_number(cell, decimal, missing) for cell in cells) / sum(map(len, rows))


def _is_data(line: str, sign: str, decimal: str, width: int, missing: Sequence[str]) -> bool:
    if not line or line.startswith(COMMENTS):
        return False
    cells = cells_of(line, sign)
    numbers = sum(_is_number(cell, decimal, missing) and cell not in missing for cell in cells)
    return len(cells) == width and 2 * numbers >= max(1, sum(c not in missing for c in cells))


def _header(lines: Sequence[str], sign: str, width: int) -> tuple[list[str], list[str]]:
    """Return names and units of the columns, empty where the file has none."""
    none = [""] * width
    rows: list[list[str]] = []
    for line in reversed([line for line in lines if line]):
        row = _row_of_names(line, sign, width)
        if row is None or len(rows) == 2:
            break
        rows.append(row)
    if not rows:
        return none, none
    units = [_unbracketed(cell) for cell in rows[0]]
    if len(rows) == 2 and all(map(_is_unit, units)) and any(units):
        return rows[1], units
    names = [cell for cell in rows[0] if cell]
    if len(rows) == 2 and len(set(names)) < len(names):
        return _grouped(*rows), none
    return rows[0], none


def _grouped(names: Sequence[str], groups: Sequence[str]) -> list[str]:
    """Return names with those of the groups in the row above; a unit of a group stays last."""
    result, group = [], ""
    for name, above in zip(names, groups, strict=True):
        group = above or group
        tagged = re.fullmatch(r"(.*?)\s*([\[(][^\[\]()]*[\])])", group)
        stem, unit = tagged.groups() if tagged and name else (group, "")
        result.append(f"{stem} {name} {unit}".strip())
    return result


def _row_of_names(line: str, sign: str, width: int) -> list[str] | None:
    bare = re.sub(r"^(#|%|//|!)+\s*", "", line)
    for cells in (
        cells_of(bare, sign),
        re.split(r"\s*[,;\t|]\s*|\s+", bare) if line != bare else [],
    ):
        if 1 < len(cells) < width and ("" in cells or len(cells) == width - 1):
            cells = [*cells, *[""] * (width - len(cells))]
        if len(cells) == width and any(cells):
            return cells
    return None


def _unbracketed(cell: str) -> str:
    result = re.fullmatch(r"[\[(](.*)[\])]", cell)
    return result[1].strip() if result else cell


def _is_unit(text: str) -> bool:
    return text in ("", "-") or any(parse_unit(text, dimension) for dimension in Dimension)
