"""A method that the options of `retwin fit` name: a surrogate and a residual model of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from retwin.cli.reading import read
from retwin.cli.terminal import answer, bar, note, table

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.data.trajectories import Trajectories
    from retwin.twins.faults import Fault
    from retwin.update.residual import Residual
    from retwin.update.surrogate import Surrogate


def fit_method(
    system: Case,
    measured: Trajectories,
    faults: str | Mapping[str, Fault | None],
    name: str,
    out: Path,
    *,
    twin_data: Path | None,
    simulations: int | None,
    max_bytes: int | None,
    seed: int,
    as_json: bool,
) -> None:
    """Fit surrogate and residual model of the case; save the corrected twin."""
    import retwin as rt
    from retwin.evaluation.choice.stand_in import Simulating, simulations_for

    if twin_data is None:
        size = system.per_class if simulations is None else simulations
        how = Simulating(sampler=system.sampler, simulations=size)
        with bar("simulate") as show:
            nominal, text = simulations_for(
                system.twin, measured, how, seed, lambda share: show("", share)
            )
        if text:
            note(text)
    else:
        nominal = read(twin_data, system, max_bytes=max_bytes)
    with bar("fit") as show:
        ibg = rt.fit_surrogate(
            nominal,
            system.network,
            seed=seed,
            training=system.training,
            progress=lambda s: show("surrogate, 1 of 2", s),
        )
        rg = rt.fit_residual(
            ibg,
            measured,
            system.correction,
            system.density,
            seed=seed,
            calibrate_on=faults,
            twin=system.twin,
            progress=lambda s: show("residual model, 2 of 2", s),
        )
    rt.CorrectedTwin(ibg, rg, case=name).save(out)
    _print_fit(ibg, rg, out, as_json=as_json)


def _print_fit(ibg: Surrogate, rg: Residual, out: Path, *, as_json: bool) -> None:
    """Print the errors of both models, and where they were saved."""
    assert ibg.fitted is not None
    assert rg.fitted is not None
    figures, channels = ibg.fitted.figures, ibg.outputs
    outputs = [
        {"output": n, "unit": u, "rmse": figures[f"rmse_{n}"], "nrmse": figures[f"nrmse_{n}"]}
        for n, u in zip(channels.names, channels.units, strict=True)
    ]
    residual = {"emulated": rg.emulated, "reason": rg.fitted.reason, "figures": rg.fitted.figures}
    rows = [(o["output"], f"{o['rmse']:.3g} {o['unit']}", f"{o['nrmse']:.2%}") for o in outputs]
    answer(
        {"saved": str(out), "surrogate": outputs, "residual": residual},
        "Surrogate on held-out twin trajectories:",
        table(("output", "RMSE", "NRMSE"), rows, numbers=("RMSE", "NRMSE")),
        "",
        residual_line(rg),
        as_json=as_json,
    )
    note(f"Saved {out}")


def residual_line(rg: Residual) -> str:
    """The training data of a residual model, and its errors on held-out parts."""
    from retwin.update.residual import ResidualModel, StationaryResidual

    assert rg.fitted is not None
    figures, reason = rg.fitted.figures, rg.fitted.reason
    emulated = "EMULATED " if rg.emulated else ""
    if isinstance(rg, ResidualModel):
        counted = f"{figures['movements']:.0f} segments of {figures['trajectories']:.0f} "
        shares = [
            f"{figures[f'coverage90_{name}']:.0%} of {name}"
            for name in rg.outputs.names
            if f"coverage90_{name}" in figures
        ]
        bands = f" Bands of 90 % hold {', '.join(shares)} in the calibration." if shares else ""
        return f"Residual model: {counted}{emulated}trajectories; {reason}.{bands}"
    latent = zip(rg.latent.names, rg.latent.units, strict=True)
    errors = ", ".join(f"{name} {figures[f'rmse_{name}']:.3g} {unit}" for name, unit in latent)
    if isinstance(rg, StationaryResidual):
        return f"Residual model: {figures['samples']:.0f} {emulated}samples; {reason}."
    return (
        f"Residual model: {figures['samples']:.0f} {emulated}samples; {reason}. "
        f"On held-out parts the RMSE of its mean is {errors}, and its 90 % band covers "
        f"{figures['coverage90']:.0%}."
    )
