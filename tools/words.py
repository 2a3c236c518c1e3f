"""Find words of a private language in identifiers, messages, docstrings and documentation.

``python tools/words.py`` lists file, line, word and the field's terms for it, and ends with 1 where
something is left; ``--counts`` lists only how often each word occurs.  The lists are in
`word_lists.py`.  Names of options and keys of the site's file are a contract and are not looked at;
neither are keys, columns and codes, which are texts of one word, or names in backticks.
"""

import argparse
import ast
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from house import ROOT, nodes_of
from word_lists import ALLOWED, IN_IDENTIFIERS, IN_TEXT, WHOLE_IDENTIFIERS

CODE = ("magfusion", "tools", "scenarios")
PAGES = ("docs", "README.md", "CONTRIBUTING.md")
LISTS = ("text", "part", "whole")
MAX_ALLOWED = 40
OPTIONS = frozenset({"argument", "option", "required"})  # what makes a field an option
WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
IN_BACKTICKS = re.compile(r"(`+)(?s:.+?)\1")
IN_FENCES = re.compile(r"^( *)(```|~~~)(?s:.*?)^\1\2 *$", re.MULTILINE)
ADDRESS = re.compile(r"\]\([^)\s]*\)|<[^>\n]*>|https?://\S+")  # of a link, or an HTML tag


class Finding(NamedTuple):
    """One banned word.

    Parameters
    ----------
    place : str
        File, relative to the checkout.
    kind : str
        The list that bans it, of `LISTS`.
    name : str
        The identifier; of a text the word.
    """

    place: str
    line: int
    kind: str
    word: str
    name: str
    instead: str

    @property
    def key(self) -> str:
        """As the list of what is allowed names it."""
        return f"{self.place}: {self.name}"


def _by_form(table: dict[str, str]) -> dict[str, str]:
    """Return the replacement of each form of a word."""
    return {form: instead for forms, instead in table.items() for form in forms.split()}


TEXT, PART, WHOLE = map(_by_form, (IN_TEXT, IN_IDENTIFIERS, WHOLE_IDENTIFIERS))
# The longest first, so that a phrase is found before its word.
TEXT_PATTERN = re.compile(
    r"(?<![\w-])("
    + "|".join(form.replace("_", r"\s+") for form in sorted(TEXT, key=len, reverse=True))
    + r")(?![\w-])",
    re.IGNORECASE,
)


def _without(pattern: re.Pattern[str], text: str) -> str:
    """Return a text whose matches are blank, its lines where they were."""
    return pattern.sub(lambda match: re.sub(r"[^\n]", "#", match[0]), text)


def in_text(text: str) -> Iterator[tuple[int, str]]:
    """Return line, from zero, and form of each banned word of a text."""
    blanked = _without(IN_BACKTICKS, text)
    for match in TEXT_PATTERN.finditer(blanked):
        yield blanked.count("\n", 0, match.start()), re.sub(r"\s+", "_", match[0].lower())


@cache
def in_identifier(name: str) -> list[tuple[str, str]]:
    """Return list and form of each banned word of an identifier."""
    words = [word.lower() for word in WORD.findall(name)]
    joined = f"_{'_'.join(words)}_"
    parts = [("part", form) for form in PART if f"_{form}_" in joined]
    if not parts and joined.strip("_") in WHOLE:
        return [("whole", joined.strip("_"))]
    return parts


def _targets(node: ast.AST) -> Iterator[tuple[str, int]]:
    """Return names and lines that one node defines."""
    line = getattr(node, "lineno", 0)
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        yield node.name, line
    elif isinstance(node, ast.arg):
        yield node.arg, line
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        yield node.id, line
    elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
        yield node.attr, line
    elif isinstance(node, ast.alias) and node.asname:
        yield node.asname, line
    elif isinstance(node, ast.MatchAs | ast.MatchStar) and node.name:
        yield node.name, line


def _is_contract(node: ast.AST) -> bool:
    """Return whether a class' line makes an option."""
    call = getattr(node, "value", None)
    return isinstance(call, ast.Call) and getattr(call.func, "id", None) in OPTIONS


