"""What the pages of the documentation have from the code: tables of options and of codes.

A page marks where: ``<!-- options: smooth -->``, ``<!-- codes -->``, ``<!-- papers -->`` and
``<!-- paper: 004 -->``; a heading that is the code of a finding is followed by what it means.
Formulas become MathML, which needs no script.  `mkdocs` calls the hook.
"""

import dataclasses
import importlib
import inspect
import re
from collections.abc import Iterable
from typing import Any

from latex2mathml.converter import convert

from magfusion.jobs import JOBS
from magfusion.jobs.settings import OVERWRITE, Command, Option, options
from magfusion.model.trust import CODES
from magfusion.papers.register import FINDINGS, KINDS, NumberedEntry, paper, papers

OPTIONS = re.compile(r"<!-- options: ([a-z -]+) -->")
ENTRY = re.compile(r"^### `(\w+)`$", re.M)
FORMULA = re.compile(r"^\$\$\s(.+?)\$\$$", re.M | re.S)
CODES_HERE = "<!-- codes -->"
PAPERS_HERE = "<!-- papers -->"
_OF_PAPERS = "magfusion.papers."
PAPER = re.compile(r"<!-- paper: (\d+) -->")


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _default(field: dataclasses.Field[Any], option: Option) -> str:
    value = field.default
    if value is dataclasses.MISSING:
        return "must be given"
    if option.words is not None:
        value = next((word for word, meant in option.words.items() if meant == value), value)
    nothing = value is None or value is False or value == ()
    return "" if nothing else "yes" if value is True else f"`{value}`"


def _output(command: Command) -> str:
    if command.output_required:
        return "must be given"
    if command.output_optional:
        return "nothing is written"
    return f"`{command.output}`" if command.output else "the log's name and the job's"


def option_table(path: str) -> str:
    """Return what a command takes, from the fields of its job's settings.

    Parameters
    ----------
    path : str
        Of `magfusion.jobs.JOBS`, as ``calibrate log``.
    """
    module, sentence = JOBS[path]
    command: Command = importlib.import_module(f"magfusion.jobs.{module}").COMMAND
    rows = []
    for field, option in options(command.settings):
        name = option.name or field.name.replace("_", "-")
        shown = f"`{name.upper()}`" if option.positional else f"`--{name}`"
        if field.default is True:
            shown += f", `--no-{name}`"
        rows.append((shown, option.sentence.replace("|", "\\|"), _default(field, option)))
    title = f"**`magfusion {path}`**: {sentence}"
    if "output" in inspect.signature(command.run).parameters:
        rows.append(("`-o`, `--output`", f"{command.output_help}.", _output(command)))
        if not command.output_file:
            rows.append(("`--overwrite`", f"{OVERWRITE}.", ""))
    if command.reports:
        rows.append(("`--json`", "Print the report as a line of JSON, and nothing else.", ""))
    return f"{title}\n\n{_table(('option', 'what', 'default'), rows)}"


def code_table() -> str:
    """Return every code of `reasons` and `remarks`, what it means, and where its remedy is."""
    rows = ((f"[`{code}`](troubleshooting.md#{code})", meaning) for code, meaning in CODES.items())
    return _table(("code", "meaning"), rows)


def papers_table() -> str:
    """Return the four papers, and how many findings there are of each kind."""
    rows = [
        (
            f"[{one.number}](papers/{one.number}.md)",
            one.about,
            *(str([e.entry.finding for e in one.entries].count(f)) for f in FINDINGS),
        )
        for one in papers()
    ]
    meanings = "\n".join(f"- *{finding}*: {text}" for finding, text in FINDINGS.items())
    return f"{_table(('paper', 'about', *FINDINGS), rows)}\n\n{meanings}"


def paper_page(number: str) -> str:
    """Return all that is known of one paper, kind by kind."""
    one = paper(number)
    parts = [one.citation.text, *filter(None, [one.note])]
    for kind, short in KINDS.items():
        rows = [_paper_row(entry) for entry in one.of(kind)]
        if rows:
            reported = _table((short, "says", "finding", "function", "shown by"), rows)
            parts.append(f"## {kind.capitalize()}s\n\n{reported}")
    return "\n\n".join(parts)


def _paper_row(one: NumberedEntry) -> tuple[str, ...]:
    entry = one.entry
    place = f" (section {entry.where})" if entry.where else ""
    finding = f"*{entry.finding}*{f': {entry.why}' if entry.why else ''}"
    finding += f" **Figures:** {entry.figures}." if entry.figures else ""
    called = "<br>".join(f"`{function.removeprefix(_OF_PAPERS)}`" for function in one.functions)
    shown = [*entry.tests, *filter(None, [entry.scenario])]
    shown = [f"`{text.rpartition('/')[2].replace('::', '` `')}`" for text in shown]
    row = (str(one.number), entry.says + place, finding, called, "<br>".join(shown))
    return tuple(text.replace("|", "\\|") for text in row)


def _meaning(heading: str) -> str:
    meaning = CODES.get(heading)
    return f"\n\n*{meaning[0].upper()}{meaning[1:]}.*\n" if meaning else ""


def _mathml(formula: str) -> str:
    return f"<div>{convert(formula, display='block')}</div>"


def on_page_markdown(markdown: str, **_: object) -> str:
    """Fill the tables in; called by mkdocs for every page."""
    filled = OPTIONS.sub(lambda result: option_table(result[1]), markdown)
    filled = PAPER.sub(lambda result: paper_page(result[1]), filled)
    filled = filled.replace(PAPERS_HERE, papers_table()) if PAPERS_HERE in filled else filled
    filled = FORMULA.sub(lambda result: _mathml(result[1]), filled)
    filled = ENTRY.sub(lambda result: result[0] + _meaning(result[1]), filled)
    return filled.replace(CODES_HERE, code_table())
