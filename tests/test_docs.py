"""What the documentation says is there, is all, and happens."""

import re
import shutil
from pathlib import Path

import pytest
from page_blocks import blocks, run_blocks

import magfusion
from magfusion.jobs import JOBS
from magfusion.model.trust import CODES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {path.relative_to(DOCS).as_posix(): path.read_text() for path in DOCS.rglob("*.md")}
START = "index.md"


def test_every_code_of_a_finding_has_its_cause_and_its_remedy() -> None:
    page = PAGES["troubleshooting.md"]
    entries = re.findall(r"^### `(\w+)`\n(.*?)(?=^##|\Z)", page, re.M | re.S)
    assert sorted(code for code, _ in entries) == sorted(CODES)
    for code, text in entries:
        assert re.search(r"\*\*Cause\.\*\*\s\S.*\*\*Remedy\.\*\*\s\S", text, re.S), code


def test_every_command_has_a_page_with_its_options_and_an_example() -> None:
    for path in JOBS:
        pages = [text for text in PAGES.values() if f"<!-- options: {path} -->" in text]
        assert len(pages) == 1, path
        assert f"magfusion {path}" in pages[0] or f"`{path} " in pages[0], path


def test_the_reference_has_every_name_of_the_package_and_no_other() -> None:
    shown = re.findall(r"^::: ([\w.]+)$", PAGES["api.md"], re.M)
    names = [getattr(magfusion, name) for name in magfusion.__all__]
    assert sorted(shown) == sorted(f"{one.__module__}.{one.__qualname__}" for one in names)


def test_every_page_is_in_the_contents() -> None:
    contents = (ROOT / "mkdocs.yml").read_text()
    for name in PAGES:
        assert f": {name}\n" in contents


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory that the first page leaves to all others."""
    directory = tmp_path_factory.mktemp("start")
    run_blocks(PAGES[START], directory)
    return directory


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [n for n, page in PAGES.items() if n not in (START, "kit.md") and blocks(page)]
)
def test_what_a_page_says_is_what_happens(name: str, started: Path, tmp_path: Path) -> None:
    """Of all pages but the kit's, which `test_kit` follows."""
    directory = shutil.copytree(started, tmp_path / "here")
    run_blocks(PAGES[name], directory)


@pytest.mark.slow
def test_the_figures_are_drawn_by_the_package(tmp_path: Path) -> None:
    from docs_figures import FIGURES, draw

    shown = re.findall(r"\((?:\.\./)?figures/(\w+)\.png\)", "".join(PAGES.values()))
    assert {path.stem for path in (DOCS / "figures").iterdir()} == set(shown) >= set(FIGURES)
    for drawn in draw(list(FIGURES), tmp_path):
        assert drawn.stat().st_size > 10_000  # bytes; empty axes have fewer


def test_the_pictures_of_a_paper_are_drawn_by_a_scenario() -> None:
    from docs_pictures import PAPERS

    pages = {n: text for n, text in PAGES.items() if n.startswith("papers/")}
    shown = re.findall(r"\]\((\w+)\.png\)", "".join(pages.values()))
    assert {path.stem for path in (DOCS / "papers").glob("*.png")} == set(shown) == set(PAPERS)
    assert all((ROOT / "scenarios" / one.split()[0]).is_file() for one, _ in PAPERS.values())
