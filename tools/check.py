"""Check the tree: format, lint, types, floors, words, tests.

``python tools/check.py`` before every commit; ``--no-tests`` where the suite has just run.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STATIC = {
    "format": ["ruff", "format", "--check", "."],
    "lint": ["ruff", "check", "."],
    "types": ["mypy"],
    "floors": ["pytest", "-q", "tests/test_structure.py"],
    "words": ["pytest", "-q", "tests/test_words.py"],
}
TESTS = {"tests": ["pytest", "-q"]}


def run_check(name: str, command: list[str]) -> bool:
    """Run one check; show its output only where it fails."""
    started = time.monotonic()
    process = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    passed = process.returncode == 0
    if not passed:
        print(process.stdout + process.stderr)
    print(f"{name:<8}{'ok' if passed else 'FAILED':<8}{time.monotonic() - started:6.1f} s")
    return passed


def main() -> int:
    """Run all checks, also after one has failed, and return 1 where one did."""
    parser = argparse.ArgumentParser(
        description="Check format, lint, types, floors, words and tests."
    )
    parser.add_argument("--no-tests", action="store_true", help="leave the test suite out")
    checks = STATIC if parser.parse_args().no_tests else STATIC | TESTS
    failed = [name for name, command in checks.items() if not run_check(name, command)]
    print(f"failed: {', '.join(failed)}" if failed else "all checks passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
