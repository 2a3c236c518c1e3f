"""Run the notebooks of the documentation, and keep their outputs: docs/notebooks/*.ipynb.

``python tools/docs_notebooks.py [NAME ...]``
"""

import argparse
import os
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import nbclient
import nbformat

_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|[^\n]*\r(?!\n)|[^\n]*━[^\n]*\n|\r")  # and progress
DIRECTORY = Path(__file__).resolve().parents[1] / "docs" / "notebooks"


def execute(path: Path) -> None:
    """Run a notebook in a directory of its own; write it with outputs, without times and paths."""
    notebook = nbformat.read(path, as_version=4)
    kept = dict(notebook.metadata)
    with TemporaryDirectory() as place:
        resources = {"metadata": {"path": place}}
        client = nbclient.NotebookClient(
            notebook, timeout=600, resources=resources, coalesce_streams=True
        )
        client.execute()
    notebook.metadata = nbformat.from_dict(kept)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", []):
            if "text" in output:
                output.text = _CONTROL.sub("", output.text).replace(place + os.sep, "")
    nbformat.write(notebook, path)


def main() -> None:
    """Run those that are named, or all."""
    names = sorted(path.stem for path in DIRECTORY.glob("*.ipynb"))
    parser = argparse.ArgumentParser(description="Run the notebooks of the documentation.")
    parser.add_argument("names", nargs="*", choices=[*names, []])
    os.environ |= {"TERM": "dumb", "COLUMNS": "100"}  # no progress is drawn
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for name in parser.parse_args().names or names:
        execute(DIRECTORY / f"{name}.ipynb")
        print(name, flush=True)


if __name__ == "__main__":
    main()
