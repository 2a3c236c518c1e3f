"""YAML files, validated against a model."""

import re
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core.core_schema import ErrorType

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file

MAX_YAML = 1 << 20  # bytes

Model = TypeVar("Model", bound=BaseModel)


class StrictModel(BaseModel):
    """Refuses unknown keys, converts nothing, and takes finite numbers only."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


def read_yaml(path: Path, model: type[Model]) -> Model:
    """Read a YAML file and check it against a model.

    Raises InputError where the file cannot be read, is larger than a file written by hand can be,
    is not one YAML mapping of plain values, repeats a key, or does not fit the model.
    """
    content = _parse(_text(path), path)
    if not isinstance(content, dict):
        keys = ", ".join(model.model_fields)
        raise InputError(
            f"{path}: found {_shortened(content)} at the top; write a mapping with the keys {keys}."
        )
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {sentence(error, model)}") from None


def write_yaml(content: dict[str, Any], path: Path) -> None:
    """Write plain values as YAML, keys in their order, innermost collections on one line."""
    text = yaml.dump(
        content,
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=100,
    )
    with whole_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 - the base class's signature
        return True


class _Loader(yaml.SafeLoader):
    """Safe loading that reads ``1e-5`` as a number; no repeated keys, aliases or tags."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            self._refuse("aliases are not accepted")
        if getattr(self.current_event, "tag", None) is not None:
            self._refuse("tags are not accepted")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                problem = f"key {_shortened(key.value)} is repeated"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def _refuse(self, problem: str) -> None:
        mark = self.current_event.start_mark
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


# YAML 1.1, which PyYAML follows, takes 1e-5 for text; YAML 1.2 and every engineer for a number.
for _end in (_Loader, _Dumper):
    _end.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+\Z", re.ASCII),
        list("-+.0123456789"),
    )


def _text(path: Path) -> str:
    if not path.is_file():
        result = "is a directory" if path.is_dir() else "there is no such file"
        raise InputError(f"{path}: {result}; give the path of a YAML file.")
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_YAML + 1)
        text = content.decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); allow it.") from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8 text."
        ) from error
    if len(content) > MAX_YAML:
        raise InputError(
            f"{path}: is larger than {MAX_YAML} bytes; give a YAML file written for magfusion."
        )
    return text


@lru_cache(maxsize=2)
def _parse(text: str, path: Path) -> object:
    """Return the content of a text, cached, as a site is read more than once."""
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}: " if mark else ""
        raise InputError(f"{path}: {line}{error.problem}; correct the YAML.") from error
    except yaml.YAMLError as error:
        raise InputError(f"{path}: {str(error).splitlines()[0]}; correct the YAML.") from error
    except (ValueError, OverflowError) as error:  # matches the pattern of a date or number
        reason = str(error).split(";")[0]
        raise InputError(f"{path}: {reason}; correct the value.") from error
    except RecursionError as error:
        raise InputError(f"{path}: is nested too deeply; write the keys plainly.") from error


# By the type of an error; the words of pydantic are of its own types, not of a file's.
_REMEDIES = {
    "bool_type": "write true or false",
    "dict_type": "write a mapping",
    "finite_number": "write a finite number",
    "float_type": "write a number",
    "greater_than": "write a number greater than {gt}",
    "greater_than_equal": "write a number greater than or equal to {ge}",
    "int_from_float": "write an integer",
    "int_type": "write an integer",
    "less_than": "write a number less than {lt}",
    "less_than_equal": "write a number less than or equal to {le}",
    "list_type": "write a list",
    "model_attributes_type": "write a mapping",
    "literal_error": "write {expected}",
    "string_pattern_mismatch": "write text of the form {pattern}",
    "string_too_short": "write at least {min_length} characters",
    "string_type": "write text",
    "too_long": "write at most {max_length} entries",
    "too_short": "write at least {min_length} entries",
    "union_tag_invalid": "give for {discriminator} one of {expected_tags}",
    "union_tag_not_found": "add {discriminator}",
}
_PYDANTIC = frozenset(get_args(ErrorType))


def sentence(error: ValidationError, model: type[BaseModel], whole: str = "file") -> str:
    """Return what is wrong, and the remedy, of content that does not fit its model."""
    # An unknown key is, as a rule, a misspelt one that is reported as missing, too.
    every = sorted(
        error.errors(include_url=False), key=lambda one: one["type"] != "extra_forbidden"
    )
    first, others = every[0], len(every) - 1
    named, within = _followed(model, first["loc"])
    place = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in named).lstrip(".")
    code = first["type"]
    if code == "missing":
        what = "is missing; add it"
    elif code == "extra_forbidden":
        accepted = ", ".join(within.model_fields)
        what = f"is not a known key; remove it or write one of {accepted}"
    elif code == "json_invalid":
        reason = str(first["ctx"]["error"])
        what = f"found {_shortened(first['input'])}; write valid JSON ({reason})"
    elif code == "model_type":
        accepted = ", ".join(within.model_fields)
        what = f"found {_shortened(first['input'])}; write a mapping with the keys {accepted}"
    else:
        # The messages of validators of this package are whole sentences.
        remedy = _REMEDIES.get(code, "correct it") if code in _PYDANTIC else first["msg"]
        remedy = remedy.format_map(first.get("ctx", {})) if code in _REMEDIES else remedy
        what = f"found {_shortened(first['input'])}; {remedy}"
    more = f" (and {others} more in this {whole})" if others else ""
    return f"{place}: {what}{more}." if place else f"{what}{more}."


def _followed(
    model: type[BaseModel], place: tuple[int | str, ...]
) -> tuple[list[int | str], type[BaseModel]]:
    """Return a place in a file, without what only a model has, and the model there."""
    named, among = list[int | str](), [model]
    for part in place:
        tagged = [m for m in among if len(among) > 1 and part in _tags(m)]
        if part in among[0].model_fields:
            among = _models_in(among[0].model_fields[str(part)].annotation) or among[:1]
        elif tagged:
            among = tagged
            continue
        if part != "[key]":
            named.append(part)
    return named, among[0]


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    """Return the values of the key that distinguishes a model from others in the same place."""
    tag = model.model_fields.get("quantity")
    return () if tag is None else get_args(tag.annotation)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [model for part in get_args(annotation) for model in _models_in(part)]


def _shortened(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
