"""Settings that users write in TOML files, each file a pydantic model with a JSON schema."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from retwin.errors import InputError
from retwin.serialisation.configs import plain_reason, read_toml

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
