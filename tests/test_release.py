"""What is built holds the package whole and its commit, and the project's files agree."""

import importlib.util
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from hatchling.metadata.core import ProjectMetadata
from hatchling.plugin.manager import PluginManager
from lowest import lowest

from magfusion.files.commit import commit

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def _build_hook() -> ModuleType:
    """Return the build's own module, which is not installed."""
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


HOOK = _build_hook()


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
    reported = _git("rev-parse", "HEAD").strip()
    known = commit()
    assert known is not None
    assert reported.startswith(known.removesuffix("-dirty"))


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
    reported = []
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as archive:
            names = set(archive.namelist())
            reported.append(archive.read("magfusion/commit.txt").decode())
        assert tracked <= names
        assert not {name.split("/")[0] for name in names} - {"magfusion", _metadata(wheel)}
    assert reported[0] == reported[1]
    assert _git("rev-parse", "HEAD").startswith(reported[0].strip().removesuffix("-dirty"))


def test_every_python_that_the_package_accepts_is_tried() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    tried = workflow["jobs"]["suite"]["strategy"]["matrix"]["python"]
    assert tried == ["3.11", "3.12", "3.13", "3.14"]
    assert PROJECT["requires-python"] == f">={tried[0]}"
    named = [text.rpartition(" ")[2] for text in PROJECT["classifiers"] if ":: 3." in text]
    assert named == tried
    steps = workflow["jobs"]["lowest-dependencies"]["steps"]
    assert any("tools/lowest.py" in step.get("run", "") for step in steps)


def test_every_dependency_has_a_lower_bound_and_one_alone() -> None:
    pins = lowest(PROJECT)
    names = [pin.partition("==")[0] for pin in pins]
    assert {"numpy", "scipy", "rerun-sdk", "distributed", "pytest"} <= set(names)
    assert len(names) == len(set(names))
    with pytest.raises(ValueError, match="numpy: no lower bound"):
        lowest({"dependencies": ["numpy"], "optional-dependencies": {}})


def test_the_changelog_is_headed_by_the_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text()
    first = re.search(r"^## \[(\S+)\] - (unreleased|\d{4}-\d\d-\d\d)$", text, re.M)
    assert first is not None
    assert first[1] == PROJECT["version"]
    kinds = set(re.findall(r"^### (.+)$", text, re.M))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_the_citation_agrees_with_the_package() -> None:
    """Keys and values by the schema of CFF 1.2.0, as far as they are used."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    for key in ("version", "license", "keywords", "authors"):
        assert citation[key] == PROJECT[key]


def test_a_bug_report_asks_for_what_explains_it() -> None:
    forms = {
        path.stem: yaml.safe_load(path.read_text())
        for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")
    }
    assert set(forms) == {"bug_report", "feature_request"}
    for form in forms.values():
        assert {"name", "description", "body"} <= set(form)
        fields = [field for field in form["body"] if field["type"] != "markdown"]
        assert len({field["id"] for field in fields}) == len(fields) > 0
    requested = str(forms["bug_report"])
    assert all(
        what in requested for what in ("report.json", "magfusion --version", "magfusion check")
    )


def test_the_readme_of_a_package_index_has_absolute_links() -> None:
    relative = [link[2] for link in HOOK.RELATIVE_LINK.findall(README)]
    assert {".github/readme.webp", "docs/measured.md", "LICENSE"} <= set(relative)
    shown = HOOK.absolute_links(README, "https://example.org/magfusion/", "v0.1.0")
    assert not HOOK.RELATIVE_LINK.search(shown)
    assert "](https://example.org/magfusion/raw/v0.1.0/.github/readme.webp)" in shown
    assert "](https://example.org/magfusion/blob/v0.1.0/docs/formats.md#the-log)" in shown
    assert shown.count("https://example.org") == len(relative)


def test_without_a_repository_no_link_leads_nowhere() -> None:
    shown = HOOK.absolute_links(
        "![a walk](walk.png), [more](docs/x.md), [GTSAM](https://gtsam.org)", None, ""
    )
    assert shown == "*a walk*, more, [GTSAM](https://gtsam.org)"


def test_the_metadata_have_the_readme_with_its_links() -> None:
    metadata = ProjectMetadata(str(ROOT), PluginManager())
    repository = PROJECT.get("urls", {}).get("Repository")
    assert metadata.core.readme_content_type == "text/markdown"
    assert metadata.core.readme == HOOK.absolute_links(README, repository, f"v{PROJECT['version']}")
    assert not HOOK.RELATIVE_LINK.search(metadata.core.readme)
