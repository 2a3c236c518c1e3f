"""The size of code: lines, functions and their complexity, constants, records."""

import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

Trees = Mapping[Path, ast.Module]
Function = ast.FunctionDef | ast.AsyncFunctionDef
NUMBERS = (int, float, complex)
BODIES = ("body", "orelse", "finalbody")
BRANCHES = (ast.If, ast.For, ast.AsyncFor, ast.While, ast.ExceptHandler, ast.match_case)
_BLANK = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


def functions(trees: Trees) -> Iterator[tuple[Path, Function]]:
    """Yield every function and method."""
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, Function):
                yield path, node


def complexity(function: ast.AST) -> int:
    """Return the cyclomatic complexity of a function as McCabe's plugin and ruff's C901 count it.

    One, and one more for each branch, loop, handler, case and inner function.
    """
    return 1 + sum(map(_branches, _statements(function)))


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    for name in (*BODIES, "handlers", "cases"):
        yield from getattr(node, name, ())


def _branches(node: ast.AST) -> int:
    own = isinstance(node, (*BRANCHES, ast.FunctionDef, ast.AsyncFunctionDef))
    last = node.cases[-1] if isinstance(node, ast.Match) else None
    if last is not None and last.guard is None and isinstance(last.pattern, ast.MatchAs):
        own = -(last.pattern.name is None)  # ``case _`` is no further way
    return int(own) + sum(map(_branches, _statements(node)))


def decisions(function: ast.AST) -> int:
    """Return one and all decisions of a function.

    Those of `complexity`, and those inside expressions: ``and``, ``or``, conditional expressions,
    and comprehensions with their conditions.
    """
    count = 1
    for node in ast.walk(function):
        count += isinstance(node, (*BRANCHES, ast.IfExp))
        if isinstance(node, ast.comprehension):
            count += 1 + len(node.ifs)
        elif isinstance(node, ast.BoolOp):
            count += len(node.values) - 1
    return count


def lines_of(function: Function) -> int:
    """Return how many lines a function takes, from ``def`` to its end."""
    assert function.end_lineno is not None
    return function.end_lineno - function.lineno + 1


def line_count(paths: Iterable[Path]) -> int:
    """Return the lines of files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def code_lines(path: Path, tree: ast.Module) -> int:
    """Return the lines of a file that hold code: no docstrings, comments and blanks."""
    text = path.read_text(encoding="utf-8")
    fixed = {
        line
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in _BLANK
        for line in range(token.start[0], token.end[0] + 1)
    }
    for node in ast.walk(tree):
        if isinstance(node, Function | ast.ClassDef | ast.Module) and ast.get_docstring(node):
            first = node.body[0]
            fixed -= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return len(fixed)


def constants(tree: ast.Module) -> int:
    """Return how many numeric constants a module names in capitals."""
    return sum(
        _numbers(target, node.value)
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
    )


def _numbers(target: ast.AST, value: ast.AST) -> int:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        return sum(map(_numbers, target.elts, value.elts))
    named = isinstance(target, ast.Name) and target.id.isupper()
    while isinstance(value, ast.UnaryOp):
        value = value.operand
    return int(named and isinstance(value, ast.Constant) and type(value.value) in NUMBERS)


def records(trees: Trees) -> set[str]:
    """Return the names of data classes and named tuples."""
    return {
        node.name
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and _is_record(node)
    }


def _is_record(node: ast.ClassDef) -> bool:
    marks = [*node.bases, *node.decorator_list]
    names = {n.id for mark in marks for n in ast.walk(mark) if isinstance(n, ast.Name)}
    return bool(names & {"dataclass", "NamedTuple"})


def calls(trees: Trees) -> Counter[str]:
    """Return in how many places each name is called."""
    return Counter(
        node.func.id if isinstance(node.func, ast.Name) else node.func.attr
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute)
    )


def spread(name: str, values: list[int]) -> dict[str, float]:
    """Return the 95th percentile and the maximum."""
    ordered = sorted(values)
    return {f"{name}_p95": ordered[int(0.95 * len(ordered))], f"{name}_max": ordered[-1]}


def sizes(trees: Trees, package: Trees, tests: Trees | None = None) -> dict[str, float]:
    """Return the figures of some files.

    Parameters
    ----------
    package : mapping
        All files in which their records may be built.
    tests : mapping, optional
        Whose lines are compared with those of the files.
    """
    result = [function for _, function in functions(trees)]
    lines = line_count(trees)
    built, declared = calls(package), records(trees)
    out = {
        **spread("function_lines", [lines_of(function) for function in result]),
        **spread("cyclomatic", [complexity(function) for function in result]),
        **spread("decisions", [decisions(function) for function in result]),
        "records": len(declared),
        "records_built_once_at_most": sum(built[name] <= 1 for name in declared),
        "lines": lines,
        "code_lines": sum(code_lines(path, tree) for path, tree in trees.items()),
        "constants_per_kloc": round(1e3 * sum(map(constants, trees.values())) / lines, 2),
    }
    if tests is not None:
        out["test_to_code"] = round(line_count(tests) / lines, 3)
    return out