def _contract(nodes: Sequence[ast.AST]) -> set[tuple[str, int]]:
    """Return names and lines of options and of keys of the site's file."""
    out: set[tuple[str, int]] = set()
    for node in nodes:
        if isinstance(node, ast.ClassDef):
            is_entry = node.name.endswith("Entry")
            for line in node.body:
                if isinstance(line, ast.AnnAssign) and (is_entry or _is_contract(line)):
                    out.update(_targets(line.target))
    return out


def identifiers(nodes: Sequence[ast.AST]) -> Iterator[tuple[str, int]]:
    """Return names and lines of all that a module defines, but for the contract."""
    contract, seen = _contract(nodes), set()
    for node in nodes:
        for name, line in _targets(node):
            if (name, line) not in contract and (name, line) not in seen:
                seen.add((name, line))
                yield name, line


def messages(nodes: Sequence[ast.AST]) -> Iterator[tuple[str, int]]:
    """Return texts and lines of docstrings and of what has several words."""
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.value, node.lineno


def of_module(nodes: Sequence[ast.AST], place: str, module: str) -> Iterator[Finding]:
    """Return what stands in the way in the nodes of a file; ``module`` is its own name."""
    for name, line in [(module, 1), *identifiers(nodes)]:
        for kind, form in in_identifier(name):
            table = PART if kind == "part" else WHOLE
            yield Finding(place, line, kind, form, name, table[form])
    for text, first in messages(nodes):
        for line, form in in_text(text):
            yield Finding(place, first + line, "text", form, form, TEXT[form])


def of_page(text: str, place: str) -> Iterator[Finding]:
    """Return what is found in a page, outside its code and addresses."""
    for pattern in (IN_FENCES, ADDRESS):
        text = _without(pattern, text)
    for line, form in in_text(text):
        yield Finding(place, line + 1, "text", form, form, TEXT[form])


def _files(roots: Iterable[str], suffix: str) -> Iterator[Path]:
    for root in map(ROOT.joinpath, roots):
        yield from sorted(root.rglob(f"*{suffix}")) if root.is_dir() else [root]


def findings() -> list[Finding]:
    """Return all of the checkout, what is allowed among them."""
    out: list[Finding] = []
    for path in _files(CODE, ".py"):
        if path.stem not in ("words", "word_lists"):
            place = path.relative_to(ROOT).as_posix()
            out.extend(of_module(nodes_of(path), place, path.stem))
    for path in _files(PAGES, ".md"):
        out.extend(of_page(path.read_text(), path.relative_to(ROOT).as_posix()))
    return sorted(out)


def open_findings(everything: Iterable[Finding]) -> list[Finding]:
    """Return what is not allowed."""
    return [f for f in everything if f.key not in ALLOWED]


def main() -> int:
    """Print what is found; 1 where something is."""
    parser = argparse.ArgumentParser(description="Find words of a private language.")
    parser.add_argument("--counts", action="store_true", help="how often each occurs, no places")
    parser.add_argument("--list", choices=LISTS, help="of one list only")
    parser.add_argument("paths", nargs="*", help="only in files whose path begins so")
    arguments = parser.parse_args()
    everything = [f for f in findings() if arguments.list in (None, f.kind)]
    if arguments.paths:
        everything = [f for f in everything if f.place.startswith(tuple(arguments.paths))]
    remaining = open_findings(everything)
    if arguments.counts:
        for (kind, word), count in Counter((f.kind, f.word) for f in remaining).most_common():
            print(f"{count:6d}  {kind:6s}{word}")
    else:
        for f in remaining:
            name = "" if f.name == f.word else f" in {f.name}"
            print(f"{f.place}:{f.line}: {f.kind}: {f.word}{name}: {f.instead}")
    counts = Counter(f.kind for f in remaining)
    print(", ".join(f"{kind} {counts[kind]}" for kind in LISTS), end=" ")
    print(f"(allowed: {len(ALLOWED)} of {MAX_ALLOWED})")
    return 1 if remaining or len(ALLOWED) > MAX_ALLOWED else 0


if __name__ == "__main__":
    sys.exit(main())
