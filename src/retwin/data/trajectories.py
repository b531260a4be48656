"""`Trajectories`: commands, nominal and observed outputs of n runs; frozen, checked when made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import check_finite, check_shapes, floating, measured, named, row_blocks
from retwin.errors import InputError

__all__ = ["HEALTHY", "UNLABELLED", "Channels", "Provenance", "Trajectories"]

PER_TRAJECTORY = ("commands", "nominal", "observed", "mask", "labels", "ids")
"""The fields with one entry per trajectory."""
UNLABELLED = ""
"""The label of trajectories whose class is not known."""
HEALTHY = "Healthy"
"""The label of trajectories without a fault."""


@dataclass(frozen=True)
class Channels:
    """Names and units of the columns of an array."""

    names: tuple[str, ...]
    units: tuple[str, ...]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.units) or len(set(self.names)) != len(self.names):
            raise InputError(
                "channels",
                expected="one unit per name and no name twice",
                got=f"names {list(self.names)}, units {list(self.units)}",
                remedy="name every channel once and give each a unit ('1' when it has none)",
            )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def comparable(self) -> bool:
        """Whether numbers of different channels compare: all have one unit, which "1" is not.

        A single channel compares with itself.
        """
        return len(self) == 1 or (len(set(self.units)) == 1 and self.units[0] != "1")

    @classmethod
    def of(cls, values: Mapping[str, Sequence[str]]) -> Channels:
        """The channels that `vars` of one gave, JSON lists or tuples alike."""
        return cls(tuple(values["names"]), tuple(values["units"]))

    @classmethod
    def numbered(cls, prefix: str, count: int, unit: str = "1") -> Channels:
        """Channels `prefix`1 … `prefix`count, all with the same unit."""
        return cls(tuple(f"{prefix}{i + 1}" for i in range(count)), (unit,) * count)


@dataclass(frozen=True)
class Provenance:
    """Where data came from: a file name and its SHA-256, or the maker's name with a seed."""

    name: str
    sha256: str = ""


