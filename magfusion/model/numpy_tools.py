"""NumPy's tools for developers, imported when somebody asks them and not by whoever lists NumPy.

SciPy copies all that NumPy has into a namespace of its own, and so imports NumPy's wrapper of
Fortran, its help for tests and what these bring: a twentieth of every start that nothing here uses.
"""

from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

TOOLS = ("ctypeslib", "f2py", "testing")


class _Later(ModuleType):
    """A module that is imported when it is asked for anything."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)


def import_tools_later() -> None:
    """Let NumPy's tools wait until they are asked, those that are not there yet."""
    for name in TOOLS:
        if name not in vars(np):
            setattr(np, name, _Later(f"{np.__name__}.{name}"))
