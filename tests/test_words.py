"""The package speaks the field's language: no banned word in a text or an identifier."""

import ast
from collections.abc import Iterable

import pytest
import words
from word_lists import ALLOWED


@pytest.fixture(scope="module")
def everything() -> list[words.Finding]:
    return words.findings()


def _remaining(everything: Iterable[words.Finding], kind: str) -> str:
    found = [f for f in words.open_findings(everything) if f.kind == kind]
    return "\n".join(f"{f.place}:{f.line}: {f.name}: {f.instead}" for f in found)


def test_no_text_has_a_banned_word(everything: list[words.Finding]) -> None:
    assert not _remaining(everything, "text")


def test_no_identifier_has_a_banned_part(everything: list[words.Finding]) -> None:
    assert not _remaining(everything, "part")


def test_no_identifier_is_a_banned_word(everything: list[words.Finding]) -> None:
    assert not _remaining(everything, "whole")


def test_few_words_are_allowed_each_with_its_reason() -> None:
    assert len(ALLOWED) <= words.MAX_ALLOWED
    assert all(len(reason.split()) >= 3 for reason in ALLOWED.values())


def test_what_is_allowed_exists(everything: list[words.Finding]) -> None:
    assert set(ALLOWED) <= {f.key for f in everything}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("fields_heard", [("part", "heard")]),
        ("HeldMotion", [("whole", "held_motion")]),
        ("MIN_TOLD", [("part", "told")]),
        ("_found", [("whole", "found")]),
        ("found_world", []),
        ("unfolded", []),
    ],
)
def test_an_identifier_is_split_at_underscores_and_capitals(
    name: str, expected: list[tuple[str, str]]
) -> None:
    assert words.in_identifier(name) == expected


def test_a_text_is_read_without_its_code() -> None:
    text = "The `told` columns\nare **told** apart by `heard_{beacon}`.\nTolder words, --beside it."
    assert list(words.in_text(text)) == [(1, "told")]
    page = "```sh\necho said\n```\nIt [says](said.md).\n"
    assert [(f.line, f.word) for f in words.of_page(page, "a.md")] == [(4, "says")]


def test_options_and_keys_of_files_are_exempt() -> None:
    source = """
class Settings:
    apart: bool = option(False, "demodulate each by itself")
    asked: bool = False
class SourceEntry(Section):
    heard: bool = False
def told(beside: int) -> None:
    self.said = beside
"""
    nodes = list(ast.walk(ast.parse(source)))
    names = {name for name, _ in words.identifiers(nodes)}
    assert names == {"Settings", "asked", "SourceEntry", "told", "beside", "said"}
    kinds = [f.word for f in words.of_module(nodes, "a.py", "a") if f.kind != "text"]
    assert sorted(kinds) == ["asked", "beside", "said", "told"]