@dataclass(frozen=True, eq=False)
class Trajectories:
    """A set of trajectories on one time grid.

    Attributes
    ----------
    commands: (n, T, d_u), what the actuators were told; d_u = 0 when a file does not say.
    nominal: (n, T, d_y), the ideal output for the clean commands.
    observed: (n, T, d_y), the measured or simulated output; 0 where it is missing.
    mask: (n, T, d_y) bool, True where `observed` is a measurement.
    labels: (n,) class names, "" where unlabelled.
    ids: (n,) unique names.
    rate: samples per second.
    inputs, outputs: names and units of the command and output channels.
    provenance: the files or makers the data came from.
    emulated: True when `observed` stands for a real system's measurements but a model made it.

    Arrays are read-only. Shorter trajectories are padded (`padded`): mask False, commands held.
    NaN in `observed` means missing and goes to the mask.

    Raises
    ------
    InputError: shapes that disagree, NaN or infinite commands or nominal outputs, infinite
        observations, a rate that is not positive, ids that repeat.

    """

    commands: NDArray
    nominal: NDArray
    observed: NDArray
    rate: float
    # None asks for the default; after the checks these are never None, so their types say so.
    mask: NDArray = None  # type: ignore[assignment]
    labels: NDArray = None  # type: ignore[assignment]
    ids: NDArray = None  # type: ignore[assignment]
    inputs: Channels = None  # type: ignore[assignment]
    outputs: Channels = None  # type: ignore[assignment]
    provenance: tuple[Provenance, ...] = field(default=())
    emulated: bool = False

    def __post_init__(self) -> None:
        commands = floating("commands", self.commands)
        nominal = floating("nominal", self.nominal)
        observed = floating("observed", self.observed)
        check_shapes(commands, nominal, observed)
        check_finite("commands", commands)
        check_finite("nominal", nominal)
        observed, mask = measured(observed, self.mask)
        if not (isinstance(self.rate, Real) and np.isfinite(self.rate) and self.rate > 0):
            raise InputError(
                "rate",
                expected="a positive number of samples per second",
                got=repr(self.rate),
                remedy="give the sample rate in Hz",
            )
        n = len(commands)
        labels = named("labels", self.labels, [UNLABELLED] * n)
        ids = named("ids", self.ids, [f"{i:05d}" for i in range(n)])
        if len(set(ids.tolist())) != n:
            raise InputError(
                "ids",
                expected="one unique name per trajectory",
                got="a name that repeats",
                remedy="leave ids out to have them numbered",
            )
        inputs = self.inputs or Channels.numbered("u", commands.shape[2])
        outputs = self.outputs or Channels.numbered("y", nominal.shape[2])
        for name, channels, width in (
            ("inputs", inputs, commands.shape[2]),
            ("outputs", outputs, nominal.shape[2]),
        ):
            if len(channels) != width:
                raise InputError(
                    name,
                    expected=f"{width} channels, as the array has columns",
                    got=f"{len(channels)}: {list(channels.names)}",
                    remedy="name every column",
                )
        checked = (commands, nominal, observed, mask, labels, ids)
        for name, array in zip(PER_TRAJECTORY, checked, strict=True):
            array = array.view()
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "rate", float(self.rate))
        object.__setattr__(self, "inputs", inputs)
        object.__setattr__(self, "outputs", outputs)
        object.__setattr__(self, "provenance", tuple(self.provenance))

    def __len__(self) -> int:
        return len(self.commands)

    def __repr__(self) -> str:
        kind = " emulated" if self.emulated else ""
        return (
            f"Trajectories({len(self)}{kind}, {self.steps} samples at {self.rate:g} Hz, "
            f"commands {self.commands.shape[2]}, outputs {self.nominal.shape[2]})"
        )

    @property
    def steps(self) -> int:
        """Samples per trajectory, T."""
        return self.commands.shape[1]

    @property
    def lengths(self) -> NDArray:
        """(n,) samples of each, after which nothing is measured nor commanded anew: padding.

        All T where nothing was measured at all, as with a twin that was asked for `nominal` only.
        """
        found = np.empty(len(self), dtype=int)
        for rows in row_blocks(max(self.commands, self.nominal, key=lambda each: each.nbytes)):
            commands, eventful = self.commands[rows], np.any(self.mask[rows], axis=2)
            nothing = ~np.any(eventful, axis=1)
            eventful[:, 1:] |= (commands[:, 1:] != commands[:, :-1]).any(axis=2)
            found[rows] = self.steps - (eventful | nothing[:, None])[:, ::-1].argmax(axis=1)
        return found

    @property
    def residual(self) -> NDArray:
        """(n, T, d_y) observed minus nominal (Eq. 11), 0 where nothing was measured."""
        return np.where(self.mask, self.observed - self.nominal, 0).astype(self.nominal.dtype)

    @property
    def known_labels(self) -> frozenset[str]:
        """The class names that occur."""
        return frozenset(self.labels.tolist()) - {UNLABELLED}

    def __getitem__(self, index: slice | Sequence[int] | NDArray) -> Trajectories:
        """The trajectories at `index`: a slice, whole numbers or flags."""
        if not isinstance(index, slice):
            index = np.atleast_1d(index)
            if index.size == 0:
                index = index.astype(int)  # an empty list is float to numpy, which indexes nothing
        return self.replace(**{name: getattr(self, name)[index] for name in PER_TRAJECTORY})

    def replace(self, **changes: Any) -> Trajectories:
        """A copy with some attributes changed, checked again."""
        return replace(self, **changes)

    def padded(self, steps: int) -> Trajectories:
        """The same with `steps` samples each: the last values held, and nothing measured there.

        Raises InputError for fewer samples than there are.
        """
        more = steps - self.steps
        if more < 0:
            raise InputError(
                "steps",
                expected=f"at least {self.steps}, the samples that there are",
                got=repr(steps),
                remedy="padding only makes trajectories longer",
            )
        longer = ((0, 0), (0, more), (0, 0))
        return self.replace(
            commands=np.pad(self.commands, longer, mode="edge"),
            nominal=np.pad(self.nominal, longer, mode="edge"),
            observed=np.pad(self.observed, longer),
            mask=np.pad(self.mask, longer),
        )

    def with_label(self, label: str) -> Trajectories:
        """Those of class `label`."""
        return self[self.labels == label]

    def split(self, fraction: float, *, seed: int) -> tuple[Trajectories, Trajectories]:
        """Two disjoint parts by trajectory, stratified by class, `fraction` in the first.

        Raises InputError when `fraction` is not strictly between 0 and 1.
        """
        first, second = self.split_index(fraction, seed=seed)
        return self[first], self[second]

    def split_index(self, fraction: float, *, seed: int) -> tuple[NDArray, NDArray]:
        """The sorted indices of the two parts that `split` gives."""
        if not 0 < fraction < 1:
            raise InputError(
                "fraction",
                expected="a number strictly between 0 and 1",
                got=repr(fraction),
                remedy="give the share of the first part",
            )
        rng = np.random.default_rng(seed)
        first = np.zeros(len(self), dtype=bool)
        taken = 0.0
        for label in np.unique(self.labels):
            members = rng.permutation(np.flatnonzero(self.labels == label))
            # Carry the rounding over, so that the whole share is right and not only each class's.
            taken += fraction * len(members)
            count = int(np.clip(round(taken), 0, len(members)))
            taken -= count
            first[members[:count]] = True
        return np.flatnonzero(first), np.flatnonzero(~first)

    def folds(self, count: int, *, seed: int) -> list[tuple[NDArray, NDArray]]:
        """`count` pairs (calibration, test) of sorted indices, stratified by class.

        Every trajectory is in exactly one test part. Raises InputError when `count` is below 2 or
        above the number of trajectories.
        """
        if not (isinstance(count, Integral) and 2 <= count <= len(self)):
            raise InputError(
                "folds",
                expected=f"a whole number from 2 to {len(self)}, the number of trajectories",
                got=repr(count),
                remedy="give fewer folds or more data",
            )
        rng = np.random.default_rng(seed)
        fold = np.empty(len(self), dtype=int)
        dealt = 0
        for label in np.unique(self.labels):
            members = rng.permutation(np.flatnonzero(self.labels == label))
            fold[members] = (dealt + np.arange(len(members))) % count
            dealt += len(members)
        return [(np.flatnonzero(fold != k), np.flatnonzero(fold == k)) for k in range(count)]

    @staticmethod
    def concatenate(sets: Sequence[Trajectories]) -> Trajectories:
        """All trajectories of several sets, padded to the longest, renumbered when ids repeat.

        Raises InputError when rates or channels differ, or there is no set.
        """
        if not sets:
            raise InputError(
                "sets",
                expected="at least one set of trajectories",
                got="none",
                remedy="give the sets to join",
            )
        first = sets[0]
        for other in sets[1:]:
            for name in ("rate", "inputs", "outputs"):
                if getattr(other, name) != getattr(first, name):
                    raise InputError(
                        name,
                        expected=f"the same in every set, {getattr(first, name)}",
                        got=f"{getattr(other, name)}",
                        remedy="resample or rename before joining",
                    )

        longest = max(each.steps for each in sets)
        sets = [each.padded(longest) for each in sets]
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(each, name) for each in sets]) for name in PER_TRAJECTORY
        }
        if len(set(joined["ids"].tolist())) < len(joined["ids"]):
            joined["ids"] = None
        return first.replace(
            **joined,
            provenance=tuple(dict.fromkeys(s for each in sets for s in each.provenance)),
            emulated=any(each.emulated for each in sets),
        )
