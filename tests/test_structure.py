"""The house stands: imports run down, and each delicate library has one room.

One test a rule: what breaks it is listed in the failure.
"""

import ast
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import pytest
from house import (
    PACKAGE,
    ROOMS,
    ROOT,
    arrows,
    circles,
    file_graph,
    files_by_folder,
    imports_of,
    modules,
    nodes_of,
    parsed,
    room_circles,
    room_of,
    shape,
    upward,
)

MAX_FOLDER = 25  # files of a room of `estimation`
INTEGRITY = 32  # until one bank of hypotheses has replaced what it holds


def _modules() -> list[Path]:
    return [path for name, path in modules().items() if name != "magfusion"]


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _importers(library: str) -> set[str]:
    return {
        _name(path)
        for path in _modules()
        if any(n.split(".")[0] == library for n in imports_of(path))
    }


def _offenders(
    paths: Iterable[Path], result: Callable[[Sequence[ast.AST]], Iterable[object]]
) -> list[str]:
    """Return a line for each file in which something was found."""
    out = []
    for path in paths:
        there = list(result(nodes_of(path)))
        if there:
            out.append(f"{_name(path)}: {', '.join(map(str, there))}")
    return out


def test_a_wing_imports_only_from_wings_below_it() -> None:
    assert not upward(), "\n".join(upward())


def test_a_room_imports_only_from_rooms_of_its_wing_below_it() -> None:
    result = [line for wing in ROOMS for line in upward(wing)]
    assert not result, "\n".join(result)


def test_the_order_names_every_wing_and_no_room_that_is_not_there() -> None:
    assert {room_of(name) for name in modules() if name.count(".") > 1} == set(ROOMS)
    there = {wing: {room_of(name, wing) for name in modules()} for wing in ROOMS}
    elapsed = [
        f"{wing}.{room}"
        for wing, rooms in ROOMS.items()
        for room in rooms
        if room not in there[wing]
    ]
    assert not elapsed
    assert all(len(set(rooms)) == len(rooms) for rooms in ROOMS.values())


def test_no_files_import_one_another_in_a_circle() -> None:
    result = circles(file_graph())
    assert not result, "\n".join(map(", ".join, result))


def test_a_circle_is_found() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"d", "b"}, "d": set()}
    assert circles(graph) == [["b", "c"]]


def test_the_house_stays_small() -> None:
    house = shape()
    assert house["rooms"] <= 18
    assert house["arrows"] <= 90
    assert house["loose_files"] <= 5
    assert not room_circles()


def test_the_rooms_of_the_estimators_stay_small() -> None:
    house = shape("estimation")
    assert house["rooms"] <= 15
    assert house["arrows"] <= 70, sorted(arrows("estimation"))
    assert house["loose_files"] == 0
    files = {place.name: count for place, count in files_by_folder("estimation").items()}
    assert files.pop("integrity") <= INTEGRITY
    assert max(files.values()) <= MAX_FOLDER, files


def test_nothing_else_is_loose_at_the_root() -> None:
    files = {"__init__.py", "__main__.py", "cli.py", "errors.py", "units.py"}
    assert {path.name for path in PACKAGE.glob("*.py")} == files


def test_the_line_of_commands_knows_no_job() -> None:
    """A command is made of its job's file when it is asked for."""
    seen = {n for n in imports_of(PACKAGE / "cli.py") if "jobs" in n}
    known = {"JOBS", "GROUPS", "failure", "settings", "typer_options"}
    assert {name.split(".")[2] for name in seen} <= known


def test_the_simulator_has_its_own_physics_of_coils() -> None:
    """Biot and Savart's sum contradicts the estimators' closed form, if that is wrong."""
    seen: set[str] = set()
    for place in ("simulation/field.py", "model/physics/solenoid.py"):
        seen |= set(imports_of(PACKAGE / place))
    assert not any("loop.loop_" in name or "coil_field" in name for name in seen)


def test_only_the_view_imports_rerun() -> None:
    assert all(name.startswith("magfusion/results/recording") for name in _importers("rerun"))


def test_only_the_plots_import_matplotlib() -> None:
    assert all(name.startswith("magfusion/results/plots/") for name in _importers("matplotlib"))


def test_only_one_file_imports_filterpy() -> None:
    assert _importers("filterpy") == {"magfusion/estimation/graph/kalman.py"}


def test_no_file_of_the_package_can_hold_code() -> None:
    seen = {n.split(".")[0] for path in _modules() for n in imports_of(path)}
    assert not seen & {"pickle", "marshal", "shelve", "dill", "cloudpickle"}


def test_the_package_does_without_pandas() -> None:
    assert not _importers("pandas")


OPTIMISERS = {
    "EliminateQR",
    "LevenbergMarquardtOptimizer",
    "damping",
    "eliminateMultifrontal",
    "eliminatePartialMultifrontal",
    "eliminatePartialSequential",
    "eliminateSequential",
}


def _identifiers(nodes: Iterable[ast.AST]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.arg):
            yield node.arg


def test_only_solve_optimises() -> None:
    """One damped loop for many small problems, one for graphs, and one fallback to QR."""
    solvers, fallbacks = set(), 0
    for path in _modules():
        names = list(_identifiers(nodes_of(path)))
        fallbacks += names.count("EliminateQR")
        imported = {name for name in imports_of(path) if name.startswith("scipy.optimize")}
        if imported or OPTIMISERS & set(names):
            solvers.add(_name(path))
    assert solvers == {
        f"magfusion/estimation/solve/{name}.py"
        for name in ("batched", "bordered", "bounded", "native")
    }
    assert fallbacks == 2  # of a whole graph, and of a part of one


