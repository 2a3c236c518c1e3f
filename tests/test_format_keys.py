"""Every key that a site may have is in the documentation, and is checked."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from magfusion.files.site_schema import SiteEntry
from magfusion.files.yaml_files import StrictModel

DOCS = Path(__file__).parents[1] / "docs"
PAGE = "".join((DOCS / name).read_text() for name in ("formats.md", "aiding.md"))
PAGE = re.sub(r"^```\w*$", "`", PAGE, flags=re.M)  # a block is quoted as a whole
VERSION = "magfusion_site"  # of the file itself, which the first page shows


def _models(annotation: Any) -> Iterator[type[StrictModel]]:
    """Yield the models that an annotation holds, however deep."""
    if isinstance(annotation, type) and issubclass(annotation, StrictModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)


def _keys(model: type[StrictModel], seen: set[type[StrictModel]]) -> Iterator[tuple[Any, str]]:
    if model in seen:
        return
    seen.add(model)
    for name, field in model.model_fields.items():
        yield model, name
        for part in _models(field.annotation):
            yield from _keys(part, seen)


KEYS = list(_keys(SiteEntry, set()))


def test_all_parts_of_a_site_are_found() -> None:
    parts = {model.__name__ for model, _ in KEYS}
    assert {"WindingEntry", "RegionEntry", "MotionPriorEntry", "MomentTemperatureEntry"} <= parts


def test_every_key_is_documented() -> None:
    reported = " ".join(re.findall(r"`[^`]+`", PAGE)) + " ".join(re.findall(r"^### .*", PAGE, re.M))
    missing = [
        f"{model.__name__}.{name}"
        for model, name in KEYS
        if name != VERSION and not re.search(rf"\b{name}\b", reported)
    ]
    assert not missing


def test_no_key_takes_anything() -> None:
    selected = [
        f"{model.__name__}.{name}" for model, name in KEYS if not _refuses(model, name, object())
    ]
    assert not selected


def _refuses(model: type[StrictModel], name: str, value: object) -> bool:
    """Tell whether a model refuses a value of a key, by its name."""
    try:
        model.model_validate({name: value})
    except ValidationError as error:
        return name in {one["loc"][0] for one in error.errors() if one["loc"]}
    return False


def test_what_is_no_key_is_refused() -> None:
    models = dict.fromkeys(model for model, _ in KEYS)
    taking = [model.__name__ for model in models if not _refuses(model, "no_such_key", 1)]
    assert not taking
