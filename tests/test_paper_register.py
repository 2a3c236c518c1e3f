"""The register of the papers has every number, and what it names is there."""

import ast
import importlib
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import get_args

import pytest

from magfusion.cli import main
from magfusion.jobs.papers import PapersSettings, run_papers
from magfusion.papers.register import (
    FINDINGS,
    ROOMS,
    Finding,
    Kind,
    NumberedEntry,
    Paper,
    paper,
    papers,
)

ROOT = Path(__file__).parents[1]
# Counted in the papers: numbered equations, tables, figures.
PRINTED = {"000": (20, 1, 7), "001": (20, 1, 6), "002": (33, 0, 10), "004": (31, 1, 11)}
ALL = [entry for number in ROOMS for entry in paper(number).entries]


def _id(one: NumberedEntry) -> str:
    return f"{one.paper} {one.name}"


@pytest.mark.parametrize("number", ROOMS)
def test_no_number_of_a_paper_is_missing(number: str) -> None:
    result = paper(number)
    for kind, last in zip(get_args(Kind), PRINTED[number], strict=False):
        assert [one.number for one in result.of(kind)] == list(range(1, last + 1)), kind
    claims = [one.number for one in result.of("claim")]
    assert claims == list(range(1, len(claims) + 1))
    assert len(claims) >= 10


