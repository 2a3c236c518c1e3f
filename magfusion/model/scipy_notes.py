"""SciPy's notes on other array libraries, stacks of matrices and what is deprecated.

It adds them to its documentation when imported.  For that it parses and prints four hundred
docstrings: a twentieth of every start that no command shows to anybody.
"""

import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any

ARRAYS = "scipy._lib._array_api"
NOTING = (ARRAYS, "scipy._lib._util", "scipy._lib.deprecation")


class _AsWritten:
    """A docstring to which whatever is noted makes no difference."""

    def __init__(self, of: Callable[..., Any]) -> None:
        self._of = of

    def __getitem__(self, section: str) -> list[str]:
        return []

    def __setitem__(self, section: str, lines: list[str]) -> None:
        return

    def __str__(self) -> str:
        return f"\n{self._of.__doc__ or ''}"  # a signature comes first


def leave_notes_out() -> None:
    """Let SciPy's docstrings be as they were written, unless SciPy is already imported."""
    if ARRAYS in sys.modules:
        return
    try:
        import scipy._lib._docscrape as docstrings
    except ImportError:  # all these are SciPy's own, and may be elsewhere in another SciPy
        return
    known = getattr(docstrings, "FunctionDoc", None)
    if known is None:
        return
    docstrings.FunctionDoc = _AsWritten
    try:
        for module in NOTING:
            with suppress(ImportError):
                import_module(module)
    finally:
        docstrings.FunctionDoc = known
