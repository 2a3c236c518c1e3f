"""The example notebooks run as they stand, and have the outputs of a run without its machine."""

import json
import os
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_in_the_contents_with_outputs_of_no_machine(path: Path) -> None:
    assert f": notebooks/{path.name}\n" in (ROOT / "mkdocs.yml").read_text()
    text = path.read_text(encoding="utf-8")
    assert len(text) < 300_000
    cells = json.loads(text)["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert any(cell["outputs"] for cell in code)
    for cell in code:
        assert cell["metadata"] == {}
        for output in cell["outputs"]:
            assert output["output_type"] != "error"
            shown = json.dumps([output.get("text"), *output.get("data", {}).get("text/plain", [])])
            assert not re.search(r"(/tmp|/home|/root|/Users)/|\\u001b|\\r", shown)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own libraries
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbformat, nbclient = (pytest.importorskip(name) for name in ("nbformat", "nbclient"))
    monkeypatch.setenv(
        "PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    )
    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(notebook, timeout=120, resources=place)
    client.execute()
    shell = [cell for cell in notebook.cells if "!magfusion" in cell.source]
    assert shell
    for cell in shell:  # a command that fails does not stop a notebook
        findings = "".join(output.get("text", "") for output in cell.outputs)
        assert "results in" in findings, findings
