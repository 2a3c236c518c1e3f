"""What is freed stays for what comes next, but for a large program."""

import subprocess
import sys
from pathlib import Path

import pytest

from magfusion.estimation.solve import memory

# Arrays of 16 MB are made, six at a time, and freed; of the last times page faults are counted.
FAULTS = """
import resource
import numpy as np
from magfusion.estimation.solve.memory import keep_memory
{keep}
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def make():
    [np.ones(2_000_000) for _ in range(6)]
make()
make()
before = faults()
make()
make()
print(faults() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="it is glibc that is told")
def test_an_array_takes_the_pages_of_one_that_was_freed() -> None:
    def counted(keep: str) -> int:
        command = [sys.executable, "-c", FAULTS.format(keep=keep)]
        return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)

    usual, kept = counted(""), counted("keep_memory()")
    assert kept < 20  # of 12 arrays
    assert usual > 10 * max(kept, 1)


def test_only_a_large_program_gives_back_what_it_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[str] = []

    def of_glibc(name: str) -> object:
        return lambda _: requested.append(name)

    monkeypatch.setattr(memory, "_of_glibc", of_glibc)
    monkeypatch.setattr(memory, "RESIDENT", 1e15)
    memory.give_back_memory()
    assert requested == []
    monkeypatch.setattr(memory, "RESIDENT", 1e6)
    memory.give_back_memory()
    assert requested == ["malloc_trim"]


def test_a_system_that_tells_nothing_is_given_everything_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    requested: list[str] = []
    monkeypatch.setattr(memory, "_of_glibc", lambda name: lambda _: requested.append(name))
    monkeypatch.setattr(memory, "PAGES", tmp_path / "none")
    memory.give_back_memory()
    assert requested == ["malloc_trim"]
