"""An LSTM from commands to outputs: the residual model per sample, over a constant.

What corrects a twin's outputs (`Additive` with a `SequenceMixture`) is here given a twin that knows
nothing, whose output is the mean of the records. So it is trained, calibrated on held-out blocks,
simulated and saved as corrected twins are. It begins each simulation without a past.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from retwin.data.trajectories import Trajectories
from retwin.nets.networks import MLP
from retwin.progress import Progress
from retwin.twins.commands.range import CommandRange
from retwin.update.blackbox.estimate import BlackBox, check_records
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Additive
from retwin.update.residual import SequenceMixture, fit_residual
from retwin.update.surrogate import Surrogate


def fit_lstm(
    observed: Trajectories, seed: int, progress: Progress | None, members: int | None = None
) -> BlackBox:
    """The network whose first weights are drawn with a seed; `members` makes it a smaller one."""
    check_records(observed)
    constant, density = _constant(observed), SequenceMixture()
    if members is not None:
        density = replace(density, members=members, refit=False)
    residual = fit_residual(
        constant,
        observed,
        Additive(),
        density,
        calibrate_on="all",  # the records have no fault
        seed=seed,
        progress=progress,
    )
    unit = constant.unit.numpy() if not observed.outputs.comparable else 1.0
    made = residual.mean(residual.context(constant, observed.commands)).numpy()
    errors = (made + constant.after.mean.numpy() - observed.observed) / unit
    assert residual.fitted is not None, "it has just been fitted"
    held_out = [residual.fitted.figures[f"rmse_{name}"] for name in residual.latent.names]
    figures = {
        "parameters": float(sum(each.numel() for each in residual.parameters())),
        "rms": float(np.sqrt(np.mean(errors[observed.mask] ** 2))),
        "held_out": float(np.sqrt(np.mean((np.array(held_out) / unit) ** 2))),
    }
    return BlackBox(CorrectedTwin(constant, residual), figures)


@torch.no_grad()
def _constant(observed: Trajectories) -> Surrogate:
    """A twin whose outputs are the means of the measured ones, whatever the commands are."""
    channels = {"inputs": observed.inputs, "outputs": observed.outputs}
    made = Surrogate(MLP(()), rate=observed.rate, **channels)
    for each in made.network.parameters():
        each.zero_()
    made.before.fit(torch.tensor(observed.commands))
    for i, width in enumerate(made.after.mean):
        values = torch.tensor(observed.observed[..., i][observed.mask[..., i]])
        width.copy_(values.mean())
        made.after.scale[i] = values.std(correction=0)
    # A count of 0: the range of a long record is not left by chance, however few records there are.
    made.trained = replace(CommandRange.of(observed.commands, observed.rate), count=0)
    return made.eval()
