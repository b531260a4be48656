"""A twin as C text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from retwin.deploy.fmu.description import Variable

DIGITS = {"double": (".17g", ""), "float": (".9g", "f"), "int": ("d", "")}
"""How all digits of a number are written, and the suffix of its type."""


@dataclass(frozen=True)
class Text:
    """A twin from sample to sample, and what describes it.

    Attributes
    ----------
    source : str
        C99: the type `Twin`, and what the interfaces to FMI call.
    variables : sequence of Variable
        Its variables.
    rate : float
        Sample rate in Hz.
    about : str
        What the twin is; may be "".
    delay : float
        By how much its outputs are behind, in s.
    omitted : tuple of str
        Operators of the correction that it lacks.

    """

    source: str
    variables: Sequence[Variable]
    rate: float
    about: str
    delay: float = 0.0
    omitted: tuple[str, ...] = ()


def constants(name: str, values: ArrayLike, kind: str = "double") -> str:
    """A constant array of C, with all digits of its numbers; C has none without elements."""
    shown = [_number(each, kind) for each in np.ravel(values).tolist() or [0]]
    lines = [", ".join(shown[i : i + 8]) for i in range(0, len(shown), 8)]
    return f"static const {kind} {name}[{len(shown)}] = {{\n    " + ",\n    ".join(lines) + "};\n"


def _number(value: float, kind: str) -> str:
    digits, suffix = DIGITS[kind]
    text = format(value if kind == "int" else float(value), digits)
    if text.lstrip("-") in ("inf", "nan"):
        return text.replace("inf", "INFINITY").replace("nan", "NAN")
    return text + ("" if kind == "int" or set(text) & set(".e") else ".0") + suffix
