"""Malformed inputs through the real command line: what breaks is stored.

    python tools/fuzz.py --examples 10000
    python tools/fuzz.py --seconds 180 --seed 7

A case is plain data: which input, what is changed in it, and with which command it is read.
Batches of cases run in processes of their own, forked when everything is imported, with 2 GiB of
memory and two minutes a case.  A find is a traceback or the last net's sentence, more than one
sentence, another exit code than 0, 1 and 2, a hang, memory that did not suffice, something left
behind where the command was refused, or an input that was changed.  Needs ``hypothesis``.
"""

import argparse
import contextlib
import gc
import hashlib
import importlib
import io
import json
import os
import pkgutil
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzz_cases import Case, apply, strategy
from fuzz_inputs import example_inputs

import magfusion as package
from magfusion.cli import main as magfusion

MEMORY = 2 << 30  # bytes
MAX_DURATION = 120.0  # s; a busy machine takes a minute for what takes seconds
BATCH = 200  # cases a process
CORPUS = Path(__file__).parents[1] / "tests" / "fuzz_corpus"


@dataclass(frozen=True)
class Find:
    """A case that broke something, and what."""

    case: Case
    what: str


def run_case(case: Case, inputs: Path, place: Path) -> str | None:
    """Run one case in a directory of its own; return what is wrong, None where nothing is."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    command, given = apply(case, inputs, place)
    # What is written to may change.
    written = command[command.index("--checkpoint") + 1] if "--checkpoint" in command else ""
    before = _listing(place, written)
    out, err = io.TextIOWrapper(io.BytesIO(), "utf-8"), io.StringIO()
    source = io.TextIOWrapper(io.BytesIO(given), "utf-8")
    streams = sys.stdin
    status: object = None
    sys.stdin = source
    try:
        # What an output's name was changed to may be relative: it is then seen, and goes with all.
        with (
            contextlib.chdir(place),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            magfusion(command)
    except SystemExit as ended:
        status = ended.code or 0
    except MemoryError:
        raise  # nothing more can be done in this process
    except BaseException:
        return f"raised\n{traceback.format_exc()}"
    finally:
        sys.stdin = streams
    findings = err.getvalue()
    # A pipe names what it leaves out, an import all that is wrong.
    in_lines = command[:2] == ["navigate", "-"] or command[0] == "import"
    return _wrong(status, findings, _listing(place, written), before, passed=in_lines)


def _wrong(
    status: object, message: str, after: dict[str, bytes], before: dict[str, bytes], *, passed: bool
) -> str | None:
    if status not in (0, 1, 2):
        return f"exit {status}: {message}"
    if "internal error" in message or "Traceback" in message:
        return message
    if "not enough memory" in message:
        return f"memory: {message}"
    if status and not passed and (message.count("\n") != 1 or not message.startswith("magfusion")):
        return f"exit {status} with other than one sentence: {message!r}"
    changed = [name for name, digest in before.items() if after.get(name) != digest]
    if changed:
        return f"changed its input {changed}"
    remaining = sorted(set(after) - set(before))
    if status == 2 and remaining:
        return f"exit 2 and left {remaining}: {message}"
    if any(Path(name).name.startswith(".") for name in remaining):
        return f"left what is unfinished: {remaining}"
    return None


def _listing(place: Path, but: str) -> dict[str, bytes]:
    return {
        str(path.relative_to(place)): hashlib.sha256(path.read_bytes()).digest()
        for path in place.rglob("*")
        if path.is_file() and path.name != but
    }


def _batch(seed: int, count: int, inputs: Path, scratch: Path, until: float) -> None:
    """Run cases in this process, writing down each before it runs and what was wrong with it."""
    import hypothesis

    maximum = MEMORY + _reserved()
    resource.setrlimit(resource.RLIMIT_DATA, (maximum, maximum))
    warnings.simplefilter("ignore")
    gc.freeze()  # what all cases share is no garbage
    tempfile.tempdir = str(scratch)  # this process ends without tidying up
    log = (scratch / "log").open("a", buffering=1)

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(strategy())
    def each(case: Case) -> None:
        if time.monotonic() > until:
            return
        log.write(json.dumps({"began": time.monotonic(), "case": case}) + "\n")
        what = run_case(case, inputs, scratch / "place")
        log.write(json.dumps({"done": True, "what": what}) + "\n")

    each()


def _reserved() -> int:
    """Return what the libraries have reserved before any case (bytes), most of it never touched."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmData:")[1].split()[0])


def run_batch(
    seed: int, count: int, inputs: Path, scratch: Path, until: float
) -> tuple[int, list[Find]]:
    """Run cases in a process of their own; return how many ran, and the finds."""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    child = os.fork()
    if not child:
        try:
            _batch(seed, count, inputs, scratch, until)
            os._exit(0)
        except BaseException as error:
            with contextlib.suppress(BaseException):
                (scratch / "broken").write_text(f"{type(error).__name__}: {error}")
            os._exit(3)
    hung, ended = "", 0
    while True:
        done, ended = os.waitpid(child, os.WNOHANG)
        if done:
            break
        lines = _lines(scratch)
        if lines and "began" in lines[-1] and time.monotonic() - lines[-1]["began"] > MAX_DURATION:
            hung = f"hung for {MAX_DURATION:g} s"
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            break
        time.sleep(0.2)
    if (scratch / "broken").exists():
        hung = (scratch / "broken").read_text()
    return _message_of(_lines(scratch), hung or f"ended the process ({ended})")


def _message_of(lines: list[dict[str, Any]], otherwise: str) -> tuple[int, list[Find]]:
    finds, case, count = [], None, 0
    for line in lines:
        if "case" in line:
            case, count = line["case"], count + 1
        elif case is not None:
            if line["what"]:
                finds.append(Find(case, line["what"]))
            case = None
    if case is not None:
        finds.append(Find(case, otherwise))
    return count, finds


def _lines(scratch: Path) -> list[dict[str, Any]]:
    log = scratch / "log"
    result = log.read_text().splitlines(keepends=True) if log.exists() else []
    return [json.loads(line) for line in result if line.endswith("\n")]


def fuzz(examples: int, seconds: float, seed: int, workplace: Path) -> tuple[int, list[Find]]:
    """Run so many cases, or for so long, whichever ends first."""
    inputs = example_inputs(workplace / "inputs")
    for module in pkgutil.walk_packages(package.__path__, "magfusion."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)  # once, not in each process
    until, ran = time.monotonic() + seconds, 0
    finds: list[Find] = []
    while ran < examples and time.monotonic() < until:
        wanted = min(BATCH, examples - ran)
        count, result = run_batch(seed, wanted, inputs, workplace / "batch", until)
        ran, finds, seed = ran + max(count, 1), finds + result, seed + 1
        if sys.stderr.isatty() or result:
            sys.stderr.write(f"{ran} cases, {len(finds)} finds\n")
    return ran, finds


def main() -> int:
    """Fuzz as the command line requests; return the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--examples", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", action="store_true", help="add finds to the corpus")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        ran, finds = fuzz(chosen.examples, chosen.seconds, chosen.seed, Path(place))
    for find in finds:
        text = json.dumps(find.case, sort_keys=True)
        sys.stdout.write(f"{text}\n  {find.what}\n")
        if chosen.keep:
            CORPUS.mkdir(exist_ok=True)
            name = hashlib.sha256(text.encode()).hexdigest()[:12]
            (CORPUS / f"{name}.json").write_text(text + "\n")
    sys.stdout.write(f"{ran} cases, {len(finds)} finds\n")
    return min(len(finds), 1)


if __name__ == "__main__":
    sys.exit(main())
