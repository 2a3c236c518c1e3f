"""The command line: one command per job, with options from the fields of the job's settings."""

import errno
import gc
import inspect
import json
import os
import re
import shlex
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn

import typer
from typer.core import TyperGroup
from typer.main import get_command

from magfusion.errors import EstimationError, InputError, InputErrors
from magfusion.estimation.solve.memory import keep_memory
from magfusion.files.blas_threads import use_one_thread
from magfusion.files.standard_streams import binary_output, occupy_closed, until_closed
from magfusion.jobs import GROUPS, JOBS
from magfusion.jobs.settings import Command, Settings, options
from magfusion.jobs.typer_options import LEVELS, Level, parameters, plain, typed_value
from magfusion.model.progress import Report, quiet
from magfusion.results.figures import Figures
from magfusion.results.provenance import Run, recorded_as

DEBUG = "--debug"
TERMINATED = (
    "terminated, and unfinished files are removed; repeat the command, with --resume where it had a"
    " checkpoint"
)
MAX_REASON = 200  # characters, of an error that was not foreseen
_HELP = {"help_option_names": ["-h", "--help"]}


class _Terminated(BaseException):
    """SIGTERM ended the process."""


class Invocation(NamedTuple):
    """The command line, and whether the process runs it alone."""

    words: list[str]
    is_process: bool


def main(arguments: list[str] | None = None) -> None:
    """Run the command line.

    Exits with 0 and the result; with 2 and one sentence for bad input or usage; with 1 and one
    sentence for a failed estimator or an internal error; with 130 if interrupted by the user, with
    143 and one sentence by SIGTERM.  ``--debug``, anywhere, shows the traceback of any of them.
    """
    given = sys.argv[1:] if arguments is None else arguments
    debug, status = DEBUG in given, 0
    given = [part for part in given if part != DEBUG]
    if arguments is None and not debug:
        warnings.simplefilter("ignore")  # a library's warnings are no sentence of ours
    occupy_closed()
    try:
        if arguments is None:
            use_one_thread()
            keep_memory()
        with _terminated_as_interrupted(), until_closed():
            status = application()(
                args=given or ["--help"],
                prog_name="magfusion",
                standalone_mode=False,
                obj=Invocation(given, is_process=arguments is None),
            )
    except _Terminated:
        _fail(143, TERMINATED)
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except Exception as error:
        if debug:
            traceback.print_exc()
        status, sentence = _error_report(error)
        _fail(status, sentence, isinstance(error, InputErrors))
    raise SystemExit(status)


def _without_pydantic(message: str) -> str:
    """Return the message of Typer on a value, whose checks are pydantic's, as an instruction."""
    message = message.replace(": Value error, ", ": ")
    return re.sub(r"Input should be (.+?)(, unable to parse .*)?$", r"write \1", message)


def _error_report(error: Exception) -> tuple[int, str]:
    """Return exit code and message of a command's exception."""
    if isinstance(error, typer.TyperException):
        context = getattr(error, "ctx", None)
        command = "magfusion" if context is None else context.command_path
        return 2, f"{_without_pydantic(error.format_message()).rstrip('.')}; see {command} --help"
    if isinstance(error, InputError):
        return 2, str(error)
    if isinstance(error, EstimationError):
        return 1, str(error)
    if isinstance(error, OSError):
        return 2, _file_refusal(error)
    if isinstance(error, MemoryError):
        return 2, "not enough memory; use a shorter part, with --start and --end"
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:MAX_REASON]
    where = traceback.extract_tb(error.__traceback__)[-1]
    return 1, (
        f"internal error ({reason}; {Path(where.filename).name}, line"
        f" {where.lineno}); please report it to the maintainers of magfusion, with the"
        f" command, its input, and its output with {DEBUG}"
    )


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM end a command as Ctrl-C does: unfinished files are removed."""

    def end(*_: object) -> NoReturn:
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, former)


def _file_refusal(error: OSError) -> str:
    # Errors on files have a name; those without are of pipes.
    place = error.filename if error.filename is not None else "standard input or output"
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "free some space" if full else "allow it, or give another path"
    return f"{place}: cannot be read or written ({error.strerror or error}); {remedy}"


def _fail(status: int, sentence: str, in_lines: bool = False) -> NoReturn:
    lines = sentence.splitlines() if in_lines else [" ".join(sentence.split())]
    sys.stderr.write("magfusion: {}\n".format("\n".join(lines)))
    raise SystemExit(status) from None


class _Jobs(TyperGroup):
    """Commands of which only name and help are loaded until one is requested."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command, generated from its job's module."""
        name, listed, rest = super().resolve_command(ctx, args)
        path = name if ctx.parent is None else f"{ctx.info_name} {name}"
        return name, _command(path) if path in JOBS else listed, rest


def application() -> typer.Typer:
    """Return the application: a command for each of `JOBS`."""
    app = typer.Typer(
        cls=_Jobs,
        help="Navigation from magnetic beacons and inertial sensors where there is no GNSS.",
        epilog=_example("magfusion demo"),
        context_settings=_HELP,
        pretty_exceptions_enable=False,
    )
    app.callback()(_options)
    groups = {
        name: typer.Typer(
            cls=_Jobs,
            help=text,
            epilog=_example(f"magfusion {name} {first} --help"),
            context_settings=_HELP,
        )
        for name, text in GROUPS.items()
        for first in [next(path.split()[1] for path in JOBS if path.startswith(f"{name} "))]
    }
    for path, (_, text) in JOBS.items():
        group, _, name = path.rpartition(" ")
        (groups[group] if group else app).command(name, help=text)(lambda: None)
    for name, commands in groups.items():
        app.add_typer(commands, name=name)
    return app


