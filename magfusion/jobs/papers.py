"""The job that shows where an equation of a paper is, whether it is right, and the evidence."""

import json
import sys
import textwrap
from collections import Counter
from dataclasses import dataclass

from magfusion.jobs.settings import Command, Settings, argument, option
from magfusion.papers.register import NumberedEntry, Paper, paper, papers

WIDTH = 100  # columns
_MARGIN = 11  # of what an entry says, behind what it is


@dataclass(frozen=True, kw_only=True)
class PapersSettings(Settings):
    """Selected entries of a paper."""

    paper: str | None = argument("Paper: 000, 001, 002 or 004", None)
    number: tuple[str, ...] = argument(
        "Equation (7, eq 7), table 1, fig 8, claim 3, or all claims; by default the whole paper", ()
    )
    json: bool = option(False, "Print as JSON")


def run_papers(settings: PapersSettings) -> None:
    """Print the register of all papers, of one, or of one entry."""
    if settings.paper is None:
        result = papers()
        text, content = "\n\n".join(map(_head, result)), [_paper_row(one) for one in result]
    else:
        one = paper(settings.paper)
        words = " ".join(settings.number)
        entries = one.select(words) if words else one.entries
        content = [entry.content() for entry in entries]
        if len(entries) == 1:
            text = "\n\n".join([card(entries[0]), *map(_filled, filter(None, _source(one)))])
        else:
            text = "\n".join((_head(one), "", *map(_line, entries)))
    if sys.stdout is None:
        return
    shown = json.dumps(content, ensure_ascii=False) if settings.json else text
    sys.stdout.write(f"{shown}\n")


def _paper_row(one: Paper) -> dict[str, object]:
    counts = Counter(entry.entry.finding for entry in one.entries)
    reported = {"about": one.about, "note": one.note, "citation": one.citation.model_dump()}
    return {"paper": one.number, **reported, "findings": dict(counts)}


def _source(one: Paper) -> tuple[str, str]:
    return one.citation.text, one.note


def _head(one: Paper) -> str:
    """Return the subject of a paper, its source, and the number of findings of each kind."""
    counts = Counter(entry.entry.finding for entry in one.entries)
    result = ", ".join(f"{count} {finding}" for finding, count in counts.most_common())
    title = _filled(f"Paper {one.number}: {one.about}")
    reported = (*_source(one), f"{len(one.entries)} entries: {result}")
    return "\n".join([title, *map(_filled, filter(None, reported))])


def _line(one: NumberedEntry) -> str:
    lead = f"{one.name:<{_MARGIN}}{one.entry.finding:<18}"
    return textwrap.fill(
        one.entry.says, WIDTH, initial_indent=lead, subsequent_indent=" " * len(lead)
    )


def card(one: NumberedEntry) -> str:
    """Return one entry in full, for a reader."""
    entry = one.entry
    place = f", section {entry.where}" if entry.where else ""
    rows = [
        ("says", [entry.says]),
        ("finding", [entry.finding + (f": {entry.why}" if entry.why else "")]),
        ("figures", [entry.figures]),
        ("function", one.functions),
        ("test", entry.tests),
        ("scenario", [entry.scenario or ""]),
    ]
    lines = [f"Paper {one.paper}, {one.name}{place}"]
    for lead, reported in rows:
        for i, text in enumerate(filter(None, reported)):
            label = f"  {'' if i else lead:<{_MARGIN - 2}}"
            lines.append(_filled(text, label))
    return "\n".join(lines)


def _filled(text: str, lead: str = "") -> str:
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=lead,
        subsequent_indent=" " * len(lead),
        break_long_words=False,
        break_on_hyphens=False,
    )


COMMAND = Command(PapersSettings, run_papers, reports=False, example="magfusion papers 004 eq 7")
