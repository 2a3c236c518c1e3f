"""What the README says is what happens: its blocks run in their order, in an empty directory.

The figures of its prose are those of `figures.yaml`: see `test_told_figures`.
"""

import re
from pathlib import Path

import pytest
from page_blocks import agree, blocks, differences, run_blocks

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = blocks(README)


@pytest.mark.slow
def test_every_block_of_the_readme_runs_and_shows_what_it_says(tmp_path: Path) -> None:
    run_blocks(README, tmp_path)
    for name in ("magfusion_demo", "run", "navigated"):
        assert (tmp_path / name / "trajectory.tum").is_file()


@pytest.mark.parametrize(
    ("reported", "shown", "same"),
    [
        ("0.0293", "0.0294", True),
        ("0.0293", "0.0331", False),
        ("-17", "-17.9", True),
        ("-17", "17", False),
        ("-0.001", "+0.0003", True),
        ("-0.001", "+0.007", False),
        ("4.23", "2.23", False),
        ("2e-05", "2.1e-05", True),
        ("2e-05", "5e-05", False),
    ],
)
def test_a_number_is_what_is_told_within_a_tenth_or_its_last_digit(
    reported: str, shown: str, same: bool
) -> None:
    assert agree(reported, shown) is same


def test_other_words_numbers_and_lines_are_told_and_the_machines_speed_is_not() -> None:
    page = next(block for language, block in BLOCKS if language == "text")
    assert not differences(page, page)
    timed = f"elapsed 8 s\n{page}"
    assert not differences(timed, timed.replace("elapsed 8 s", "elapsed 99 s"))
    other = differences(page, re.sub(r"(NEES )\S+", r"\g<1>99", page))
    assert [line.split()[:2] for line in other] == [
        ["told", "consistency"],
        ["shown", "consistency"],
    ]
    assert differences(page, page.replace("TRUSTWORTHY", "DOUBTFUL"))
    assert differences(page, page.splitlines()[0])


def test_the_readme_shows_blocks_of_every_kind() -> None:
    assert {language for language, _ in BLOCKS} == {"sh", "yaml", "python", "text"}


def test_what_the_readme_points_to_is_there() -> None:
    places = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", README)
    assert places
    assert not [place for place in places if not (ROOT / place).is_file()]


def test_the_readme_is_short_enough_to_be_read() -> None:
    """What is longer has its page in docs/."""
    assert len(README.encode()) <= 12_000


def test_the_readmes_picture_is_small() -> None:
    assert (ROOT / ".github" / "readme.webp").stat().st_size <= 150_000  # bytes
