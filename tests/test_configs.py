"""Config objects as plain values: the same object again, and closed kinds."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import pytest

from retwin.errors import InputError
from retwin.serialisation.configs import checked, from_config, from_settings, to_config


class Shape(Protocol):
    """What both kinds of shapes have."""

    def area(self) -> float: ...


@dataclass(frozen=True)
class Square:
    side: float = 1.0

    def __post_init__(self) -> None:
        if not self.side > 0:
            raise InputError("side", expected="above 0", got=repr(self.side), remedy="give it in m")

    def area(self) -> float:
        return self.side**2


@dataclass(frozen=True)
class Point:
    at: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Pair:
    first: Shape
    second: Shape | Point | None = None
    point: Point = field(default_factory=Point)
    count: int | tuple[int, int] = 1
    mode: Literal["fast", "exact"] = "fast"
    names: Mapping[str, float] = field(default_factory=dict)

    def area(self) -> float:
        return self.first.area()


KINDS = (Square, Point, Pair)


def test_an_object_comes_back_through_json() -> None:
    pair = Pair(Pair(Square(2.0)), Point((1.0, 2.0)), Point((3.0, 4.0)), (1, 2), "exact", {"a": 1})
    values = json.loads(json.dumps(to_config(pair, KINDS)))
    assert values["first"]["first"] == {"kind": "Square", "side": 2.0}
    assert from_config(values, KINDS) == pair


def test_only_a_listed_kind_is_saved() -> None:
    with pytest.raises(InputError, match="config: expected one of Square, Point, to be saved"):
        to_config(Pair(Square()), (Square, Point))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, r"config\.kind: expected one of Square, Point, Pair, got None"),
        ({"kind": ["Square"]}, r"config\.kind: expected one of .* got \['Square'\]"),
        ({"kind": "Square", "side": True}, r"config\.side: expected a valid number, got True"),
        ({"kind": "Square", "side": "1"}, r"config\.side: expected a valid number, got '1'"),
        ({"kind": "Square", "size": 1}, r"config\.size: expected one of side, got 'size'"),
        ({"kind": "Square", "side": -1}, r"config\.side: expected above 0, got -1"),
        ({"kind": "Point", "at": [1]}, r"config\.at: expected more items, got \[1\]"),
        ({"kind": "Point", "at": [1, 2, 3]}, r"config\.at: expected fewer items, got \[1, 2, 3\]"),
        ({"kind": "Pair"}, r"config\.first: expected a value, got none"),
        ({"first": 3}, r"config\.first: expected a table whose kind is a Shape, got 3"),
        ({"first": {"kind": "Point"}}, r"config\.first: expected a table whose kind is a Shape"),
        ({"first": {"kind": "Disc"}}, r"config\.first\.kind: expected one of Square, Pair, got"),
        ({"first": {"kind": "Square", "side": 0}}, r"config\.first\.side: expected above 0, got 0"),
        ({"point": {"at": ["a", 1]}}, r"config\.point\.at: expected a valid number"),
        ({"count": 1.5}, r"config\.count: expected a valid integer.* or a valid tuple, got 1\.5"),
        ({"mode": "slow"}, r"config\.mode: expected 'fast' or 'exact', got 'slow'"),
        ({"names": 3}, r"config\.names: expected a valid table, got 3"),
    ],
)
def test_a_refusal_names_the_key(values: dict[str, Any], message: str) -> None:
    if values and "kind" not in values:
        values = {"kind": "Pair", "first": {"kind": "Square"}, **values}
    with pytest.raises(InputError, match=message):
        from_config(values, KINDS)


def test_one_class_needs_no_kind() -> None:
    made = from_settings(Pair, {"first": {"kind": "Square"}}, KINDS, place="a:")
    assert made == Pair(Square())
    point = {"first": {"kind": "Square"}, "point": {"at": [1, 2]}}
    assert from_settings(Pair, point, KINDS, place="a:").point == Point((1, 2))
    with pytest.raises(InputError, match="a: expected a table, got 3"):
        from_settings(Pair, 3, place="a")  # type: ignore[arg-type]


def test_some_parameters_can_be_checked_alone() -> None:
    assert checked(Pair, {"count": [1, 2]}, place="a", besides=("first",)) == {"count": (1, 2)}
    with pytest.raises(InputError, match=r"a\.first: expected one of second, point, count"):
        checked(Pair, {"first": {}}, place="a", besides=("first",))