SIMULATOR_SEES = {
    "aiding",  # what a sensor is and records; how it measures is the estimator's
    "arguments",
    "correlation",
    "marks",
    "physics",
    "response",
    "rotor",
    "samples",
    "short_repr",
    "site",
    "trajectory",
}  # of the model


def test_the_simulator_knows_nothing_of_the_estimators_model() -> None:
    for path in (PACKAGE / "simulation").rglob("*.py"):
        for name in imports_of(path):
            wing, *rest = name.split(".")[1:3] if name.startswith("magfusion.") else ("",)
            assert wing in {"", "errors", "units", "files", "simulation", "model"}, (
                f"{path}: {name}"
            )
            assert wing != "model" or rest[0] in SIMULATOR_SEES, f"{_name(path)}: {name}"


def test_one_file_of_estimation_builds_custom_factors() -> None:
    builders = {
        _name(path)
        for path in _modules()
        for node in nodes_of(path)
        if isinstance(node, ast.Attribute | ast.alias)
        and "CustomFactor" in (node.attr if isinstance(node, ast.Attribute) else node.name)
    }
    assert len(builders) <= 1
    assert all(name.startswith("magfusion/estimation/") for name in builders)


def _compares_with_hidden_tolerance(node: ast.AST) -> bool:
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
        return False
    stated = {keyword.arg for keyword in node.keywords}
    return node.func.attr in {"allclose", "isclose"} and not {"rtol", "atol"} <= stated


def test_tests_state_the_tolerance_of_allclose() -> None:
    """Its default ``atol`` of 1e-8 is larger than any field, so that it is true of all teslas."""

    def hidden(nodes: Iterable[ast.AST]) -> list[int]:
        return [getattr(n, "lineno", 0) for n in nodes if _compares_with_hidden_tolerance(n)]

    result = _offenders(sorted((ROOT / "tests").glob("*.py")), hidden)
    assert not result, "\n".join(["allclose without rtol and atol in lines", *result])


@pytest.mark.parametrize(
    ("line", "hidden"),
    [
        ("np.allclose(a, b)", True),
        ("np.isclose(a, b, rtol=1e-3)", True),
        ("np.allclose(a, b, rtol=1e-3, atol=0)", False),
        ("np.testing.assert_allclose(a, b, rtol=1e-3)", False),
    ],
)
def test_the_guard_on_allclose_sees_what_it_should(line: str, hidden: bool) -> None:
    assert any(map(_compares_with_hidden_tolerance, ast.walk(ast.parse(line)))) is hidden


def _strings(node: ast.AST) -> bool:
    return any(isinstance(n, ast.Constant) and isinstance(n.value, str) for n in ast.walk(node))


def _names_a_kind(node: ast.AST) -> bool:
    """Tell whether something is decided by the name of a parameter's kind or group."""

    def is_name(part: ast.AST) -> bool:
        if not (isinstance(part, ast.Attribute) and part.attr in {"kind", "group"}):
            return False
        return not (isinstance(part.value, ast.Attribute) and part.value.attr == "dtype")

    if isinstance(node, ast.Compare):
        parts = [node.left, *node.comparators]
        return any(map(is_name, parts)) and any(map(_strings, parts))
    if isinstance(node, ast.Subscript):
        return is_name(node.slice)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        return node.func.attr in {"get", "startswith"} and any(map(is_name, node.args))
    return False


def test_nothing_is_decided_by_the_name_of_a_parameters_kind() -> None:
    """All that is particular to a kind of parameter is in its object: see model/parameters."""

    def named(nodes: Iterable[ast.AST]) -> list[int]:
        return [getattr(node, "lineno", 0) for node in nodes if _names_a_kind(node)]

    result = _offenders(_modules(), named)
    assert not result, "\n".join(["kinds or groups are compared in lines", *result])


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ('block.kind == "phase"', True),
        ('block.group in ("beacons", "moments")', True),
        ("_UNITS[block.kind]", True),
        ("PER_HOUR.get(block.kind, 0.0)", True),
        ("block.parameter == PHASE", False),
        ("block.group in chosen", False),
        ("found.kind == Kind.PLANE", False),
        ('array.dtype.kind in "iu"', False),
    ],
)
def test_the_guard_on_kinds_sees_what_it_should(line: str, named: bool) -> None:
    assert any(map(_names_a_kind, ast.walk(ast.parse(line)))) is named


# Of the platform's motion, its clocks and its room: `MotionModel`, `ClockModel`, `EarthModel`.
_OF_THE_SITE = re.compile(
    r"_?(REST_(GYRO|ACCEL|SPAN|SIGMA)|KNOWN_SPEED|(SPEED|VELOCITY|ACCEL|GRAVITY)_SIGMA|PER_HOUR"
    r"|(DRIFT|CLOCK)_(SIGMA|SEARCH|DRIFT)|(DECLINATION|STRENGTH)_SIGMA)"
)


def _constants(module: ast.Module) -> Iterator[str]:
    for node in module.body:
        for target in node.targets if isinstance(node, ast.Assign) else ():
            for name in ast.walk(target):
                if isinstance(name, ast.Name) and name.id.isupper():
                    yield name.id


def test_what_describes_the_platforms_motion_or_a_clock_is_in_the_site() -> None:
    result = [
        f"{_name(path)}: {name}"
        for path in _modules()
        for name in filter(_OF_THE_SITE.fullmatch, _constants(parsed(path)))
    ]
    assert not result, "\n".join(result)
