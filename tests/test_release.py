"""What is built of the tree holds the package whole, and knows of which commit it is."""

import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml

from magfusion.files.commit import commit

ROOT = Path(__file__).parents[1]


def _git(*words: str) -> str:
    done = subprocess.run(["git", "-C", ROOT, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip("not a git checkout")
    return done.stdout


def _built(tree: Path, kind: str, out: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(out)]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = out.iterdir()
    return built


def _metadata(wheel: Path) -> str:
    return "-".join(wheel.name.split("-")[:2]) + ".dist-info"


def test_a_checkout_knows_its_commit() -> None:
    """Whether it runs from the tree, or was installed of it."""
    told = _git("rev-parse", "HEAD").strip()
    known = commit()
    assert known is not None
    assert told.startswith(known.removesuffix("-dirty"))


@pytest.mark.slow
def test_wheel_and_sdist_hold_the_package_and_the_commit(tmp_path: Path) -> None:
    tracked = set(_git("ls-files", "magfusion").split())
    assert "magfusion/py.typed" in tracked
    sdist = _built(ROOT, "sdist", tmp_path / "sdist")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "tree", filter="data")
    (tree,) = (tmp_path / "tree").iterdir()
    assert tracked <= {str(path.relative_to(tree)) for path in tree.rglob("*")}
    wheels = [_built(ROOT, "wheel", tmp_path / "a"), _built(tree, "wheel", tmp_path / "b")]
    told = []
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as archive:
            names = set(archive.namelist())
            told.append(archive.read("magfusion/commit.txt").decode())
        assert tracked <= names
        assert not {name.split("/")[0] for name in names} - {"magfusion", _metadata(wheel)}
    assert told[0] == told[1]
    assert _git("rev-parse", "HEAD").startswith(told[0].strip().removesuffix("-dirty"))


def test_every_python_that_the_package_accepts_is_tried() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    tried = workflow["jobs"]["suite"]["strategy"]["matrix"]["python"]
    assert tried == ["3.11", "3.12", "3.13", "3.14"]
    project = (ROOT / "pyproject.toml").read_text()
    assert f'requires-python = ">={tried[0]}"' in project
    steps = workflow["jobs"]["oldest-dependencies"]["steps"]
    assert any("lowest-direct" in step.get("run", "") for step in steps)


def test_the_changelog_is_headed_by_the_version() -> None:
    version = re.findall(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.M)
    first = re.search(r"^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert first is not None
    assert version == [first[1]]
