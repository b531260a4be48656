"""Config objects as plain values and back: frozen dataclasses, validated by pydantic.

Plain values are those of JSON and TOML: tables, lists, texts and numbers. A config object inside
another one is a table whose `kind` is one class of a closed list, so that reading runs no code that
a file names.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, PlainValidator, ValidationError, create_model
from pydantic_core import ErrorDetails, PydanticCustomError

from retwin.checks import one_of, require
from retwin.errors import InputError
from retwin.serialisation.files import check_regular

T = TypeVar("T")
MAX_DEPTH = 100
"""The largest number of dots in a key; reading takes memory by the square of it."""


def read_toml(path: Path, *, expected: str, remedy: str) -> dict[str, Any]:
    """The tables of a TOML file; InputError if it cannot be read or is none."""
    try:
        text = check_regular(path).read_text("utf-8")
        if max(part.count(".") for part in re.split(r"[=,{}\n]", text)) > MAX_DEPTH:
            raise ValueError("a key is nested too deeply")
        return tomllib.loads(text)
    except FileNotFoundError:
        got, remedy = "no file of that name", "check the name"
        raise InputError(str(path), expected=expected, got=got, remedy=remedy) from None
    except (OSError, ValueError, RecursionError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError(str(path), expected=expected, got=got, remedy=remedy) from None


def toml_text(text: str) -> str:
    """A string as TOML writes it, whose escapes are those of JSON."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def to_config(value: Any, kinds: Sequence[type]) -> dict[str, Any]:
    """The settings of a frozen dataclass and of the config objects inside it, as plain values.

    Config objects among its parameters are of `kinds`, or of a class that the type of the
    parameter names.

    Raises
    ------
    InputError
        The object, or one inside it, is of no such class and could not be read again.

    """
    if type(value) not in kinds:
        raise InputError(
            "config",
            expected=f"one of {', '.join(kind.__name__ for kind in kinds)}, to be saved",
            got=type(value).__name__,
            remedy="use the model without saving it: loading runs no code that a file names",
        )
    hints = get_type_hints(type(value))
    parts = {each.name: getattr(value, each.name) for each in fields(value)}
    inside = {
        name: to_config(part, (*_classes(_configs(hints[name])), *kinds))
        if is_dataclass(part)
        else part
        for name, part in parts.items()
    }
    return {"kind": type(value).__name__, **inside}


def from_config(values: Mapping[str, Any], kinds: Sequence[type], *, place: str = "config") -> Any:
    """The object that `to_config` described.

    Parameters
    ----------
    values : mapping of str to plain values
        A `kind`, which names a class of `kinds`, and parameters of that class.
    kinds : sequence of type
        The dataclasses that may be made.
    place : str
        What messages name before the key, such as "case.toml:".

    Raises
    ------
    InputError
        The kind is unknown, a parameter is unknown, missing or of another type, or the class
        refuses its parameters. The message names `place` and the key.

    """
    known = {kind.__name__: kind for kind in kinds}
    name: Any = values.get("kind")
    version = "; a model loads with the version of retwin that wrote it"
    name = one_of(
        key(place, "kind"),
        name,
        known,
        remedy=f"check the spelling{version if place == 'config' else ''}",
    )
    settings = {each: value for each, value in values.items() if each != "kind"}
    return from_settings(known[name], settings, kinds, place=place)


def from_settings(
    kind: type[T], settings: Mapping[str, Any], kinds: Sequence[type] = (), *, place: str
) -> T:
    """An object of the dataclass `kind` from its parameters by name.

    Config objects among the parameters are of `kinds`, or of the one class that the type of the
    parameter names. Raises as `from_config` does.
    """
    model = _model(kind, tuple(kinds))  # type: ignore[arg-type]
    made = _validate(model, settings, place)
    with at(place):
        return kind(**made)


def checked(
    kind: type, settings: Mapping[str, Any], *, place: str, besides: Sequence[str]
) -> dict[str, Any]:
    """Some parameters of the dataclass `kind`, lists as tuples, each of the type it should have.

    Raises InputError for unknown parameters, for those named in `besides`, and for values of
    another type. The message names `place` and the key.
    """
    return _validate(_model(kind, (), tuple(besides)), settings, place)


def key(place: str, name: str) -> str:
    """The name of a key in messages: "case.toml: density", then "case.toml: density.members"."""
    return f"{place} {name}" if place.endswith(":") else f"{place}.{name}".removeprefix(".")


@contextmanager
def at(place: str) -> Iterator[None]:
    """Raise the InputErrors of the block about that key of `place` which their argument names."""
    try:
        yield
    except InputError as error:
        same = re.split(r"[. ]", place)[-1] in re.findall(r"\w+", error.argument)
        where = place if same else key(place, error.argument)
        raise InputError(
            where, expected=error.expected, got=error.got, remedy=error.remedy
        ) from None


def fits(value: Any, hint: Any) -> bool:
    """Whether `value` is of that class, or has the public members of that protocol."""
    if _is_protocol(hint):
        return all(hasattr(value, name) for name in vars(hint) if not name.startswith("_"))
    return isinstance(value, hint)


def _is_protocol(hint: Any) -> bool:
    return getattr(hint, "_is_protocol", False)


