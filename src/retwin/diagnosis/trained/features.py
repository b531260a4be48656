"""`Features`: the input of a diagnoser that is trained, x = concat(ŷ, r) (Eq. 11)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.arrays import row_blocks
from retwin.checks import agree, require, whole
from retwin.data.segments import Segments
from retwin.data.trajectories import Channels, Trajectories
from retwin.times import sample_rate, stride_of

SETTLED = 2
"""Samples of the features, from the end of the first motion on, that are still hidden: one for the
delay of the response, and one because a value interpolated between two sensor samples depends on
the earlier one."""

MAX_STRIDE = 10**6
"""The largest stride that is read from a file, so that its phases fit the memory."""


@dataclass(frozen=True)
class Features:
    """concat(ŷ, r) at every `stride`-th sample; r = observed − ŷ is 0 where missing.

    Attributes
    ----------
    outputs : Channels
        The d_y output channels of the trajectories.
    rate : float
        Sample rate of the trajectories in Hz.
    stride : int
        Samples of the trajectories per sample of the features: the true rate of a sensor is often
        lower than that of the file.
    hide_start : bool
        Whether all samples before the end of the first motion are hidden: ŷ is then constant at
        its value at that end, and r is 0.

    Notes
    -----
    The initial pose of a recording may reveal its label, because the motors of a rig rest where
    the previous experiment left them. A diagnoser that learns from real trajectories must not use
    that. The pose appears in the nominal as well as in the measured path, and until the first
    motion ends: so `hide_start` hides both, until then.

    """

    outputs: Channels
    rate: float
    stride: int = 1
    hide_start: bool = False

    @classmethod
    def at(
        cls, trajectories: Trajectories, rate: float | None = None, *, hide_start: bool = False
    ) -> Features:
        """The features of trajectories like these at a given rate.

        Parameters
        ----------
        trajectories : Trajectories
            Their output channels and sample rate are taken.
        rate : float, optional
            Sample rate of the features in Hz; by default the lowest that keeps a hundred samples
            of each trajectory.
        hide_start : bool
            See the class.

        Raises
        ------
        InputError
            If the rate of the trajectories is no whole multiple of `rate`, or fewer than two
            samples of them remain.

        """
        steps = trajectories.steps
        if rate is None:
            # Samples of a trajectory that the features keep at least, unless their rate is given: a
            # trajectory in some detail, while a network with memory learns in minutes.
            stride = min(max(1, steps // 100), MAX_STRIDE)
        else:
            stride = stride_of(trajectories.rate, rate, steps=steps)
        return cls(trajectories.outputs, trajectories.rate, stride, hide_start)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Features:
        """From the plain values that `about` returned; other keys have no effect."""
        return cls(
            Channels.of(values["outputs"]),
            sample_rate("rate", values["rate"]),
            whole("stride", values["stride"], at_least=1, at_most=MAX_STRIDE),
            values.get("hide_start", False),
        )

    def about(self) -> dict[str, Any]:
        """The fields as plain values, for JSON."""
        return asdict(self)

    @property
    def width(self) -> int:
        """Number of channels of the features, 2 d_y."""
        return 2 * len(self.outputs)

    def __call__(self, trajectories: Trajectories) -> Tensor:
        """The features of n trajectories.

        Returns
        -------
        Tensor
            (n, T', 2 d_y), float32.

        Raises
        ------
        InputError
            If the output channels or the rate differ, or if the start is to be hidden and there
            are no commands.

        """
        return self._sample(trajectories, np.arange(0, trajectories.steps, self.stride))

    def phases(self, trajectories: Trajectories) -> Tensor:
        """The features at each of the `stride` phases at which a sensor may sample.

        They show the same segments at other samples, which augments a training set.

        Returns
        -------
        Tensor
            (n, stride, T', 2 d_y), float32.

        Raises
        ------
        InputError
            As the call does.

        """
        first = np.arange(0, trajectories.steps, self.stride)
        time = np.minimum(np.arange(self.stride)[:, None] + first, trajectories.steps - 1)
        return self._sample(trajectories, time.ravel()).unflatten(1, time.shape)

    def _sample(self, trajectories: Trajectories, time: NDArray) -> Tensor:
        """Features at the samples `time`, (n, len(time), 2 d_y), computed block by block."""
        remedy = "resample or rename, or train on data like these"
        whose = "what the diagnoser was trained on"
        agree("trajectories", trajectories, self, whose, names=("outputs", "rate"), remedy=remedy)
        settled = self._find_settled(trajectories) if self.hide_start else None
        found = np.empty((len(trajectories), len(time), self.width), np.float32)
        for rows in row_blocks(trajectories.nominal):
            nominal = trajectories.nominal[rows][:, time]
            there = trajectories.mask[rows][:, time]
            residual = np.where(there, trajectories.observed[rows][:, time] - nominal, 0.0)
            if settled is not None:
                hidden = (time < settled[rows, None])[:, :, None]
                place = settled[rows, None, None]
                at_rest = np.take_along_axis(trajectories.nominal[rows], place, axis=1)
                nominal = np.where(hidden, at_rest, nominal)
                residual = np.where(hidden, 0.0, residual)
            found[rows] = np.concatenate([nominal, residual], axis=2)
        return torch.from_numpy(found)

    def _find_settled(self, trajectories: Trajectories) -> NDArray:
        """The sample (n,) up to which the start is hidden; the last one if nothing moves."""
        fits = trajectories.commands.shape[2] > 0
        expected = "commands, which show when the first motion ends"
        remedy = "recover them, or take a diagnoser that does not hide the start"
        require(fits, "trajectories.commands", expected=expected, got="none", remedy=remedy)
        segments = Segments.from_commands(trajectories.commands)
        if segments.max_count == 0:
            return np.full(len(trajectories), trajectories.steps - 1)
        end = np.ceil(segments.settle[:, 0]).astype(int) + SETTLED * self.stride
        return np.minimum(end, trajectories.steps - 1)


def random_phase(phases: Tensor, generator: torch.Generator) -> Tensor:
    """One random phase of each example: (b, stride, T', d) in, (b, T', d) out."""
    phase = torch.randint(phases.shape[1], (len(phases),), generator=generator)
    return phases[torch.arange(len(phases)), phase]


def class_names(values: Sequence[object]) -> tuple[str, ...]:
    """Class names as a model folder holds them; InputError unless they are texts that differ."""
    fits = all(isinstance(value, str) for value in values) and len(set(values)) == len(values)
    expected = "names of classes, each once"
    require(fits, "classes", expected=expected, got=repr(values), remedy="save the model again")
    return tuple(map(str, values))


def class_order(
    trajectories: Trajectories, classes: Sequence[str] | None = None
) -> tuple[str, ...]:
    """The class names in the order of the probabilities; by default sorted.

    Raises
    ------
    InputError
        If a trajectory has no label or one that is not among `classes`, or if there are fewer
        than two classes.

    """
    labels = trajectories.known_labels
    order = tuple(classes) if classes is not None else tuple(sorted(labels))
    unknown = labels - set(order)
    require(
        len(labels) >= 2 and not unknown and "" not in trajectories.labels,
        "trajectories",
        expected=f"labelled trajectories of at least two of the classes {', '.join(order)}",
        got=f"unknown {sorted(unknown)}"
        if unknown
        else f"labels {sorted(set(trajectories.labels.tolist()))}",
        remedy="label every trajectory with a known class",
    )
    return order


def class_index(trajectories: Trajectories, order: Sequence[str]) -> Tensor:
    """The labels (n,) as indices into `order`."""
    return torch.tensor([list(order).index(label) for label in trajectories.labels])
