"""`DeviceTwin`: a corrected twin on a torch device, such as a GPU, where its records stay.

A network that is trained on a GPU needs no records in the memory of the processor. From commands to
records everything is computed on the device, except what is small: the edges of the segments, and
the effect of faults on the trajectories that have one.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.checks import instance, require, whole
from retwin.data.segments import Segments
from retwin.errors import InputError, brief
from retwin.twins.commands.range import SMALLEST_POWER, CommandRange, chosen_for_spectra
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.applied_faults import draw_faults, faulty_commands, frozen_from
from retwin.twins.faults.system_faults import TimedFault, check_faults, measured_with
from retwin.twins.twin import checked_commands, checked_seed
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Context, measuring
from retwin.update.corrections.tensor_segments import TensorSegments
from retwin.update.surrogate import Surrogate
from retwin.update.training_range import training_checked

TRAJECTORIES = 1024
"""Trajectories that are simulated together by default."""


class Records(NamedTuple):
    """What `DeviceTwin.records` gives, both (n, T, d_y) in float32 on the device.

    Attributes
    ----------
    nominal : Tensor
        The surrogate's outputs for the commands without faults.
    observed : Tensor
        The corrected outputs with the faults, as the sensor records them.

    """

    nominal: Tensor
    observed: Tensor


class DeviceTwin:
    """A copy of a corrected twin on a torch device: from commands to records, which stay there.

    Parameters
    ----------
    twin : CorrectedTwin
        One with a neural surrogate.
    device : str or torch.device
        "cuda", "cuda:1", or "cpu", where `CorrectedTwin.simulate` takes a fraction of the time.

    Attributes
    ----------
    twin : CorrectedTwin
        As given.
    device : torch.device
        The device.

    Raises
    ------
    InputError
        Another twin, or a device that this installation of torch cannot use.

    """

    def __init__(self, twin: CorrectedTwin, device: str | torch.device) -> None:
        instance("twin", twin, CorrectedTwin, remedy="fit a residual model, and give CorrectedTwin")
        neural = isinstance(twin.surrogate, Surrogate)
        expected = "a corrected twin with a neural surrogate"
        got = f"one with {type(twin.surrogate).__name__} in its place"
        remedy = "train one with fit_surrogate, or simulate this twin on the processor"
        require(neural, "twin", expected=expected, got=got, remedy=remedy)
        self.twin = twin
        self.device = _usable(device)
        self._surrogate = copy.deepcopy(twin.surrogate).to(self.device)
        self._residual = copy.deepcopy(twin.residual).to(self.device)

    @torch.no_grad()
    def records(
        self,
        commands: NDArray | Tensor,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        chunk: int = TRAJECTORIES,
    ) -> Records:
        """Simulate as `CorrectedTwin.simulate` does, with noise of the device's own generator.

        Parameters
        ----------
        commands : ndarray or Tensor, shape (n, T, d_u)
            Commands in the units of the twin's inputs, T at least 2, on any device.
        faults : sequence of Fault or None, optional
            One per trajectory, None for a healthy one; by default all are healthy. Severities are
            those of `CorrectedTwin.simulate` with the same seed.
        seed : int
            At least 0.
        chunk : int
            Trajectories that are simulated together, at least 1: more need more memory. The draws
            depend on it. On "cpu", 128 gives those of `CorrectedTwin.simulate`, up to rounding.

        Returns
        -------
        Records
            Nominal and observed outputs, in the order of the commands.

        Raises
        ------
        InputError
            Commands of another width or not finite; not one fault per trajectory; a seed or a
            chunk that is no whole number; outputs that are not finite.

        Warns
        -----
        OutsideTrainingWarning
            Commands are outside the training range of the surrogate.

        """
        sent, twin = self._send(commands), self.twin
        generator = torch.Generator(self.device).manual_seed(checked_seed(seed))
        size = whole("chunk", chunk, at_least=1, remedy="leave it out")
        faults = [None] * len(sent) if faults is None else faults
        check_faults(faults, len(twin.inputs), len(twin.outputs), ())
        self._check_range(sent)
        segments = segments_of(sent)
        drawn = draw_faults(faults, segments, seed, rate=twin.rate)
        shape = *sent.shape[:2], len(twin.outputs)
        made = Records(sent.new_empty(shape), sent.new_empty(shape))
        for begin in range(0, len(sent), size):
            rows = slice(begin, begin + size)
            context = self._context(sent[rows], drawn[rows], segments[rows])
            made.nominal[rows] = context.nominal
            made.observed[rows] = self._measure(context, drawn[rows], generator)
        _check_finite(made)
        return made

    def _send(self, commands: NDArray | Tensor) -> Tensor:
        """The commands on the device, checked."""
        if not isinstance(commands, Tensor):
            commands = torch.from_numpy(np.array(checked_commands(commands, self.twin.inputs)))
        width = len(self.twin.inputs)
        shaped = commands.ndim == 3 and len(commands) > 0 and commands.shape[1] >= 2
        suits = shaped and commands.shape[2] == width and commands.is_floating_point()
        require(
            bool(suits and commands.isfinite().all()),
            "commands",
            expected=f"finite numbers of shape (n, T, {width}), T at least 2",
            got=f"{commands.dtype} of shape {tuple(commands.shape)}"
            + (", some not finite" if suits else ""),
            remedy=f"give one column per input channel, {', '.join(self.twin.inputs.names)}",
        )
        return commands.to(self.device, torch.float32)

    def _check_range(self, sent: Tensor) -> None:
        """Warn of commands outside the training range, which the processor then describes."""
        trained = self._surrogate.trained
        if isinstance(trained, CommandRange) and may_be_outside(trained, sent, self.twin.rate):
            with training_checked(self.twin.surrogate, sent.cpu().numpy()):
                pass

    def _context(self, sent: Tensor, faults: Sequence[Fault | None], segments: Segments) -> Context:
        """The context of a chunk on the device."""
        rate, (count, steps, width) = self.twin.rate, sent.shape
        nominal = path = self._surrogate(sent)
        faulty, frozen = sent, torch.full((count, width), steps, device=self.device)
        rows = [i for i, fault in enumerate(faults) if fault is not None]
        if rows:
            some = [faults[i] for i in rows]
            changed = faulty_commands(sent[rows].cpu().numpy(), some, segments[rows], rate=rate)
            faulty = sent.clone()
            faulty[rows] = torch.from_numpy(changed).to(self.device)
            since = frozen_from(faults, steps, width, rate=rate)
            frozen = torch.from_numpy(since).to(self.device)
            time = torch.arange(steps, device=self.device)[:, None]
            path = self._surrogate(faulty.gather(1, torch.minimum(time, frozen[:, None])))
        if self._residual.segmentation == "path":
            segments = Segments.from_path(nominal.cpu().numpy())
        on = cast(Segments, TensorSegments.on(self.device, segments))
        return Context(self._surrogate, sent, faulty, frozen, nominal, on, rate, path)

    def _measure(
        self, context: Context, faults: Sequence[Fault | None], generator: torch.Generator
    ) -> Tensor:
        """The record (n, T, d_y) of a chunk; faults of sensors act on the processor."""
        correction = self._residual.correction
        if self.twin.random:
            z = self._residual.sample(context, generator=generator)
            outputs = measuring(correction, context, generator)(z)
        else:
            outputs = correction.apply(context, self._residual.mean(context))
        rows = [i for i, fault in enumerate(faults) if isinstance(fault, TimedFault)]
        if rows:
            values, some = outputs[rows].cpu().numpy(), [faults[i] for i in rows]
            changed = measured_with(values, some, self.twin.rate)
            outputs[rows] = torch.from_numpy(changed).to(outputs)
        return outputs


def segments_of(commands: Tensor, tolerance: float = 1e-6) -> Segments:
    """`Segments.from_commands` of commands (n, T, d_u) on any device, whose edges alone leave it.

    See there for the tolerance.
    """
    extent = commands.amax(dim=(0, 1)) - commands.amin(dim=(0, 1))
    smallest = tolerance * torch.where(extent > 0, extent.double(), 1.0)
    edges = []
    for begin in range(0, len(commands), TRAJECTORIES):
        some = commands[begin : begin + TRAJECTORIES]
        moving = (some.diff(dim=1).abs() > smallest.to(some)).any(dim=2)
        padded = torch.nn.functional.pad(moving, (1, 1))
        rows, samples = (padded[:, 1:] != padded[:, :-1]).nonzero().cpu().numpy().T
        edges.append((rows + begin, samples))

    def speed(row: NDArray, step: NDArray) -> NDArray:
        rows, steps = (torch.from_numpy(each).to(commands.device) for each in (row, step))
        after, before = (commands[rows, steps + i].double() for i in (1, 0))
        return (after - before).abs().sum(dim=1).cpu().numpy()

    row, edge = (np.concatenate(each) for each in zip(*edges, strict=True))
    return Segments.from_edges(len(commands), commands.shape[1], row, edge, speed)


def may_be_outside(trained: CommandRange, commands: Tensor, rate: float) -> bool:
    """Whether commands (n, T, d_u) leave a range, found on their device.

    Up to rounding this is whether any of `CommandRange.scores` is above 1.
    """
    low, high, fastest = (torch.as_tensor(each).to(commands.device) for each in trained.bounds)
    least, greatest = commands.amin(dim=(0, 1)), commands.amax(dim=(0, 1))
    speed = rate * commands.diff(dim=1).abs().amax(dim=(0, 1))
    if bool(((least < low) | (greatest > high) | (speed > fastest)).any()):
        return True
    if not np.isfinite(trained.band).all():
        return False
    steps = commands.shape[1]
    some = commands[torch.from_numpy(chosen_for_spectra(len(commands))).to(commands.device)]
    window = torch.hann_window(steps + 2, periodic=False, device=some.device)[1:-1, None]
    spectra = torch.fft.rfft((some - some.mean(dim=1, keepdim=True)) * window, dim=1).abs().square()
    frequency = torch.fft.rfftfreq(steps, 1 / rate, device=some.device)[:, None]
    known = trained.band_limit(rate / steps), np.array(trained.power), trained.largest_share
    limit, power, share = (torch.from_numpy(each).to(some.device) for each in known)
    above = (spectra * (frequency > limit)).sum(dim=1)
    scale = 2 / steps / window.square().sum()
    whole = spectra.sum(dim=1) + SMALLEST_POWER * power / scale
    return bool((above > share * whole).any())


def _usable(device: str | torch.device) -> torch.device:
    """The device, if torch has a generator and double precision there."""
    try:
        found = torch.device(device)
        torch.zeros(1, dtype=torch.float64, device=torch.Generator(found).device)
    except (AssertionError, NotImplementedError, RuntimeError, TypeError) as error:
        expected = "a device with double precision that this installation of torch can use"
        got = f"{device} ({brief(error)})"
        remedy = "give 'cpu', or install torch for that device"
        raise InputError("device", expected=expected, got=got, remedy=remedy) from error
    return found


def _check_finite(made: Records) -> None:
    wrong = ~(made.nominal.isfinite() & made.observed.isfinite()).flatten(1).all(dim=1)
    expected = "commands for which the twin's outputs are finite"
    got = f"NaN or an infinite output in {int(wrong.sum())} of {len(wrong)} trajectories, first "
    got += f"in trajectory {int(wrong.byte().argmax())}"
    remedy = "simulate it with CorrectedTwin.simulate, which names the output and the time"
    require(not bool(wrong.any()), "commands", expected=expected, got=got, remedy=remedy)
