"""The program runs without pandas, which pyarrow imports with its first array where it finds it.

It only asks whether what it was given is a Series, and nothing here is one; that alone was a tenth
of a second or more of every start.  It is kept from the program, and not from who imports the
package.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

ABSENT = "pandas"


class _Absent(MetaPathFinder):
    """Says of one package that it is not installed."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Refuse this package; of others others know."""
        del path, target
        if fullname == ABSENT:
            raise ModuleNotFoundError(f"No module named {ABSENT!r}", name=ABSENT)
        return None


@contextmanager
def without_pandas() -> Iterator[None]:
    """Let pandas be as if it were not installed, if it was not imported yet."""
    finder = _Absent()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
