"""Every key that a site may have is in the documentation, and is checked."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import ValidationError

from magfusion.files.site_schema import SiteEntry
from magfusion.files.yaml_files import StrictModel

PAGE = (Path(__file__).parents[1] / "docs" / "formats.md").read_text()
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
NAMES = [f"{model.__name__}.{name}" for model, name in KEYS]


def test_all_parts_of_a_site_are_found() -> None:
    parts = {model.__name__ for model, _ in KEYS}
    assert {"WindingEntry", "RegionEntry", "MotionPriorEntry", "WarmingEntry"} <= parts


@pytest.mark.parametrize(("model", "name"), KEYS, ids=NAMES)
def test_a_key_is_documented(model: type[StrictModel], name: str) -> None:
    told = " ".join(re.findall(r"`[^`]+`", PAGE)) + " ".join(re.findall(r"^### .*", PAGE, re.M))
    assert name == VERSION or re.search(rf"\b{name}\b", told), f"{model.__name__}.{name}"


@pytest.mark.parametrize(("model", "name"), KEYS, ids=NAMES)
def test_a_key_does_not_take_anything(model: type[StrictModel], name: str) -> None:
    with pytest.raises(ValidationError) as refused:
        model.model_validate({name: object()})
    assert name in {error["loc"][0] for error in refused.value.errors() if error["loc"]}


@pytest.mark.parametrize("model", dict.fromkeys(model for model, _ in KEYS))
def test_what_is_no_key_is_refused(model: type[StrictModel]) -> None:
    with pytest.raises(ValidationError) as refused:
        model.model_validate({"no_such_key": 1})
    assert "no_such_key" in {error["loc"][0] for error in refused.value.errors() if error["loc"]}
