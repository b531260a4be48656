"""Draws of z for actuators: those of the corrected twin, at poses that its commands reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.checks import require
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Chain, CommandSpace, Context, DelayOffset, before_sensor
from retwin.update.corrections.delays import gather_samples
from retwin.update.residual import ResidualModel
from retwin.update.surrogate import Surrogate


@dataclass(frozen=True, eq=False)
class Draws:
    """K draws of z, each for one environment and episode.

    Attributes
    ----------
    delay : Tensor
        (K, 1), in s, at least 0.
    offset : Tensor
        (K, d_y), the error at `centre`, in the output's unit.
    probability : Tensor
        (K, d_u), that an actuator misses a segment.
    gain, centre, low, high : Tensor
        (d_y,), see `ActuatorStep`.
    early : float
        Share of draws whose delay was before the command, and is 0 instead.

    """

    delay: Tensor
    offset: Tensor
    probability: Tensor
    gain: Tensor
    centre: Tensor
    low: Tensor
    high: Tensor
    early: float


def still_and_fastest(commands: NDArray, *, no_change: float = 1e-6) -> tuple[NDArray, NDArray]:
    """The largest changes by one sample (d_u,) that count as none, and that are in `commands`.

    Parameters
    ----------
    no_change : float, default 1e-6
        Largest change of a command, relative to its range, that counts as none, as in `Segments`.

    """
    low, high = commands.min(axis=(0, 1)), commands.max(axis=(0, 1))
    change: NDArray = np.abs(np.diff(commands, axis=1)).max(axis=(0, 1))
    return no_change * np.where(high > low, high - low, 1), change


def causal_part(
    twin: object, *, any_outputs: bool = False
) -> tuple[CorrectedTwin, CommandSpace | DelayOffset]:
    """The twin and its operator, if that can be an actuator, step by step.

    Parameters
    ----------
    twin : object
        What is to be exported.
    any_outputs : bool
        Whether `DelayOffset` may correct outputs that are not those of actuators.

    Raises
    ------
    InputError
        Another twin; an operator that is no actuator; one that depends on later samples.

    """
    other = "export it as an FMU: retwin export fmu"
    got = f"{type(twin).__name__}, which has no correction that an actuator executes"
    _refuse(not isinstance(twin, CorrectedTwin), got, other)
    assert isinstance(twin, CorrectedTwin)
    residual, operator = twin.residual, before_sensor(twin.residual.correction)
    got = "a Chain of operators: what stands behind the actuators is no actuator"
    _refuse(isinstance(operator, Chain), got, "fit one of CommandSpace and DelayOffset")
    _refuse(
        not isinstance(residual, ResidualModel)
        or type(operator) not in (CommandSpace, DelayOffset),
        f"{type(operator).__name__}, which corrects each output sample and no actuator",
        f"fit CommandSpace, or {other}",
    )
    _refuse(
        residual.segmentation != "commands",
        "segments that are found in the nominal path: where one begins depends on its whole range "
        "of speeds, which is known only at the end",
        "fit it with the segments of the commands",
    )
    assert isinstance(operator, CommandSpace | DelayOffset)
    if isinstance(operator, DelayOffset) and not any_outputs:
        _check_outputs(twin)
    return twin, operator


def _check_outputs(twin: CorrectedTwin) -> None:
    """Refuse a correction of outputs that are not those of actuators."""
    _refuse(
        len(twin.outputs) != len(twin.inputs),
        f"DelayOffset with {len(twin.outputs)} outputs for {len(twin.inputs)} commands: these are "
        "not positions or torques of actuators",
        "fit CommandSpace, which finds what the actuators executed",
    )
    got = "DelayOffset with a twin or a network that remembers, in place of an MLP"
    remedy = "fit the surrogate with an MLP, or CommandSpace, or export it as an FMU"
    _refuse(not (isinstance(twin.surrogate, Surrogate) and twin.surrogate.memoryless), got, remedy)


def _refuse(wrong: bool, got: str, remedy: str) -> None:
    expected = "a corrected twin whose correction is what its actuators execute, by past "
    expected += "commands alone"
    require(not wrong, "twin", expected=expected, got=got, remedy=remedy)


@torch.no_grad()
def drawn(
    twin: CorrectedTwin, commands: NDArray, count: int, seed: int, *, any_outputs: bool = False
) -> Draws:
    """Draws of z at the segments of commands (n, T, d_u).

    Each draw is that of the twin for one segment, at random. Of the offsets the part that is
    proportional to the actuator's own target becomes the gain: the slope of their conditional mean.
    """
    operator = causal_part(twin, any_outputs=any_outputs)[1]
    residual = twin.residual
    assert isinstance(residual, ResidualModel)
    context = residual.context(twin.surrogate, commands)
    valid = torch.as_tensor(context.segments.valid)
    expected = "commands that move and rest, as in calibration"
    got = "none that changes"
    remedy = "give commands of the task, or leave them out for the case's"
    require(bool(valid.any()), "commands", expected=expected, got=got, remedy=remedy)
    distribution = residual(context)
    mean = residual.mean(context)[valid]
    generator = torch.Generator().manual_seed(seed)
    passes = -(-count // int(valid.sum()))
    every = [residual.drawn(distribution, generator=generator)[valid] for _ in range(passes)]
    rows = torch.randperm(passes * len(mean), generator=generator)[:count]
    segment = rows % len(mean)
    z = torch.cat(every)[rows]
    width = len(twin.outputs) if isinstance(operator, DelayOffset) else len(twin.inputs)
    target = _targets(context, operator)[valid]
    offset = slice(1, 1 + width)
    gain = _slopes(target, mean[:, offset])
    if isinstance(operator, DelayOffset):
        gain = torch.zeros_like(gain)  # its offsets change with time, not with the distance covered
    centre = target.mean(dim=0)
    early = float((z[:, 0] < 0).double().mean())
    got = f"delays of which {early:.0%} are before the command"
    # Share of draws at most whose delay is before the command; they get none.
    _refuse(early > 0.5, got, "check the clocks of commands and outputs")
    missed = mean[segment, 1 + width :]
    return Draws(
        delay=z[:, :1].clamp_min(0) / twin.rate,
        offset=z[:, offset] - gain * (target[segment] - centre),
        probability=missed if missed.shape[1] else torch.zeros(count, len(twin.inputs)),
        gain=gain,
        centre=centre,
        low=target.amin(dim=0),
        high=target.amax(dim=0),
        early=early,
    )


def _targets(context: Context, operator: CommandSpace | DelayOffset) -> Tensor:
    """Commands (n, M, d_u), or nominal outputs, at which each segment settles."""
    values = context.nominal if isinstance(operator, DelayOffset) else context.commands
    last = values.shape[1] - 1
    settle = torch.as_tensor(np.round(context.segments.settle)).long().clamp(0, last)
    return gather_samples(values, settle)


def _slopes(target: Tensor, mean: Tensor, *, still: float = 1e-9) -> Tensor:
    """Least-squares slopes (d,) of each column of `mean` (m, d) in that of `target` (m, d).

    Parameters
    ----------
    still : float, default 1e-9
        Spread of targets, relative to their size, below which no gain can be estimated.

    """
    x, y = target.double(), mean.double()
    x, y = x - x.mean(dim=0), y - y.mean(dim=0)
    power = x.square().sum(dim=0)
    least = still * target.double().square().sum(dim=0)
    return torch.where(power > least, (x * y).sum(dim=0) / power.clamp_min(1e-300), 0.0).float()
