"""The figures that the pages print are those that their commands give."""

import ast
import re
from pathlib import Path

import pytest
from figures import LOGS, MINUS, ROOT, Entry, compared, flat, measured, printed, register

REGISTER = register()


@pytest.mark.parametrize("entry", REGISTER.figures, ids=lambda entry: entry.sentences[0][:40])
def test_the_sentences_are_printed_and_what_holds_them_is_there(entry: Entry) -> None:
    for sentence in entry.sentences:
        printed(entry.page, sentence)
    if entry.test is not None:
        path, _, name = entry.test.partition("::")
        tree = ast.parse((ROOT / path).read_text())
        assert name in {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
    words = entry.command.split() if entry.command else []
    assert all((ROOT / word).is_file() for word in words if word.endswith(".py"))


MEASURED = [
    pytest.param(entry, id=entry.command, marks=pytest.mark.slow)
    for entry in REGISTER.figures
    # What takes minutes on other pages, `python tools/figures.py` runs before a release.
    if entry.command
    and entry.takes != "hours"
    and (entry.takes == "seconds" or entry.page == "README.md")
]


@pytest.mark.parametrize("entry", MEASURED)
def test_the_command_gives_the_figures(entry: Entry, tmp_path: Path) -> None:
    assert entry.command is not None
    if "{logs}" in entry.command and not LOGS.is_dir():
        pytest.skip("the recorded logs are not beside the repository")
    result = measured(entry.command, tmp_path)
    assert not [one for one in compared(entry, result) if not one.agrees]


def test_a_figure_changed_by_hand_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("figures.flat", lambda _: f"errs by 1.5 mm, 2,000 of {MINUS}3 m")
    entry = Entry(
        page="page.md",
        command="x",
        sentences=["by {a.0 * 1e3} mm, {b} of {c} m"],
        spread=0.01,
        why="any",
    )
    agree = [one.agrees for one in compared(entry, {"a": [0.00146], "b": 2015, "c": -3.4})]
    assert agree == [True, True, True]
    agree = [one.agrees for one in compared(entry, {"a": [0.00142], "b": 2030, "c": -3.6})]
    assert agree == [False, False, False]
    with pytest.raises(ValueError, match="0 times"):
        printed("page.md", "by {a} cm")


def test_a_row_of_a_table_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("figures.flat", lambda _: "|---|---| | one, alone | 1.5 m | 2 | | two | 3")
    row = "| one, alone | {rows.one, alone.left.error_m} m | {rows.one, alone.right.error_m} |"
    entry = Entry(page="page.md", command="x", sentences=[row, "| two | {}"])
    cases = [("both", "left", 9.0), ("one, alone", "left", 1.52), ("one, alone", "right", 2.6)]
    rows = [{"case": case, "side": side, "error_m": error} for case, side, error in cases]
    assert [one.agrees for one in compared(entry, {"rows": rows})] == [True, False]


def test_a_spread_has_its_reason() -> None:
    for given in ({"spread": 0.1}, {"why": "ten draws"}):
        with pytest.raises(ValueError, match="with its reason"):
            Entry.model_validate({"page": "page.md", "command": "x", "sentences": [], **given})


NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.,]*\d|(?<![\w.])\d\b")


# Names with a number, which nobody measures.
NAMED = re.compile(
    r"\b(?:papers?|Eq|figures?|algorithms?|exit(?: code)?|ROS|Python)"
    r" \d[\d.]*(?:(?: to |, | and )\d[\d.]*)*"
)


@pytest.mark.parametrize("name", ["README.md", "CHANGELOG.md"])
def test_every_number_in_the_prose_is_measured_or_given(name: str) -> None:
    """Outside of blocks, which `test_readme` runs, of code, and of what it points to."""
    prose = re.sub(r"^```.*?^```$", "", (ROOT / name).read_text(), flags=re.M | re.S)
    prose = _plain(re.sub(r"^#+.*$", " ", prose, flags=re.M))
    for entry in REGISTER.figures:
        for sentence in entry.sentences if entry.page == name else ():
            for number in printed(name, sentence)[0]:
                sentence = re.sub(r"\{[^}]*\}", number, sentence, count=1)
            prose = prose.replace(_plain(sentence), " ")
    for phrase in REGISTER.given if name == "README.md" else ():
        prose = prose.replace(_plain(phrase), " ")
    result = NUMBER.findall(NAMED.sub(" ", prose))
    assert not result, "put it into figures.yaml with what makes it, or into docs/measured.md"


def _plain(text: str) -> str:
    return " ".join(re.sub(r"\]\([^)]*\)|`[^`]*`", " ", text).split())


def test_what_is_given_is_in_the_readme() -> None:
    assert all(phrase in flat("README.md") for phrase in REGISTER.given)


def test_the_drift_of_the_readme_is_that_of_its_page() -> None:
    (reported,) = re.findall(
        r"-?[\d.]+ ± [\d.]+ mm and -?[\d.]+ ± [\d.]+° a day", flat("README.md")
    )
    assert reported in flat("docs/jobs/drift.md")