def _command(path: str) -> Any:
    """Return the command of a job, with all its options."""
    module, text = JOBS[path]
    name = path.split()[-1]
    only = typer.Typer(add_completion=False)
    command: Command = import_module(f"magfusion.jobs.{module}").COMMAND
    epilog = _example(command.example)
    only.command(name, help=text, epilog=epilog, context_settings=_HELP)(_callback(path, command))
    return get_command(only)


def _example(command: str) -> str:
    """Return the last paragraph of a help text."""
    return plain(f"Example: {command}")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        from magfusion.files.commit import commit

        known = commit()
        sys.stdout.write(
            f"magfusion {version('magfusion')}{f' (commit {known})' if known else ''}\n"
        )
        raise typer.Exit


def _options(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print version and commit."
        ),
    ] = False,
    _debug: Annotated[
        bool, typer.Option(DEBUG, help="Show where an error came from, in any command.")
    ] = False,
) -> None:
    """Navigate by magnetic beacons and inertial sensors where there is no GNSS."""


def _callback(path: str, command: Command) -> Callable[..., None]:
    """Return the function of a command, with parameters from which typer generates its options."""
    wanted = inspect.signature(command.run).parameters
    requested = {field.name: option for field, option in options(command.settings)}

    def run(context: typer.Context, **values: Any) -> None:
        output = values.pop("output", None)
        level = _level(values) if command.reports else "brief"
        values.pop("overwrite", None)
        if level == "json":
            binary_output()
        own = {field: typed_value(requested[field], value) for field, value in values.items()}
        settings = command.settings(**own)
        if output is None and "output" in wanted and not command.output_optional:
            # A log's name as given by the user, also for ".".
            log = Path(os.path.realpath(own["log"])).name if "log" in own else ""
            log += f"_and_{len(own['more'])}_more" if own.get("more") else ""
            output = Path(command.output or f"{log}_{path.split()[-1].replace('-', '_')}")
        earlier = _stamp(output)
        given = _given(context)
        with _progress(level == "quiet") as report, recorded_as(_run(context, settings, given)):
            if context.obj.is_process:
                gc.freeze()  # what was imported is no garbage, and not looked through again
            offered = {"output": output, "report": report, "given": given}
            try:
                figures = command.run(settings, **{k: v for k, v in offered.items() if k in wanted})
            except EstimationError as error:
                if output is not None:
                    from magfusion.jobs.failure import failed_figures

                    log = Path(next((v for v in own.values() if isinstance(v, Path)), output)).stem
                    _show_failed(
                        failed_figures(path, log, output, error, _stamp(output) != earlier), level
                    )
                raise
        if figures is not None:
            _show_result(figures, output, level)
            if command.fails:
                _refuse_failed(figures)
        if command.after is not None:
            command.after(settings, output)

    generated = parameters(command, "output" in wanted)
    run.__signature__ = inspect.Signature(generated)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in generated}
    return run


def _level(values: dict[str, Any]) -> Level:
    """Return the requested level of output, and remove its options from the values."""
    given: list[Level] = [level for level in LEVELS if values.pop(level, False)]
    if len(given) > 1:
        raise InputError(f"--{given[0]} and --{given[1]}: give one of them")
    return given[0] if given else "brief"


def _given(context: typer.Context) -> set[str]:
    """Return the fields given by the user, rather than left at their defaults."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in sources.items() if source and source.name == "COMMANDLINE"}


def _run(context: typer.Context, settings: Settings, given: set[str]) -> Run:
    """Return the provenance for a page."""
    values = {field.name: getattr(settings, field.name) for field, _ in options(type(settings))}
    paths = [p for v in values.values() for p in (v if isinstance(v, tuple) else (v,))]
    return Run(
        shlex.join(["magfusion", *context.obj.words]),
        values,
        frozenset(given),
        tuple(path for path in paths if isinstance(path, Path) and path.exists()),
        context.params.get("overwrite", False),
    )


@contextmanager
def _progress(silent: bool) -> Iterator[Report]:
    """Yield a progress reporter: a bar on a terminal, nothing otherwise."""
    if silent or not sys.stderr.isatty():
        yield quiet
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)

    def report(stage: str, done: int, total: int) -> None:
        if not bar.tasks:
            bar.add_task(stage)
            bar.start()
        bar.update(bar.tasks[0].id, description=stage, completed=done, total=total)

    try:
        yield report
    finally:
        bar.stop()


def _stamp(output: Path | None) -> int | None:
    """Return when a report was written; None where there is none."""
    report = Path() if output is None else output / "report.json"
    return report.stat().st_mtime_ns if report.is_file() else None


def _show_failed(figures: Figures | None, level: Level) -> None:
    if figures is not None:
        _show_result(figures, None, level)


def _refuse_failed(figures: Figures) -> None:
    """End with the first reason where a displayed verdict is failed."""
    reasons = figures.get("reasons")
    if figures.get("verdict") == "failed" and isinstance(reasons, list):
        first = reasons[0]
        raise EstimationError(f"failed: {first['text'] if isinstance(first, dict) else first}")


def _show_result(figures: Figures, output: Path | None, level: Level) -> None:
    """Show the figures of a job as tables, or as one line of JSON if requested."""
    if sys.stdout is None:
        return
    with until_closed():
        if level == "json":
            sys.stdout.write(json.dumps(dict(figures), default=float) + "\n")
            return
        from magfusion.results.screen import show

        show(figures, output, level=level)
