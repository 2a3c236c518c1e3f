"""What the README says is what happens: its blocks run in their order, in an empty directory."""

import re
from pathlib import Path

import pytest
from page_blocks import blocks, run_blocks

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = blocks(README)


@pytest.mark.slow
def test_every_block_of_the_readme_runs_and_shows_what_it_says(tmp_path: Path) -> None:
    run_blocks(README, tmp_path)
    for name in ("magfusion_demo", "run", "navigated"):
        assert (tmp_path / name / "trajectory.tum").is_file()


def test_the_readme_shows_blocks_of_every_kind() -> None:
    assert {language for language, _ in BLOCKS} == {"sh", "yaml", "python", "text"}


@pytest.mark.parametrize("place", re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", README))
def test_what_the_readme_points_to_is_there(place: str) -> None:
    assert (ROOT / place).is_file()


def test_the_readme_is_short_enough_to_be_read() -> None:
    """What is longer has its page in docs/."""
    assert len(README.encode()) <= 12_000


def test_the_readmes_picture_is_small() -> None:
    assert (ROOT / ".github" / "readme.png").stat().st_size <= 300_000  # bytes
