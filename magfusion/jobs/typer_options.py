"""Options of a command, as Typer generates them, from the fields of a job's settings."""

import inspect
from dataclasses import MISSING, Field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import typer

from magfusion.jobs.settings import OVERWRITE, Command, Option, options

Level = Literal["json", "quiet", "brief", "verbose"]
# Options of how much is printed, by the level that they select.
LEVELS: dict[Level, tuple[tuple[str, ...], str]] = {
    "verbose": (("--verbose", "-v"), "Print all figures, with the calibration."),
    "quiet": (("--quiet", "-q"), "Print the verdict only, and no progress."),
    "json": (("--json",), "Print the report as a line of JSON, and nothing else."),
}
_NAMED_BY_LOG = "; default: the log's name and the job's"
_NOT_WRITTEN = "; default: nothing is written"


def plain(text: str) -> str:
    """Return a text in which brackets are no markup."""
    return text.replace("[", r"\[")


def parameters(command: Command, writes: bool) -> list[inspect.Parameter]:
    """Return the parameters of a command's function, from which Typer makes its options.

    `writes`: whether it has an output.
    """
    hints = get_type_hints(command.settings)
    result = [_parameter(f, option, hints[f.name]) for f, option in options(command.settings)]
    if writes:
        note = "" if command.output or command.output_required else _NAMED_BY_LOG
        note = _NOT_WRITTEN if command.output_optional else note
        info = typer.Option("--output", "-o", help=f"{command.output_help}{note}.")
        default: Any = Path(command.output) if command.output else None
        if command.output_required:
            default = inspect.Parameter.empty
        hint: Any = Path | None if default is None else Path
        output = _keyword("output", Annotated[hint, info], default)
        result.insert(0, output)
        if not command.output_file:
            flag = typer.Option("--overwrite", help=f"{OVERWRITE}.")
            result.append(_keyword("overwrite", Annotated[bool, flag], False))
    result.insert(0, _keyword("context", typer.Context))
    if command.reports:
        result += [
            _keyword(name, Annotated[bool, typer.Option(*flags, help=text)], False)
            for name, (flags, text) in LEVELS.items()
        ]
    return result


def _parameter(field: Field[Any], option: Option, hint: Any) -> inspect.Parameter:
    """Return the argument or option of typer for a field."""
    default = field.default
    if option.words is not None:
        hint = Literal[tuple(option.words)]
        default = next((w for w, value in option.words.items() if value == default), default)
    elif hint in (tuple[str, ...], tuple[Path, ...]):
        hint, default = (list[str] if str in get_args(hint) else list[Path]), []
    if default is None:
        hint = hint | None
    if option.positional:
        info = typer.Argument(help=plain(option.sentence))
    else:
        name = option.name or field.name.replace("_", "-")
        switch = f"--{name}/--no-{name}" if default is True else f"--{name}"
        info = typer.Option(switch, help=plain(option.sentence), metavar=option.metavar)
    default = inspect.Parameter.empty if default is MISSING else default
    return _keyword(field.name, Annotated[hint, info], default)


def _keyword(
    name: str, annotation: Any, default: Any = inspect.Parameter.empty
) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=default, annotation=annotation)


def typed_value(option: Option, typed: Any) -> Any:
    """Return the value of a field for typed text."""
    if option.words is not None:
        return option.words.get(typed)
    return tuple(typed) if isinstance(typed, list) else typed
