"""`Features`: what a diagnoser that learns looks at, x = concat(ŷ, r) (Eq. 11)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.arrays import row_blocks
from retwin.data.segments import Segments
from retwin.data.trajectories import Channels, Trajectories
from retwin.errors import InputError

__all__ = ["Features", "class_index", "class_order", "one_view"]

SETTLED = 2
"""Readings of the sensor from the end of the first motion until it is hidden no more: one for the
response's delay, one because a value between two readings still holds some of the earlier."""


@dataclass(frozen=True)
class Features:
    """concat(ŷ, r) at every `stride`-th sample; r = observed − ŷ is 0 where missing.

    Parameters
    ----------
    outputs: channels of the trajectories it takes.
    rate: samples per second of the trajectories it takes.
    stride: every how many samples it looks; the sensor's true rate is often lower than the file's.
    hide_start: whether everything before the first movement has come to rest is hidden: ŷ is then
        what it is at that moment, r is 0. Where a recording began may tell its label (the motors
        of a rig rest where the fault of the run before left them), so whatever learns from real
        trajectories must not see it. The desired path shows it as well as the measured one, and
        shows it until the first motion ends: hence not r alone, and not the time at rest alone.

    """

    outputs: Channels
    rate: float
    stride: int = 1
    hide_start: bool = False

    @classmethod
    def at(
        cls, trajectories: Trajectories, rate: float | None = None, *, hide_start: bool = False
    ) -> Features:
        """Features of trajectories like these, at `rate` Hz: by default 10, or theirs if lower.

        Raises InputError when the rate is no whole part of the trajectories'.
        """
        stride = _stride(trajectories.rate, min(10.0, trajectories.rate) if rate is None else rate)
        return cls(trajectories.outputs, trajectories.rate, stride, hide_start)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Features:
        """From the values that `asdict` gave; other ones beside them are left alone."""
        return cls(
            Channels.of(values["outputs"]),
            values["rate"],
            values["stride"],
            values.get("hide_start", False),
        )

    def about(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        return asdict(self)

    @property
    def width(self) -> int:
        """Channels of the features, 2 d_y."""
        return 2 * len(self.outputs)

    def __call__(self, trajectories: Trajectories) -> Tensor:
        """Features (n, T', 2 d_y), float32.

        Raises
        ------
        InputError: other output channels or another rate; no commands, where the start is hidden.

        """
        return self._read(trajectories, np.arange(0, trajectories.steps, self.stride))

    def views(self, trajectories: Trajectories) -> Tensor:
        """The features (n, stride, T', 2 d_y) from every sample on at which a sensor may begin.

        They are the same movements, read otherwise: more to learn from, and of the same class.
        Raises as the call does.
        """
        first = np.arange(0, trajectories.steps, self.stride)
        time = np.minimum(np.arange(self.stride)[:, None] + first, trajectories.steps - 1)
        return self._read(trajectories, time.ravel()).unflatten(1, time.shape)

    def _read(self, trajectories: Trajectories, time: NDArray) -> Tensor:
        """Features at these samples, (n, len(time), 2 d_y); made block by block."""
        self._check(trajectories)
        settled = self._settled(trajectories) if self.hide_start else None
        found = np.empty((len(trajectories), len(time), self.width), np.float32)
        for rows in row_blocks(trajectories.nominal):
            nominal = trajectories.nominal[rows][:, time]
            there = trajectories.mask[rows][:, time]
            residual = np.where(there, trajectories.observed[rows][:, time] - nominal, 0.0)
            if settled is not None:
                hidden = (time < settled[rows, None])[:, :, None]
                at_rest = np.take_along_axis(
                    trajectories.nominal[rows], settled[rows, None, None], axis=1
                )
                nominal = np.where(hidden, at_rest, nominal)
                residual = np.where(hidden, 0.0, residual)
            found[rows] = np.concatenate([nominal, residual], axis=2)
        return torch.from_numpy(found)

    def _settled(self, trajectories: Trajectories) -> NDArray:
        """The sample (n,) at which the first movement has come to rest; the last where none is."""
        if trajectories.commands.shape[2] == 0:
            raise InputError(
                "trajectories.commands",
                expected="commands, which tell when the first movement ends",
                got="none",
                remedy="recover them, or take a diagnoser that does not hide the start",
            )
        segments = Segments.from_commands(trajectories.commands)
        if segments.max_count == 0:
            return np.full(len(trajectories), trajectories.steps - 1)
        end = np.ceil(segments.settle[:, 0]).astype(int) + SETTLED * self.stride
        return np.minimum(end, trajectories.steps - 1)

    def _check(self, trajectories: Trajectories) -> None:
        for name, ours, theirs in (
            ("outputs", self.outputs, trajectories.outputs),
            ("rate", self.rate, trajectories.rate),
        ):
            if ours != theirs:
                raise InputError(
                    f"trajectories.{name}",
                    expected=f"what the diagnoser was trained on, {ours}",
                    got=f"{theirs}",
                    remedy="resample or rename, or train on data like these",
                )


def one_view(views: Tensor, generator: torch.Generator) -> Tensor:
    """One phase of each example, drawn at random: (b, stride, T', d) in, (b, T', d) out."""
    phase = torch.randint(views.shape[1], (len(views),), generator=generator)
    return views[torch.arange(len(views)), phase]


def class_order(
    trajectories: Trajectories, classes: Sequence[str] | None = None
) -> tuple[str, ...]:
    """The classes to learn, in their order; by default sorted by name.

    Raises
    ------
    InputError: unlabelled trajectories, fewer than two classes, a label not among `classes`.

    """
    named = trajectories.known_labels
    order = tuple(classes) if classes is not None else tuple(sorted(named))
    unknown = named - set(order)
    if len(named) < 2 or unknown or "" in trajectories.labels:
        raise InputError(
            "trajectories",
            expected=f"labelled trajectories of at least two of the classes {', '.join(order)}",
            got=f"unknown {sorted(unknown)}"
            if unknown
            else f"labels {sorted(set(trajectories.labels))}",
            remedy="label every trajectory with a known class",
        )
    return order


def class_index(trajectories: Trajectories, order: Sequence[str]) -> Tensor:
    """The labels (n,) as places in `order`."""
    return torch.tensor([list(order).index(label) for label in trajectories.labels])


def _stride(given: float, wanted: float) -> int:
    """Every how many samples at `given` Hz make `wanted` Hz."""
    stride = given / wanted if wanted > 0 else 0.0
    if stride < 1 or abs(stride - round(stride)) > 1e-6:
        raise InputError(
            "rate",
            expected=f"{given:g} Hz, the data's rate, or a whole part of it",
            got=f"{wanted:g} Hz",
            remedy="choose a rate that takes every sample, every second, every third …",
        )
    return round(stride)