@cache
def _tests(path: str) -> set[str]:
    tree = ast.parse((ROOT / path).read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def _not_there(one: NumberedEntry) -> Iterator[str]:
    """Yield what an entry names and is not there: functions, tests, a scenario."""
    for whole in one.functions:
        module, _, name = whole.rpartition(".")
        if not callable(getattr(importlib.import_module(module), name, None)):
            yield whole
    for node in one.entry.tests:
        path, _, name = node.partition("::")
        if not name.startswith("test_") or name not in _tests(path):
            yield node
    scenario = one.entry.scenario
    if scenario and not (scenario.startswith("scenarios/") and (ROOT / scenario).is_file()):
        yield scenario


def test_what_an_entry_names_is_there() -> None:
    missing = [f"{_id(one)}: {what}" for one in ALL for what in _not_there(one)]
    assert not missing, "\n".join(missing)


SHOWN = {"false", "misprint"}


def test_what_is_wrong_is_shown_to_be_so() -> None:
    wrong = [one for one in ALL if one.entry.finding in SHOWN]
    assert wrong
    bare = [_id(one) for one in wrong if not one.entry.tests and not one.entry.scenario]
    assert not bare


def test_what_is_false_or_right_has_a_test_and_what_is_unclear_names_what_is_missing() -> None:
    """A finding of false without a test is an opinion."""
    untested = [_id(one) for one in ALL if one.entry.finding == "false" and not one.entry.tests]
    assert not untested
    missing = re.compile(r"\blost|not printed|missing|does not (?:state|specify)")
    open_rows = [one for one in ALL if one.entry.finding == "unclear"]
    assert not [_id(one) for one in open_rows if not missing.search(one.entry.why)]


def test_lost_equations_have_no_other_finding_than_unclear() -> None:
    """In our copy of paper 002 every equation is a picture that is lost."""
    assert {one.entry.finding for one in paper("002").of("equation")} == {"unclear"}
    of_eq_4 = [one for one in paper("002").of("claim") if "Eq 4" in one.entry.why]
    assert of_eq_4
    assert {one.entry.finding for one in of_eq_4} == {"unclear"}


@pytest.mark.parametrize("number", ROOMS)
def test_an_equation_is_called_in_its_own_room_what_the_register_calls_it(number: str) -> None:
    """A docstring tells what is known of its function; the register, of the printed equation."""
    room = importlib.import_module(f"magfusion.papers.{ROOMS[number]}.equations")
    source = Path(str(room.__file__)).read_text()
    for one in paper(number).of("equation"):
        own = {name for name in vars(room) if name.startswith(f"eq_{one.number:02}_")}
        named = {path.rpartition(".")[2] for path in one.functions}
        assert own <= named, f"{_id(one)}: {sorted(own - named)} not named"
        if not own:
            assert one.number in room.NOT_FUNCTIONS
            continue
        reported = " ".join(_text(source, name) for name in own)
        words = {"right": "Right", "misprint": "Misprint|Corrected", "unclear": "Unclear"}
        wanted = words.get(one.entry.finding, "False|Corrected")
        assert re.search(rf"\b({wanted})\b", reported), (
            f"{_id(one)}: {one.entry.finding}, but {reported}"
        )
        if one.entry.finding == "right":
            assert not any(name.endswith("_as_printed") for name in own), _id(one)


def _text(source: str, name: str) -> str:
    (after,) = re.findall(rf'^(?:def )?{name}\b.*?"""(.*?)"""', source, re.M | re.S)
    return str(after)


def test_every_finding_is_used_and_explained() -> None:
    assert set(FINDINGS) == set(get_args(Finding)) == {one.entry.finding for one in ALL}


@pytest.mark.parametrize("one", papers(), ids=lambda one: one.number)
def test_a_citation_has_what_finds_the_paper(one: Paper) -> None:
    cited = one.citation
    assert re.search(r"[\u4e00-\u9fff]", cited.original_title)
    assert cited.doi is None or re.fullmatch(r"10\.\d{4,}/\S+", cited.doi)
    assert cited.doi_note
    assert str(cited.year) in cited.text


# The command ----------------------------------------------------------------------------------


def _findings(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(["papers", *words])
    findings = capsys.readouterr()
    return int(ended.value.code or 0), findings.out, findings.err


@pytest.mark.parametrize("number", ROOMS)
def test_one_command_says_where_it_is_whether_it_is_right_and_how_that_is_known(
    number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for one in paper(number).entries:
        run_papers(PapersSettings(paper=number, number=tuple(one.name.lower().split())))
        flat = " ".join(capsys.readouterr().out.split())
        for reported in (one.entry.says, one.entry.finding, *one.functions, *one.entry.tests):
            assert " ".join(reported.split()) in flat, _id(one)


@pytest.mark.parametrize("words", ["7", "07", "eq7", "Eq. (7)", "equation 7", "EQ 7"])
def test_a_number_may_be_written_as_in_the_paper(
    words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _findings(capsys, "004", *words.split())[1].startswith("Paper 004, Eq 7\n")


def test_all_of_a_kind_a_whole_paper_and_all_papers_are_listed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    number = len(paper("004").of("claim"))
    shown = _findings(capsys, "004", "claims")[1]
    assert len(re.findall(r"^Claim \d+ ", shown, re.M)) == number
    assert "Eq 31" in _findings(capsys, "004")[1]
    assert all(f"Paper {one}: " in _findings(capsys)[1] for one in ROOMS)
    assert _findings(capsys, "10.11834/jrs.20210056")[1] == _findings(capsys, "004")[1]


def test_json_has_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    (reported,) = json.loads(_findings(capsys, "004", "fig", "8", "--json")[1])
    assert (reported["name"], reported["finding"]) == ("Fig 8", "not reproducible")
    assert {one["paper"] for one in json.loads(_findings(capsys, "--json")[1])} == set(ROOMS)
    assert len(json.loads(_findings(capsys, "004", "--json")[1])) == len(paper("004").entries)


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (("004", "32"), "paper 004 has no '32'; it has eq 1 to 31, table 1, fig 1 to 11, claim 1"),
        (("002", "table", "1"), "paper 002 has no 'table 1'; it has eq 1 to 33, fig 1 to 10"),
        (("004", "the", "third"), "'the third' is not an entry of paper 004; it has eq 1 to 31"),
        (("004", "eq", "7", "8"), "'eq 7 8' is not an entry of paper 004; it has eq 1 to 31"),
        (("003",), "there is no paper '003'; give one of 000, 001, 002, 004"),
    ],
)
def test_what_is_not_there_is_refused_with_what_is(
    words: tuple[str, ...], reported: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, shown, refused = _findings(capsys, *words)
    assert (status, shown) == (2, "")
    assert refused.startswith(f"magfusion: {reported}")
    assert refused.count("\n") == 1


def test_the_page_of_a_paper_has_every_entry() -> None:
    docs_pages = importlib.import_module("docs_pages")
    for number in ROOMS:
        source = (ROOT / "docs" / "papers" / f"{number}.md").read_text()
        page = docs_pages.on_page_markdown(source)
        rows = [line for line in page.splitlines() if re.match(r"\| \d+ \|", line)]
        assert len(rows) == len(paper(number).entries)
        for row, one in zip(rows, paper(number).entries, strict=True):
            assert len(re.findall(r"(?<!\\)\|", row)) == 6
            assert one.entry.finding in row
