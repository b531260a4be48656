"""Tables and sentences on an updated twin, which the command line prints and the page shows."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from statistics import mean

from retwin.evaluation.choice.fitted import Fitted
from retwin.report.assets import sentences
from retwin.report.blocks import Cell, Column, Table, tabulate
from retwin.report.labels import behind, duration, significant
from retwin.update.corrected import CorrectedTwin
from retwin.update.residual import ResidualModel, StationaryResidual


def units_of(found: Fitted) -> dict[str, str]:
    """The units of the outputs, as they stand behind a number."""
    outputs = found.records.outputs
    return {name: behind("", unit) for name, unit in zip(outputs.names, outputs.units, strict=True)}


def comparison_table(found: Fitted) -> Table:
    """The candidates and the models without the twin, unless nothing was compared."""
    rows: list[list[object]] = []
    units = units_of(found)
    for head, own in (("with the twin", True), ("without the twin", False)):
        some = [each for each in found.scores if each.uses_twin is own and found.parts]
        if some and not own:
            rows.append([head])
        for each in some:
            best = each.name == found.chosen
            if not each.rmse:
                rows.append([Cell(each.title, each.reason), *["–"] * (len(units) + 4)])
                continue
            size = each.standard_error
            like = max(each.crps / 10, size)  # digits that matter beside the score
            error = f"± {significant(size, like)}" if isfinite(size) else ""
            rows.append(
                [
                    Cell(each.title, "taken" if best else "", best=best),
                    *(
                        Cell(significant(each.rmse[n]) + unit, best=best)
                        for n, unit in units.items()
                    ),
                    Cell(significant(each.crps), best=best),
                    Cell(significant(each.difference, like), error),
                    _coverage(each.coverage),
                    duration(each.seconds),
                ]
            )
    heads = ["candidate", *(Column(name, "RMS error") for name in units)]
    title = "Errors of parts that were left out, the simplest candidate first"
    return tabulate(title, [*heads, "CRPS", "behind the best", "90 % bands hold", "time"], rows)


def _coverage(shares: Mapping[str, float]) -> Cell:
    """The mean share in the bands of the outputs, and that of each in turn if there are several."""
    known = [share for share in shares.values() if isfinite(share)]
    own = ", ".join(f"{share:.0%}" if isfinite(share) else "–" for share in shares.values())
    return Cell(f"{mean(known):.0%}" if known else "–", f"({own})" if len(shares) > 1 else "")


def parameter_table(found: Fitted) -> Table:
    """The parameters before, identified, and in the model."""
    rows = [[name, *map(significant, values)] for name, values in found.parameters.items()]
    return tabulate("Parameters", ["parameter", "before", "identified", "in the model"], rows)


def term_table(found: Fitted, *, largest: int = 8) -> Table:
    """The largest terms that state equations learned.

    Parameters
    ----------
    largest : int, default 8
        Number of terms of the state equations that are shown.

    """
    terms = {} if found.learned is None else found.learned.terms
    rows = [[name, f"{size:.3f}"] for name, size in list(terms.items())[:largest]]
    title = "The largest terms, over the usual time derivative of their state; variables are in "
    title += "standard deviations from their means"
    return tabulate(title, ["term", "size"], rows)


def model_sentences(found: Fitted, *, significant: float = 0.05) -> list[str]:
    """What the model was trained on, and whether its one-step errors are white noise.

    Parameters
    ----------
    significant : float, default 0.05
        P-value below which errors are not taken for white noise.

    """
    residual = found.twin.residual if isinstance(found.twin, CorrectedTwin) else None
    fitted = None if residual is None else residual.fitted
    covered, latent = [], {}
    if fitted is not None and isinstance(residual, ResidualModel):
        shares = {name: fitted.figures.get(f"coverage90_{name}") for name in residual.outputs.names}
        covered = [f"{each:.0%} of {name}" for name, each in shares.items() if each is not None]
    elif residual is not None and not isinstance(residual, StationaryResidual):
        latent = dict(zip(residual.latent.names, residual.latent.units, strict=True))
    return sentences(
        "model",
        fitted=fitted,
        emulated="EMULATED " if residual is not None and residual.emulated else "",
        covered=covered,
        latent=latent,
        one_step_errors=found.one_step_errors,
        significant=significant,
    )
