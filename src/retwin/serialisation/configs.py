"""Frozen config objects as plain values and back, for a closed list of kinds: files run no code.

The values are those of JSON or TOML: tables, lists, texts and numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from types import NoneType
from typing import Any, TypeVar, get_args, get_type_hints

from retwin.errors import InputError

__all__ = [
    "at",
    "checked",
    "fits",
    "from_config",
    "from_settings",
    "key",
    "named",
    "table",
    "to_config",
]

T = TypeVar("T")

RENAMED_KINDS = {"SteadyStateError": "ActuatorBias"}
"""Kinds in files of versions before 0.1.0, and their present names."""
RENAMED_SETTINGS = {
    "Training": {"epochs": "max_epochs", "batch": "batch_size", "rate": "learning_rate"},
    "CommandSpace": {"most": "max_samples", "known": "identified_below"},
}
"""Per kind, settings in files of versions before 0.1.0, and their present names."""


def to_config(value: Any, kinds: Sequence[type]) -> dict[str, Any]:
    """The settings of a frozen dataclass and of those inside it.

    Raises InputError for a kind that could not be loaded again.
    """
    if type(value) not in kinds:
        raise InputError(
            "config",
            expected=f"one of {_names(kinds)}, to be saved",
            got=type(value).__name__,
            remedy="use the model without saving it: loading runs no code that a file names",
        )
    parts = {each.name: getattr(value, each.name) for each in fields(value)}
    inside = {k: to_config(v, kinds) if is_dataclass(v) else v for k, v in parts.items()}
    return {"kind": type(value).__name__, **inside}


def from_config(values: Mapping[str, Any], kinds: Sequence[type], *, place: str = "config") -> Any:
    """The object that `to_config` told of: its `kind` is a class, the rest are its parameters.

    Raises InputError, about `place`, for an unknown kind and for what `from_settings` refuses.
    """
    known = {kind.__name__: kind for kind in kinds}
    kind = values.get("kind")
    kind = RENAMED_KINDS.get(kind, kind) if isinstance(kind, str) else kind
    if not isinstance(kind, str) or kind not in known:
        raise InputError(
            key(place, "kind"),
            expected=f"one of {_names(kinds)}",
            got=repr(kind),
            remedy="check the spelling; a model loads with the version of retwin that wrote it",
        )
    settings = {name: value for name, value in values.items() if name != "kind"}
    return from_settings(known[kind], settings, kinds, place=place)


def from_settings(
    kind: type[T], settings: Mapping[str, Any], kinds: Sequence[type] = (), *, place: str
) -> T:
    """A dataclass from its parameters by name, each checked against its type.

    Raises InputError, about `place` and the parameter, for a missing one, for what `checked`
    refuses, and for what the class itself refuses.
    """
    made = checked(kind, settings, kinds, place=place)
    for each in fields(kind):  # type: ignore[arg-type]
        optional = each.default is not MISSING or each.default_factory is not MISSING
        if not optional and each.name not in made:
            raise InputError(
                key(place, each.name),
                expected="a value",
                got="none",
                remedy=f"give it: {_name(kind)} cannot be without",
            )
    with at(place):
        return kind(**made)


def checked(
    kind: type,
    settings: Mapping[str, Any],
    kinds: Sequence[type] = (),
    *,
    place: str,
    besides: Sequence[str] = (),
) -> dict[str, Any]:
    """Parameters of a dataclass by name, lists as tuples, each of the type it should have.

    A parameter that is a config object itself is a table, with a `kind` of `kinds` where the type
    leaves it open. Raises InputError, about `place` and the parameter, for unknown ones and those
    named in `besides`, and for values of another type.
    """
    hints = get_type_hints(kind)
    known = [each.name for each in fields(kind) if each.name not in besides]
    made = {}
    renamed = RENAMED_SETTINGS.get(kind.__name__, {})
    for given, value in table(settings, place).items():
        name = renamed.get(given, given)
        if name not in known:
            raise InputError(
                key(place, name),
                expected=f"one of {', '.join(known)}",
                got="an unknown key",
                remedy="check the spelling, or leave it out",
            )
        made[name] = _setting(value, hints[name], kinds, key(place, name))
    return made


def table(value: Any, place: str) -> dict[str, Any]:
    """`value`, which must be a table; InputError, about `place`, when it is not."""
    if not isinstance(value, Mapping):
        raise InputError(
            place, expected="a table", got=repr(value), remedy="write { key = value, … }"
        )
    return dict(value)


def key(place: str, name: str) -> str:
    """The name of a key in messages: "case.toml: density", then "case.toml: density.members"."""
    return f"{place} {name}" if place.endswith(":") else f"{place}.{name}"


@contextmanager
def at(place: str) -> Iterator[None]:
    """What is wrong with an argument inside is wrong with that key of `place`."""
    try:
        yield
    except InputError as error:
        same = re.split(r"[. ]", place)[-1] in re.findall(r"\w+", error.argument)
        where = place if same else key(place, error.argument)
        raise InputError(
            where, expected=error.expected, got=error.got, remedy=error.remedy
        ) from None


def _setting(value: Any, hint: Any, kinds: Sequence[type], place: str) -> Any:
    """A setting as it was before JSON or TOML, which know neither tuples nor our kinds."""
    arms = get_args(hint) or (hint,)
    configs = [arm for arm in arms if is_dataclass(arm) or _is_protocol(arm)]
    if not configs:
        return _plain(value, hint, place)
    if type(value) in (arm for arm in arms if arm in (str, NoneType)):
        return value
    if isinstance(value, Mapping):
        if "kind" not in value and len(configs) == 1 and is_dataclass(configs[0]):
            return from_settings(configs[0], value, kinds, place=place)  # type: ignore[arg-type]
        made = from_config(value, kinds, place=place)
        if any(fits(made, arm) for arm in configs):
            return made
    names = " or ".join(map(_name, configs))
    raise _wrong(place, f"a table whose kind is a {names}", repr(value))


def _plain(value: Any, hint: Any, place: str) -> Any:
    """A number, a text, a list or table of them."""
    # Here and not above: many commands do without it.
    from pydantic import ConfigDict, TypeAdapter, ValidationError

    exactly = ConfigDict(strict=True, arbitrary_types_allowed=True)  # a text is no number
    try:
        return TypeAdapter(hint, config=exactly).validate_python(_tuples(value))
    except ValidationError as error:
        told = {each["msg"].removeprefix("Input should be "): None for each in error.errors()}
        raise _wrong(place, " or ".join(told), repr(value)) from None


def _is_protocol(hint: Any) -> bool:
    return getattr(hint, "_is_protocol", False)


def fits(value: Any, hint: Any) -> bool:
    """Whether `value` is of that class, or has what that protocol asks for."""
    if _is_protocol(hint):
        return all(hasattr(value, name) for name in vars(hint) if not name.startswith("_"))
    return isinstance(value, hint)


def _tuples(value: Any) -> Any:
    """Lists as tuples, also those in tables and in lists."""
    if isinstance(value, Mapping):
        return {name: _tuples(each) for name, each in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _wrong(place: str, expected: str, got: str) -> InputError:
    return InputError(place, expected=expected, got=got, remedy="see what this key may hold")


def named(name: str, known: Mapping[str, T], argument: str) -> T:
    """What goes by that name; InputError, about `argument`, when nothing does."""
    if not isinstance(name, str) or name not in known:
        raise InputError(
            argument,
            expected=f"one of {', '.join(known)}",
            got=repr(name),
            remedy="check the spelling",
        )
    return known[name]


def _names(kinds: Sequence[type]) -> str:
    return ", ".join(map(_name, kinds))


def _name(kind: Any) -> str:
    return getattr(kind, "__name__", str(kind))
