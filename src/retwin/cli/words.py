"""Words that a shell completes: names of cases, sources, faults and the like.

The names stand here again because the modules that own them load torch, for which a shell would
have to wait; a test holds them against those modules. Commands do not look at them: what a word
means, and that it is wrong, is said by the module that owns it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import typer

from retwin import twins
from retwin.download import REGISTRY

__all__ = [
    "CALIBRATED_ON",
    "CASES",
    "CLASSIFIERS",
    "CORRECTIONS",
    "DENSITIES",
    "FAULTS",
    "NETWORKS",
    "PRESETS",
    "SOURCES",
    "complete_faults",
    "complete_files",
    "complete_sources",
    "complete_twins",
    "one_of",
]

CASES = ("armpi", "tanks", "tanks_overflow")
CLASSIFIERS = ("cnn", "lstm", "rocket")
PRESETS = ("quick", "paper")
CALIBRATED_ON = ("healthy", "all")
NETWORKS = ("mlp", "lstm", "tcn", "state_space")
CORRECTIONS = ("additive", "delay_offset", "command_space")
DENSITIES = ("mixture", "flow", "sequence_mixture")
SOURCES = (
    "dt",
    "twin",
    "randomised",
    "ibg",
    "dt_noise",
    "pi_ls",
    "pi_bayes",
    "dann",
    "dann_transductive",
    "mean_corrected",
    "ibg_rg",
    "pi_ls_rg",
    "ibg_rg_command",
    "fine_tuned",
    "inversion",
    "inversion_cnn",
)
FAULTS: Mapping[str, Sequence[str]] = {
    "armpi": (
        "Healthy",
        *(f"Motor_{i}_{kind}" for kind in ("Stuck", "Steady_state_error") for i in range(1, 5)),
    ),
}
"""Classes of the built-in cases that have some."""

Complete = Callable[[str], list[str]]


def one_of(names: Sequence[str]) -> Complete:
    """Completes to one of these names."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return complete


def complete_sources(incomplete: str) -> list[str]:
    """Completes the last of several names that are joined by commas, none of them twice."""
    *chosen, last = incomplete.split(",")
    before = "".join(f"{name}," for name in chosen)
    left = [name for name in (*SOURCES, *(() if chosen else ("all",))) if name not in chosen]
    return [before + name for name in left if name.startswith(last)]


def complete_twins(incomplete: str) -> list[tuple[str, str]]:
    """Completes to a built-in twin, and says what it is."""
    known = ((name, title) for name, (_, _, title) in twins.BUILT_IN.items())
    return [(name, title) for name, title in known if name.startswith(incomplete)]


def complete_files(incomplete: str) -> list[str]:
    """Completes to a public data file that can be fetched."""
    return one_of(sorted(REGISTRY))(incomplete)


def complete_faults(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completes to a class of the case, or of the twin's own case, that stands on the line."""
    # An option that still lacks its value leaves arguments where they are.
    named = ctx.params.get("case") or ctx.params.get("twin") or next(iter(ctx.args), "")
    return one_of(("none", "all", *_faults(named)))(incomplete)


def _faults(named: str) -> Sequence[str]:
    if not named.endswith(".toml"):
        return FAULTS.get(named.partition("-")[0], ())
    try:
        told = tomllib.loads(Path(named).read_text("utf-8")).get("faults", {})
    except (OSError, ValueError):
        return ()  # the command itself says what is wrong with the file
    return ("Healthy", *told)
