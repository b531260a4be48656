"""A case.toml that is based on another case and changes some of its settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from retwin import catalog
from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords
from retwin.checks import one_of, require
from retwin.serialisation.configs import at, from_settings, key, read_toml
from retwin.twins.wrappers.parametric import Parameter

CONTENTS = "see docs/own_twin.md for what it holds"


def merge_bases(path: Path, above: tuple[Path, ...] = ()) -> tuple[dict[str, Any], Path | str]:
    """The settings of a file and of that on which it is based, and the folder of the latter.

    A key of this file replaces that of the base; of `parameters`, the settings of each parameter
    do. Instead of the folder, the name of a built-in case comes if the file is based on one.

    Parameters
    ----------
    path : Path
        The file.
    above : tuple of Path
        The files that are based on it.

    Raises
    ------
    InputError
        A file is no TOML, or is based on no case or on itself.

    """
    settings = read_toml(path, expected="a case as a TOML file", remedy=CONTENTS)
    base = settings.pop("based_on", None)
    if base is None:
        return settings, path.parent
    place = key(f"{path}:", "based_on")
    above = (*above, path.resolve())
    toml = isinstance(base, str) and Path(base).suffix.lower() == ".toml"
    expected = f"the name of another case.toml, or one of {', '.join(catalog.CASES)}"
    remedy = "check the spelling"
    require(toml or base in catalog.CASES, place, expected=expected, got=repr(base), remedy=remedy)
    if not toml:
        return settings, base
    other = path.parent / base
    expected = "a case that is not based on this one"
    remedy = "name the case that holds all settings"
    require(other.resolve() not in above, place, expected=expected, got=repr(base), remedy=remedy)
    inner, home = merge_bases(other, above)
    for name, value in settings.items():
        old = inner.get(name)
        if name == "parameters" and isinstance(old, Mapping) and isinstance(value, Mapping):
            tables = {each: new for each, new in value.items() if isinstance(new, Mapping)}
            value = {**old, **value, **{each: old.get(each, {}) | t for each, t in tables.items()}}
        inner[name] = value
    return inner, home


@dataclass(frozen=True)
class _Update:
    """The keys of a case.toml that is based on a built-in case."""

    name: str = ""
    title: str = ""
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)


def updated_built_in(base: str, settings: Mapping[str, Any], place: str) -> Case:
    """The built-in case `base` whose twin is that with the parameters of `settings`.

    Raises InputError, about `place`, for other settings and unknown parameters.
    """
    keys = from_settings(_Update, settings, place=place)
    made: Case = catalog.resolve(catalog.CASES[base].target)()
    names = made.parametric.names if made.parametric is not None else ()
    inside = key(place, "parameters")
    for name in keys.parameters:
        one_of(key(inside, name), name, names)
    fits = keys.parameters and made.parametric is not None
    expected = f"some of {', '.join(names) or 'none, since the case has no parameters'}"
    remedy = f'give "{base}" itself where a case is wanted'
    require(fits, inside, expected=expected, got="none", remedy=remedy)
    assert made.parametric is not None
    with at(place):
        twin = made.parametric.freed(parameters_of(keys.parameters, inside))
        records = made.records
        if isinstance(records, ColumnRecords):
            records = replace(records, twin=twin)
        made = replace(made, name=keys.name or made.name, title=keys.title or made.title)
        return replace(made, twin=twin, parametric=twin, records=records)


def parameters_of(tables: Mapping[str, Any], inside: str) -> list[Parameter]:
    """The parameters of a case, from a table for each."""
    return [
        from_settings(Parameter, {"name": name, **value}, place=key(inside, name))
        for name, value in tables.items()
    ]
