"""Arguments and options that several commands share."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from retwin.catalog import CASES
from retwin.checks import positive, whole
from retwin.cli.completion import one_of

CASE = "Built-in case, case.toml, or module:object."
case_option = partial(typer.Option, "--case", metavar="CASE", autocompletion=one_of(CASES))

CaseArgument = Annotated[
    str, typer.Argument(metavar="CASE", help=CASE, autocompletion=one_of(CASES))
]
CaseOption = Annotated[str | None, case_option(help=CASE)]
OtherCase = Annotated[str | None, case_option(help="If another than it was fitted for.")]
Model = Annotated[Path, typer.Argument(metavar="MODEL", help="Folder of a corrected twin.")]
Real = Annotated[
    Path, typer.Argument(metavar="REAL", help="The trajectories it was calibrated on.")
]
Measured = Annotated[
    Path, typer.Argument(metavar="FILE", help="Trajectories; labels are not needed.")
]
Probabilities = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE", help="CSV file for all probabilities."),
]
PerClass = Annotated[int, typer.Option(metavar="N", help="Trajectories per class.")]
Rate = Annotated[
    float | None,
    typer.Option("--rate", metavar="HZ", help="Samples per second, if the file has none."),
]
LogMapping = Annotated[
    Path | None,
    typer.Option("--mapping", metavar="FILE", help="For a log: what `retwin data map` wrote."),
]
TWIN = "Twin"
"""The panel of help with the options of a twin that is no case."""
Inputs = Annotated[
    str,
    typer.Option(
        "--inputs", metavar="NAMES", help="Of the inputs, joined by commas.", rich_help_panel=TWIN
    ),
]
Outputs = Annotated[
    str,
    typer.Option(
        "--outputs", metavar="NAMES", help="Of the outputs, joined by commas.", rich_help_panel=TWIN
    ),
]
MaxBytes = Annotated[
    int | None,
    typer.Option(metavar="N", help="Most that a file may hold; else by what is free.", min=1),
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
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead, and nothing else.")]

Horizon = Annotated[
    str,
    typer.Option(
        "--horizon", metavar="TIME", help="Judge by predictions so far ahead, as 1s; or free."
    ),
]


def seconds_of(option: str, text: str) -> float | None:
    """The time in s of a text such as `0.5` or `1s`; None for `free`.

    Raises InputError for another text.
    """
    if text == "free":
        return None
    number = text.removesuffix("s").strip()
    try:
        value = float(number)
    except ValueError:
        value = 0.0
    return positive(option, value, remedy="write free, or a time in seconds such as 1s")


def channel_names(text: str) -> tuple[str, ...]:
    """The names in the value of `--inputs` or `--outputs`."""
    return tuple(each.strip() for each in text.split(",") if each.strip())
