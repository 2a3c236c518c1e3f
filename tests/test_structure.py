"""The house stands: imports run down, and each delicate library has one room."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "magfusion"

# The floors of the house, from the ground; what stands on one floor does not see its neighbours.
FLOORS = (
    {"units", "errors"},
    {"physics", "strapdown", "files", "field_map", "correlation", "monte_carlo"},
    {"site", "trajectory", "site_schema", "field_map_file", "correlation_file"},
    {"site_correlation", "shapes"},
    {"site_file"},
    {"records", "observation", "antenna", "view", "site_moves"},
    {"parameters", "weights"},
    {"prior"},
    {"refinement"},
    {"receiver", "simulation", "calibration", "fusion", "fixes", "evaluation"},
    {"report", "job", "plots", "view_coverage", "view_drift", "view_live"},
    {"pipeline", "jobs", "screen", "options"},
    {"demo"},
    {"cli"},
)
DRAWN = {
    ("calibration", "fixes"),
    ("calibration", "receiver"),
    ("fusion", "fixes"),
    ("fusion", "receiver"),
}


def _floor(room: str) -> int:
    for floor, rooms in enumerate(FLOORS):
        if room in rooms:
            return floor
    raise AssertionError(f"magfusion.{room} stands on no floor: give it one in FLOORS")


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
        if (room, seen) not in DRAWN:
            assert _floor(seen) < _floor(room), f"{room} imports {seen}"


def test_the_drawn_imports_leave_no_circle() -> None:
    assert not {(b, a) for a, b in DRAWN} & DRAWN


def test_only_the_view_imports_rerun() -> None:
    views = {"view", "view_coverage", "view_drift", "view_live"}
    assert _importers("rerun") <= {f"magfusion/{name}.py" for name in views}


def test_only_the_plots_import_matplotlib() -> None:
    assert all(name.startswith("magfusion/plots/") for name in _importers("matplotlib"))


def test_only_the_ekf_imports_filterpy() -> None:
    assert _importers("filterpy") <= {"magfusion/fusion/ekf.py"}


def test_the_package_does_without_pandas() -> None:
    assert not _importers("pandas")


def test_the_simulator_knows_nothing_of_the_estimators_model() -> None:
    for path in (PACKAGE / "simulation").rglob("*.py"):
        assert not _rooms_seen(path) & {"observation", "antenna", "parameters"}, _name(path)


def test_one_file_of_fusion_builds_custom_factors() -> None:
    builders = {
        _name(path)
        for path in _modules()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute | ast.alias)
        and "CustomFactor" in (node.attr if isinstance(node, ast.Attribute) else node.name)
    }
    assert len(builders) <= 1
    assert all(name.startswith("magfusion/fusion/") for name in builders)


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
