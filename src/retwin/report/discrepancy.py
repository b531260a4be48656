"""The discrepancy itself: what was observed of it, and what the twins generate."""

from __future__ import annotations

from dataclasses import dataclass

from retwin.report.blocks import Block, Cell, Column, Section, Table
from retwin.report.curves import Latent, latents
from retwin.report.movement import movement, movement_plot
from retwin.report.parts import Figure
from retwin.report.plots import caption, latent_names, latent_plot
from retwin.report.results import Results
from retwin.report.words import number, order, source_name

__all__ = ["Group", "cell", "detailed", "discrepancy", "figure_names", "groups", "titled", "whose"]

FEW = 3
"""Sources that are shown in full."""


@dataclass(frozen=True)
class Group:
    """Latents that are drawn side by side: the figure's name and caption, whose they are."""

    name: str
    source: str
    text: str
    shown: list[Latent]


def figure_names(results: Results) -> dict[str, str]:
    """What is added to a figure's name for each source: nothing for the first of them."""
    known = order(list(results.fidelity))
    return {source: f"-{place + 1}" if place else "" for place, source in enumerate(known)}


def detailed(results: Results) -> list[str]:
    """Sources that are shown in full; of many, those whose residual model the page is about."""
    known = order(list(results.fidelity))
    about = [name for name in known if name in ("ibg_rg", "ibg_rg_command")]
    return known if len(known) <= FEW else about or known[-FEW:]


def groups(results: Results) -> list[Group]:
    """Delays, offsets, noise and the rest, each with a figure of its own."""
    real = "emulated system" if results.emulated else "real system"
    see = f"Where the line follows the bars, the twin generates what the {real} did."
    found = []
    for source, added in figure_names(results).items():
        whose = f" {source_name(source)}." if len(results.fidelity) > 1 else ""
        kinds = {
            "tde": ("delay", "Delay of movements (TDe)", " The paper’s figure 5."),
            "tpe": ("offset_", "Position error per axis (TPE)", " The paper’s figure 6."),
            "noise": ("noise_", "Standard deviation at rest, per output and movement", ""),
        }
        left = latents(results, source)
        for name, (start, title, figure) in kinds.items():
            shown = [each for each in left if each.name.startswith(start)]
            left = [each for each in left if each not in shown]
            text = f"{title}, observed and generated.{whose} {see}"
            if results.published and source == "ibg_rg":
                text += figure
            if shown:
                found.append(Group(f"{name}{added}", source, text, shown))
        if left:
            text = f"Discrepancy, observed and generated.{whose} {see}"
            found.append(Group(f"z{added}", source, text, left))
    return found


def discrepancy(results: Results) -> Section | None:
    """What it is (figure 2), observed against generated (5 and 6), and tests of the agreement."""
    taken_apart = movement(results)
    blocks: list[Block] = [] if taken_apart is None else [movement_plot(results, taken_apart)]
    blocks += [
        latent_plot(results, each.source, each.name, each.text, each.shown)
        for each in groups(results)
        if each.source in detailed(results)
    ]
    for source in detailed(results):
        table = _agreement(results, source)
        if table is not None:
            blocks.append(table)
    return Section("discrepancy", "Discrepancy", blocks) if blocks else None


def _agreement(results: Results, source: str) -> Table | None:
    told = results.fidelity[source]
    if not told.agreement:
        return None
    rows = []
    for name, distance in told.agreement.items():
        inside = told.figures.get(f"coverage90/{name}", Figure())
        row = [Cell(latent_names(name)[0]), cell(distance, 2), Cell(number(distance.p, 2))]
        rows.append([*row, cell(inside, 2)])
    columns = [
        Column("Per movement", numeric=False),
        Column("KS distance"),
        Column("p"),
        Column("in the 90 % range"),
    ]
    held = f" on {told.movements} held-out movements" if told.movements else ""
    text = (
        f"What was generated beside what was observed{held}; "
        "delay and offset are inferred from both in the same way. KS distance: the greatest gap "
        "between the two cumulative distributions, 0 is best. p: the share of perfect generators "
        "that would look at least as bad on as few trajectories, out of 20, so never below 0.05. "
        "The share inside the generated "
        "90 % range should be 0.90: below, the twin is too sure; above, too wide. In brackets the "
        "95 % bootstrap interval over trajectories."
    )
    title = titled(results, source, "Agreement per movement")
    return Table(title, caption(results, text), columns, rows)


def whose(results: Results, source: str) -> str:
    """The beginning of a caption, where there are several."""
    return f"{source_name(source)}. " if len(results.fidelity) > 1 else ""


def titled(results: Results, source: str, what: str) -> str:
    """The title of a table, with the source where there are several."""
    return f"{what}, {source_name(source)}" if len(results.fidelity) > 1 else what


def cell(figure: Figure, digits: int = 3, factor: float = 1.0) -> Cell:
    """A figure with its interval below."""
    if figure.value is None:
        return Cell("–")
    ends = figure.ends
    below = "" if ends is None else f"[{' to '.join(number(factor * e, digits) for e in ends)}]"
    return Cell(number(factor * figure.value, digits), below)