def _validate(model: type[BaseModel], settings: Any, place: str) -> dict[str, Any]:
    """The parameters of `model` that `settings` hold; InputError about the first bad key."""
    require(
        isinstance(settings, Mapping),
        place,
        expected="a table",
        got=repr(settings),
        remedy="write { key = value, … }",
    )
    for name in settings:
        one_of(key(place, name), name, model.model_fields, remedy="check the spelling")
    try:
        made = model.model_validate(_tuples(settings))
        return {name: getattr(made, name) for name in made.model_fields_set}
    except ValidationError as error:
        errors = error.errors(include_url=False)
    name = str(errors[0]["loc"][0])
    where = key(place, name)
    require(name in settings, where, expected="a value", got="none", remedy="give it: it is needed")
    errors = [each for each in errors if each["loc"][0] == name]
    for each in errors:
        if "error" in each.get("ctx", {}):  # an InputError from inside a config object
            with at(where):
                raise each["ctx"]["error"]
    raise InputError(
        where,
        expected=" or ".join(dict.fromkeys(map(plain_reason, errors))),
        got=repr(settings[name]),
        remedy="see what this key may hold",
    )


def plain_reason(error: ErrorDetails) -> str:
    """What pydantic expected of a value, in the words of TOML."""
    text = {"missing": "more items", "too_long": "fewer items"}.get(error["type"], error["msg"])
    return re.sub("dictionary|mapping", "table", text.removeprefix("Input should be "))


@cache
def _model(
    kind: type, kinds: tuple[type, ...], besides: tuple[str, ...] | None = None
) -> type[BaseModel]:
    """What validates all parameters of `kind`, or any of them besides some."""
    hints = get_type_hints(kind)
    settings: dict[str, Any] = {}
    for each in fields(kind):
        if each.name not in (besides or ()):
            needed = besides is None and each.default is each.default_factory is MISSING
            settings[each.name] = (_setting(hints[each.name], kinds), ... if needed else None)
    exactly = ConfigDict(strict=True, arbitrary_types_allowed=True)  # a text is no number
    return create_model(kind.__name__, __config__=exactly, **settings)


def _setting(hint: Any, kinds: tuple[type, ...]) -> Any:
    """The type of a parameter, in which config objects are read from tables."""
    configs = _configs(hint)
    if not configs:
        return hint
    table = Annotated[Any, PlainValidator(partial(_config, configs, kinds))]
    return Union[(table, *(arm for arm in _arms(hint) if arm not in configs))]


def _arms(hint: Any) -> tuple[Any, ...]:
    """The types of a union, or the one type."""
    union = isinstance(hint, UnionType) or get_origin(hint) is Union
    return get_args(hint) if union else (hint,)


def _configs(hint: Any) -> tuple[Any, ...]:
    """The config classes and protocols of config objects among the types of a parameter."""
    return tuple(arm for arm in _arms(hint) if is_dataclass(arm) or _is_protocol(arm))


def _classes(configs: tuple[Any, ...]) -> tuple[type, ...]:
    return tuple(each for each in configs if not _is_protocol(each))


def _config(hints: tuple[Any, ...], kinds: tuple[type, ...], value: Any) -> Any:
    """The config object of one of `hints` that a table describes; messages begin with its keys."""
    if isinstance(value, Mapping):
        classes = _classes(hints)
        if "kind" not in value and len(hints) == len(classes) == 1:
            return from_settings(classes[0], value, kinds, place="")
        fitting = [kind for kind in kinds if any(fits(kind, hint) for hint in hints)]
        known = value.get("kind") in [kind.__name__ for kind in kinds]
        allowed = (*classes, *(kinds if known else fitting))
        made = from_config(value, allowed, place="")
        if any(fits(made, hint) for hint in hints):
            return made
    names = " or ".join(hint.__name__ for hint in hints)
    raise PydanticCustomError("config", f"a table whose kind is a {names}")


def _tuples(value: Any) -> Any:
    """Lists as tuples, also those in tables and in lists."""
    if isinstance(value, Mapping):
        return {name: _tuples(each) for name, each in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list | tuple) else value


M = TypeVar("M", bound=BaseModel)


class Part(BaseModel):
    """What all tables of such a file have in common: no unknown keys, and no text for a number."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, use_attribute_docstrings=True
    )


def settings_of(model: type[M], path: Path, *, expected: str, remedy: str) -> M:
    """The settings in a file; validators get its folder as their context.

    Raises
    ------
    InputError
        The file is no TOML, a key is unknown or missing, or a value is refused. The message names
        the file and the key.

    """
    tables = read_toml(path, expected=expected, remedy=remedy)
    try:
        return model.model_validate(tables, context=path.parent)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    raise InputError(
        f"{path}: {_key(first['loc'])}".removesuffix(": "),
        expected=_expected(first),
        got="none" if first["type"] == "missing" else _brief(first),
        remedy=remedy,
    )


def _key(place: tuple[int | str, ...]) -> str:
    """The key at which pydantic found an error, without the tags of its unions."""
    parts = [str(each) for each in place]
    if parts[:1] == ["sources"] and len(parts) > 2:
        parts = [f"sources[{parts[1]}]", *parts[3:]]
    return ".".join(each for each in parts if each != "function-after[_beside(), path]")


def _expected(error: Any) -> str:
    if error["type"] == "missing":
        return "a value"
    if error["type"] == "extra_forbidden":
        return "a known key"
    reason = plain_reason(error).removeprefix("Value error, ")
    reason = reason.replace("String should have", "a text of")
    return reason[:1].lower() + reason[1:]


def _brief(error: Any) -> str:
    """What was given, but for tables, which are too long to be shown."""
    value = error["input"]
    return "another one" if isinstance(value, dict | BaseModel) else repr(value)[:80]
