"""Records with other values against the library's own way to make them."""

from dataclasses import dataclass, replace
from functools import cached_property

from magfusion.model.altered import altered


@dataclass(frozen=True)
class Square:
    """A record that works something out."""

    side: float
    colour: str = "red"

    @cached_property
    def area(self) -> float:
        return self.side**2


@dataclass(frozen=True)
class Box(Square):
    """A record of another kind, with more values."""

    height: float = 1.0


def test_a_record_is_altered_as_replaced_and_keeps_nothing_that_it_worked_out():
    box = Box(2.0, height=3.0)
    assert box.area == 4.0
    found = altered(box, side=5.0)
    assert found == replace(box, side=5.0)
    assert type(found) is Box
    assert found.area == 25.0
    assert box == Box(2.0, height=3.0)


def test_what_is_known_already_may_be_given():
    assert altered(Square(2.0), side=3.0, area=9.0).area == 9.0
