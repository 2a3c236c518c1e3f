"""The face: one command a job, no logic."""

import errno
import sys
from typing import NoReturn

import typer

from magfusion.cli import (
    calibrate_commands,
    drift_commands,
    log_commands,
    match_commands,
    online_commands,
    plan_commands,
    result_commands,
)
from magfusion.cli.app import app
from magfusion.errors import EstimationError, InputError

COMMANDS = (
    calibrate_commands,
    drift_commands,
    log_commands,
    match_commands,
    online_commands,
    plan_commands,
    result_commands,
)  # imported, they are registered


def main(arguments: list[str] | None = None) -> None:
    """Run the command line.

    Exits with 0 and the result; with 2 and one sentence for bad input or usage; with 1 and one
    sentence for an estimator that failed; with 130 where the user interrupted.
    """
    given = sys.argv[1:] if arguments is None else arguments
    try:
        status = app(args=given or ["--help"], prog_name="magfusion", standalone_mode=False)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        command = "magfusion" if context is None else context.command_path
        _fail(2, f"{error.format_message().rstrip('.')}; see {command} --help")
    except InputError as error:
        _fail(2, str(error))
    except EstimationError as error:
        _fail(1, str(error))
    except OSError as error:
        _fail(2, _told(error))
    except MemoryError:
        _fail(2, "the memory does not suffice; use a shorter part, by --start and --end")
    raise SystemExit(status)


def _told(error: OSError) -> str:
    place = error.filename if error.filename is not None else "a file"
    remedy = "free some space" if error.errno == errno.ENOSPC else "allow it, or give another path"
    return f"{place}: cannot be read or written ({error.strerror or error}); {remedy}"


def _fail(status: int, sentence: str) -> NoReturn:
    sys.stderr.write(f"magfusion: {' '.join(sentence.split())}\n")
    raise SystemExit(status) from None
