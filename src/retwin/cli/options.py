"""Arguments and options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

from retwin.catalog import CASES
from retwin.checks import whole
from retwin.cli.completion import one_of

__all__ = ["CaseArgument", "CaseOption", "Json", "OtherCase", "Rate", "Seed"]

CaseArgument = Annotated[
    str,
    typer.Argument(
        metavar="CASE",
        help="Built-in case, case.toml, or module:object.",
        autocompletion=one_of(CASES),
    ),
]
CaseOption = Annotated[
    str | None,
    typer.Option(
        "--case",
        metavar="CASE",
        help="Built-in case, case.toml, or module:object.",
        autocompletion=one_of(CASES),
    ),
]
OtherCase = Annotated[
    str | None,
    typer.Option(
        "--case",
        metavar="CASE",
        help="If another than it was fitted for.",
        autocompletion=one_of(CASES),
    ),
]
Rate = Annotated[
    float | None,
    typer.Option("--rate", metavar="HZ", help="Samples per second, if the file has none."),
]
MAX_SEED = 2**63 - 1
"""The largest seed that every generator of random numbers takes."""
Seed = Annotated[
    int,
    typer.Option(
        "--seed",
        metavar="N",
        help="Same seed, same result.",
        min=0,
        callback=lambda seed: whole("--seed", seed, most=MAX_SEED),
    ),
]
Json = Annotated[
    bool, typer.Option("--json", metavar="", help="Print JSON instead, and nothing else.")
]
