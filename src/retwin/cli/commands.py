"""`Commands`: a Typer application whose errors about missing files name the option."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

from retwin.errors import InputError

GENERIC = ("path", "folder", "file")
"""Arguments of functions, as which readers name any file."""

Made = TypeVar("Made", bound=Callable[..., Any])


class Command(TyperCommand):
    """A command whose errors about missing files name the option that named the file."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Arguments and options, `--help` among them."""
        return _without_types(super().get_params(ctx))

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except InputError as error:
            named = _naming(error, self.params, ctx.params)
            if not named:
                raise
            raise InputError(
                named, expected=error.expected, got=error.got, remedy=error.remedy
            ) from error


class Group(TyperGroup):
    """Commands under one name."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The options, `--help` among them."""
        return _without_types(super().get_params(ctx))


class Commands(typer.Typer):
    """An application of such commands."""

    def __init__(self, *, cls: type[TyperGroup] = Group, **settings: Any) -> None:
        super().__init__(cls=cls, no_args_is_help=True, **settings)

    def command(
        self, name: str | None = None, *, cls: type[TyperCommand] | None = None, **settings: Any
    ) -> Callable[[Made], Made]:
        """Add a function as a command."""
        return super().command(name, cls=cls or Command, **settings)


def _without_types(params: list[Any]) -> list[Any]:
    """The parameters; flags are listed without "<bool>", named arguments without their type."""
    for each in params:
        if getattr(each, "is_flag", False):
            each.metavar = ""
        if each.param_type_name == "argument" and each.metavar:
            each.display_type_rich = _nothing  # it would be "<str>" beside "CASE"
    return params


def _nothing(ctx: Any) -> None:
    """No type in the help."""


def _naming(error: InputError, params: Iterable[Any], values: Mapping[str, Any]) -> str:
    """The option or argument that named the missing file of an error; "" if none is missing."""
    for each in params:
        option = each.opts[0] if each.param_type_name == "option" else each.metavar or each.name
        for path in _paths(each, values.get(each.name)):
            if os.path.exists(path):
                continue
            if str(path) in (error.argument, error.argument.strip("'")):
                return f"{option.strip('[].')} {error.argument}"
            if error.argument in GENERIC and _names(error.got, path):
                return str(option.strip("[]."))
    return ""


def _names(text: str, path: Path) -> bool:
    """Whether the text has this path, and not as a part of another one."""
    return bool(re.search(rf"(?<![\w./-]){re.escape(str(path))}(?![\w/-]|\.\w)", text))


def _paths(param: Any, value: Any) -> Iterator[Path]:
    """The paths that were given for a parameter; those of case files are text."""
    for each in value if isinstance(value, list | tuple) else [value]:
        if isinstance(each, Path):
            yield each
        elif isinstance(each, str) and param.metavar == "CASE" and each.lower().endswith(".toml"):
            yield Path(each)
