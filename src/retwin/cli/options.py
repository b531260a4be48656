"""Arguments and options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

from retwin.catalog import CASES
from retwin.cli.completion import one_of

__all__ = ["CaseArgument", "CaseOption", "Json", "MaxBytes", "OtherCase", "Rate", "Seed"]

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
MaxBytes = Annotated[
    int | None,
    typer.Option(metavar="N", help="Most that a file may hold; else by what is free.", min=1),
]
Seed = Annotated[int, typer.Option("--seed", metavar="N", help="Same seed, same result.", min=0)]
Json = Annotated[
    bool, typer.Option("--json", metavar="", help="Print JSON instead, and nothing else.")
]
