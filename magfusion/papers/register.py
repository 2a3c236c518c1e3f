"""Register of four papers: every equation, table, figure and claim, and whether it is right.

`magfusion papers` prints it and a page of the documentation is generated from it; a test checks
that it is complete and that every function, test and scenario that an entry names exists.
"""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Literal, Self, get_args

from pydantic import Field, model_validator

from magfusion.errors import InputError
from magfusion.files.yaml_files import StrictModel, read_yaml

Finding = Literal["right", "misprint", "false", "not reproducible", "unclear"]
Kind = Literal["equation", "table", "figure", "claim"]
FINDINGS: dict[Finding, str] = {
    "right": "it holds as printed",
    "misprint": "a symbol is wrong, and it is clear which one is meant",
    "false": "it does not hold; the counter-example is given",
    "not reproducible": "its inputs are not printed, or do not lead to the printed result",
    "unclear": "the source is incomplete or not specific; this is a reading",
}
KINDS: dict[Kind, str] = {"equation": "Eq", "table": "Table", "figure": "Fig", "claim": "Claim"}
ROOMS = {
    "000": "p000_tracker",
    "001": "p001_magnetometer",
    "002": "p002_beacon",
    "004": "p004_fingerprints",
}
_QUERY = re.compile(r"(?:(eq|tab|fig|claim)[a-z]*)?[\s.(]*(\d*)[\s.)]*", re.ASCII)


class Citation(StrictModel):
    """Where a paper was published; ``doi_note`` is the source of the DOI, or that none exists."""

    authors: list[str]
    title: str
    original_title: str
    journal: str
    original_journal: str
    year: int
    issue: str
    pages: str
    doi: str | None
    doi_note: str

    @property
    def text(self) -> str:
        """The citation on one line."""
        doi = f"doi:{self.doi}" if self.doi else "no DOI known"
        return (
            f"{', '.join(self.authors)}: {self.title} ({self.original_title})."
            f" {self.journal} ({self.original_journal}) {self.issue}, {self.pages} ({self.year})."
            f" {doi} ({self.doi_note})."
        )


class PaperEntry(StrictModel):
    """One equation, table, figure or claim."""

    says: str  # the paper's statement, in a few words
    where: str = ""  # the section, for entries without a printed number
    finding: Finding  # one of `FINDINGS`
    why: str = ""  # the correction, the counter-example, or the missing information
    figures: str = ""  # the numbers that the paper prints, and those computed here
    # callable functions; a name without dots is in the paper's ``equations``
    functions: list[str] = Field(default_factory=list)
    tests: list[str] = Field(default_factory=list)  # node ids of the tests that show it
    scenario: str | None = None  # the scenario file that shows it in full

    @model_validator(mode="after")
    def _check_declared(self) -> Self:
        if self.finding != "right" and not self.why:
            raise ValueError(f"a finding of {self.finding} requires a reason (why)")
        if not (self.why or self.functions or self.tests or self.scenario):
            raise ValueError("no evidence; give why, functions, tests or scenario")
        return self


_Entries = dict[int, PaperEntry]


class _File(StrictModel):
    about: str
    note: str = ""
    citation: Citation
    equations: _Entries
    tables: _Entries
    figures: _Entries
    claims: _Entries = Field(default_factory=dict)


class NumberedEntry(StrictModel):
    """An entry with its paper and number."""

    paper: str
    category: Kind
    number: int
    entry: PaperEntry

    @property
    def name(self) -> str:
        """Name, such as ``Eq 7``."""
        return f"{KINDS[self.category]} {self.number}"

    @property
    def functions(self) -> list[str]:
        """Full dotted paths of its functions."""
        room = f"magfusion.papers.{ROOMS[self.paper]}.equations"
        return [f if "." in f else f"{room}.{f}" for f in self.entry.functions]

    def content(self) -> dict[str, object]:
        """Return the entry as plain values, as printed by ``--json``."""
        named = {"paper": self.paper, "name": self.name, "category": self.category}
        return (
            named
            | {"number": self.number}
            | self.entry.model_dump()
            | {"functions": self.functions}
        )


class Paper(StrictModel):
    """A paper and all its entries, in the order of its numbers; a note on our copy of it."""

    number: str
    about: str
    note: str
    citation: Citation
    entries: list[NumberedEntry]

    def of(self, kind: Kind) -> list[NumberedEntry]:
        """Return the entries of one kind."""
        return [one for one in self.entries if one.category == kind]

    def select(self, words: str) -> list[NumberedEntry]:
        """Return the entries selected by ``7``, ``eq 7``, ``fig. 8`` or ``claims``.

        Raises InputError where the paper has no such entry.
        """
        parts = _QUERY.fullmatch(words.lower())
        if parts is None or not any(parts.groups()):
            raise InputError(f"{words!r} is not an entry of paper {self.number}; {self._offer()}")
        kind = next(k for k in get_args(Kind) if k.startswith(parts[1] or "eq"))
        result = [one for one in self.of(kind) if int(parts[2] or one.number) == one.number]
        if not result:
            raise InputError(f"paper {self.number} has no {words.strip()!r}; {self._offer()}")
        return result

    def _offer(self) -> str:
        fixed = [
            f"{KINDS[kind].lower()} {few[0].number}" + f" to {few[-1].number}" * (len(few) > 1)
            for kind in KINDS
            if (few := self.of(kind))
        ]
        return f"it has {', '.join(fixed)}"


def paper(name: str) -> Paper:
    """Return one of the papers of `ROOMS`, by its number or its DOI.

    Raises InputError where there is no such paper.
    """
    if name in ROOMS:
        return _read(name)
    result = [one for one in papers() if one.citation.doi == name.lower()]
    if not result:
        raise InputError(f"there is no paper {name!r}; give one of {', '.join(ROOMS)}")
    return result[0]


def papers() -> list[Paper]:
    """Return all papers."""
    return [_read(number) for number in ROOMS]


@cache
def _read(number: str) -> Paper:
    file = read_yaml(Path(__file__).parent / ROOMS[number] / "register.yaml", _File)
    entries = list(_numbered(number, file))
    return Paper(
        number=number, about=file.about, note=file.note, citation=file.citation, entries=entries
    )


def _numbered(number: str, file: _File) -> Iterator[NumberedEntry]:
    for kind in get_args(Kind):
        for place, entry in sorted(getattr(file, f"{kind}s").items()):
            yield NumberedEntry(paper=number, category=kind, number=place, entry=entry)
