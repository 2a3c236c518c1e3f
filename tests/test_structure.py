"""The house stands: imports run down, and each delicate library has one room."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from house import measured

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "magfusion"

# From the ground up.  A wing imports only from those before it.
WINGS = (
    "units",
    "errors",
    "model",
    "files",
    "receiver",
    "simulation",
    "estimation",
    "calibration",
    "papers",
    "results",
    "jobs",
    "cli",
    "__main__",
)


def _floor(room: str) -> int:
    assert room in WINGS, f"magfusion.{room} is no wing: see WINGS"
    return WINGS.index(room)


def _modules() -> list[Path]:
    return sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the floor"
            assert node.module is not None
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _rooms_seen(path: Path) -> set[str]:
    imported = [name.split(".") for name in _imports(ast.parse(path.read_text()))]
    return {parts[1] for parts in imported if parts[0] == "magfusion" and len(parts) > 1}


def _room(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def _importers(library: str) -> set[str]:
    return {
        _name(path)
        for path in _modules()
        if any(n.split(".")[0] == library for n in _imports(ast.parse(path.read_text())))
    }


@pytest.mark.parametrize("path", _modules(), ids=_name)
def test_imports_only_run_down(path: Path) -> None:
    room = _room(path)
    for seen in _rooms_seen(path) - {room}:
        assert _floor(seen) < _floor(room), f"{room} imports {seen}"


def test_the_house_stays_small() -> None:
    house = measured()
    assert house["rooms"] <= 18
    assert house["arrows"] <= 90
    assert house["rooms_in_a_circle"] == 0
    assert house["loose_files"] <= 5


def test_nothing_else_is_loose_at_the_root() -> None:
    files = {"__init__.py", "__main__.py", "cli.py", "errors.py", "units.py"}
    assert {path.name for path in PACKAGE.glob("*.py")} == files


def test_the_line_of_commands_knows_no_job() -> None:
    """A command is made of its job's file when it is asked for."""
    seen = {n for n in _imports(ast.parse((PACKAGE / "cli.py").read_text())) if "jobs" in n}
    assert {name.split(".")[2] for name in seen} <= {"JOBS", "GROUPS", "failure", "settings"}


def test_the_simulator_has_its_own_physics_of_coils() -> None:
    """Biot and Savart's sum contradicts the estimators' closed form, if that is wrong."""
    seen: set[str] = set()
    for place in ("simulation/field.py", "model/physics/solenoid.py"):
        seen |= set(_imports(ast.parse((PACKAGE / place).read_text())))
    assert not any("loop.loop_" in name or "coil_field" in name for name in seen)


def test_only_the_view_imports_rerun() -> None:
    assert all(name.startswith("magfusion/results/recording") for name in _importers("rerun"))


def test_only_the_plots_import_matplotlib() -> None:
    assert all(name.startswith("magfusion/results/plots/") for name in _importers("matplotlib"))


def test_only_the_ekf_imports_filterpy() -> None:
    assert _importers("filterpy") <= {"magfusion/estimation/online/ekf.py"}


def test_no_file_of_the_package_can_hold_code() -> None:
    seen = {n.split(".")[0] for path in _modules() for n in _imports(ast.parse(path.read_text()))}
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


def _identifiers(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
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
        tree = ast.parse(path.read_text())
        names = list(_identifiers(tree))
        fallbacks += names.count("EliminateQR")
        imported = {name for name in _imports(tree) if name.startswith("scipy.optimize")}
        if imported or OPTIMISERS & set(names):
            solvers.add(_name(path))
    assert solvers == {
        f"magfusion/estimation/solve/{name}.py" for name in ("batched", "bordered", "bounded")
    }
    assert fallbacks == 2  # of a whole graph, and of a part of one


SIMULATOR_SEES = {
    "correlation",
    "marks",
    "physics",
    "response",
    "rotor",
    "samples",
    "site",
    "trajectory",
}  # of the model


def test_the_simulator_knows_nothing_of_the_estimators_model() -> None:
    for path in (PACKAGE / "simulation").rglob("*.py"):
        for name in _imports(ast.parse(path.read_text())):
            wing, *rest = name.split(".")[1:3] if name.startswith("magfusion.") else ("",)
            assert wing in {"", "errors", "units", "files", "simulation", "model"}, (
                f"{path}: {name}"
            )
            assert wing != "model" or rest[0] in SIMULATOR_SEES, f"{_name(path)}: {name}"


def test_one_file_of_estimation_builds_custom_factors() -> None:
    builders = {
        _name(path)
        for path in _modules()
        for node in ast.walk(ast.parse(path.read_text()))
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


@pytest.mark.parametrize("path", sorted((ROOT / "tests").glob("*.py")), ids=_name)
def test_tests_state_the_tolerance_of_allclose(path: Path) -> None:
    """Its default ``atol`` of 1e-8 is larger than any field, so that it is true of all teslas."""
    hidden = [
        node.lineno
        for node in ast.walk(ast.parse(path.read_text()))
        if _compares_with_hidden_tolerance(node)
    ]
    assert not hidden, f"allclose without rtol and atol in lines {hidden}"


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


@pytest.mark.parametrize("path", _modules(), ids=_name)
def test_nothing_is_decided_by_the_name_of_a_parameters_kind(path: Path) -> None:
    """All that is particular to a kind of parameter is in its object: see model/parameters."""
    found = [node.lineno for node in ast.walk(ast.parse(path.read_text())) if _names_a_kind(node)]
    assert not found, f"{_name(path)} compares kinds or groups in lines {found}"


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


@pytest.mark.parametrize("path", _modules(), ids=_name)
def test_what_describes_the_platforms_motion_or_a_clock_is_in_the_site(path: Path) -> None:
    names = {
        target.id
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Assign)
        for whole in node.targets
        for target in ast.walk(whole)
        if isinstance(target, ast.Name) and target.id.isupper()
    }
    found = {name for name in names if _OF_THE_SITE.fullmatch(name)}
    assert not found, f"{_name(path)}: {sorted(found)}"
