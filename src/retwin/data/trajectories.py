"""`Trajectories`: commands, nominal and observed outputs of n runs on one time grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import check_finite, check_shapes, floating, measured, named, row_blocks
from retwin.checks import agree, at_least, one_per, require, whole
from retwin.data.provenance import Provenance
from retwin.times import sample_rate, to_samples

__all__ = ["HEALTHY", "UNLABELLED", "Channels", "Provenance", "Trajectories"]

PER_TRAJECTORY = ("commands", "nominal", "observed", "mask", "labels", "ids")
"""The fields with one entry per trajectory."""
PER_SAMPLE = ("commands", "nominal", "observed", "mask")
"""The fields with one entry per sample."""
UNLABELLED = ""
"""The label of trajectories whose class is not known."""
UNKNOWN = "unknown"
"""The diagnosis of what is none of the classes."""
HEALTHY = "Healthy"
"""The label of trajectories without a fault."""


@dataclass(frozen=True)
class Channels:
    """Names and units of the columns of an array.

    Parameters
    ----------
    names : tuple of str
        Unique names.
    units : tuple of str
        A unit for each, "1" if it has none.

    Raises
    ------
    InputError
        A name repeats, or there is not one unit per name.

    """

    names: tuple[str, ...]
    units: tuple[str, ...]

    def __post_init__(self) -> None:
        texts = all(isinstance(text, str) for text in (*self.names, *self.units))
        paired = (
            texts and len(self.names) == len(self.units) and len(set(self.names)) == len(self.names)
        )
        expected = "texts, one unit per name and no name twice"
        got = f"names {list(self.names)}, units {list(self.units)}"
        remedy = "name every channel once and give each a unit ('1' when it has none)"
        require(paired, "channels", expected=expected, got=got, remedy=remedy)

    def __len__(self) -> int:
        return len(self.names)

    def __str__(self) -> str:
        pairs = zip(self.names, self.units, strict=True)
        return ", ".join(f"{name} [{unit}]" for name, unit in pairs) or "none"

    @property
    def comparable(self) -> bool:
        """Whether all channels have the same unit, other than "1", or there is only one channel."""
        return len(self) == 1 or (len(set(self.units)) == 1 and self.units[0] != "1")

    @classmethod
    def of(cls, values: Mapping[str, Sequence[str]]) -> Channels:
        """The channels of a mapping with `names` and `units`, as `vars` or JSON gives it."""
        return cls(tuple(values["names"]), tuple(values["units"]))

    @classmethod
    def numbered(cls, prefix: str, count: int, unit: str = "1") -> Channels:
        """Channels `prefix`1 … `prefix`count, all with the same unit."""
        return cls(tuple(f"{prefix}{i + 1}" for i in range(count)), (unit,) * count)


@dataclass(frozen=True, eq=False)
class Trajectories:
    """A set of trajectories on one time grid.

    Arrays are read-only. NaN in `observed` means a missing measurement and becomes a False in the
    mask. Shorter trajectories are padded (`padded`): commands held, mask False.

    Attributes
    ----------
    commands : (n, T, d_u) array
        The inputs that the actuators were given; d_u = 0 if a file does not hold them.
    nominal : (n, T, d_y) array
        The ideal outputs for fault-free commands.
    observed : (n, T, d_y) array
        The measured or simulated outputs, 0 where a measurement is missing.
    rate : float
        The sample rate in Hz.
    mask : (n, T, d_y) array of bool
        True where `observed` is a measurement.
    labels : (n,) array of str
        Class names, "" where unlabelled.
    ids : (n,) array of str
        Unique names.
    inputs, outputs : Channels
        Names and units of the commands and of the outputs.
    provenance : tuple of Provenance
        The files or simulators that the data came from.
    emulated : bool
        True if `observed` stands for measurements of a real system but a model simulated it.

    Raises
    ------
    InputError
        Shapes disagree, a command or nominal output is NaN or infinite, a measurement is infinite,
        the rate is not positive, or an id repeats.

    """

    commands: NDArray
    nominal: NDArray
    observed: NDArray
    rate: float
    # None stands for the default, which the checks put in its place.
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
        rate = sample_rate("rate", self.rate)
        n = len(commands)
        labels = named("labels", self.labels, [UNLABELLED] * n)
        ids = named("ids", self.ids, [f"{i:05d}" for i in range(n)])
        expected = "one unique name per trajectory"
        got = "a name that repeats"
        remedy = "leave ids out to have them numbered"
        require(len(set(ids.tolist())) == n, "ids", expected=expected, got=got, remedy=remedy)
        inputs = self.inputs or Channels.numbered("u", commands.shape[2])
        outputs = self.outputs or Channels.numbered("y", nominal.shape[2])
        for name, channels, width in (
            ("inputs", inputs, commands.shape[2]),
            ("outputs", outputs, nominal.shape[2]),
        ):
            one_per(name, channels, width, "column of the array", remedy="name every column")
        checked = (commands, nominal, observed, mask, labels, ids)
        arrays = {name: each.view() for name, each in zip(PER_TRAJECTORY, checked, strict=True)}
        for array in arrays.values():
            array.flags.writeable = False
        provenance = tuple(self.provenance)
        self.__dict__.update(
            arrays, rate=rate, inputs=inputs, outputs=outputs, provenance=provenance
        )

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
        """Samples (n,) of each trajectory without its padding: up to the last one that is measured
        or at which a command changes.

        T for a trajectory without any measurement, of which a twin computed `nominal` only.
        """
        found = np.empty(len(self), dtype=int)
        for rows in row_blocks(max(self.commands, self.nominal, key=lambda each: each.nbytes)):
            commands, used = self.commands[rows], np.any(self.mask[rows], axis=2)
            unmeasured = ~np.any(used, axis=1)
            used[:, 1:] |= (commands[:, 1:] != commands[:, :-1]).any(axis=2)
            found[rows] = self.steps - (used | unmeasured[:, None])[:, ::-1].argmax(axis=1)
        return found

    @property
    def measured(self) -> NDArray:
        """Observed outputs (n, T, d_y), NaN where nothing was measured."""
        return np.where(self.mask, self.observed, np.nan)

    @property
    def residual(self) -> NDArray:
        """Observed minus nominal outputs (n, T, d_y), Eq. 11; 0 where nothing was measured."""
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
        if changes.keys() == {"labels"}:  # the arrays, which take long to check, are the same
            labels = named("labels", changes["labels"], [UNLABELLED] * len(self)).view()
            labels.flags.writeable = False
            made = object.__new__(Trajectories)
            made.__dict__.update(self.__dict__, labels=labels)
            return made
        return replace(self, **changes)

    def padded(self, steps: int) -> Trajectories:
        """The same with `steps` samples each: the last values held, and the mask False.

        Raises
        ------
        InputError
            `steps` is smaller than T.

        """
        steps = whole("steps", steps, at_least=self.steps, remedy="padding makes them longer")
        longer = ((0, 0), (0, steps - self.steps), (0, 0))
        return self.replace(
            commands=np.pad(self.commands, longer, mode="edge"),
            nominal=np.pad(self.nominal, longer, mode="edge"),
            observed=np.pad(self.observed, longer),
            mask=np.pad(self.mask, longer),
        )

    def between(self, start: float = 0.0, stop: float | None = None) -> Trajectories:
        """The same from `start` to before `stop`, in s; by default until the end.

        Raises
        ------
        InputError
            The times are not in order, not within the trajectories, or less than two samples apart.

        """
        end = self.steps / self.rate
        times = (start, end if stop is None else stop)
        fits = 0 <= times[0] < times[1] <= end
        expected = f"times in s, in order, from 0 to {end:g}"
        remedy = "count the seconds from the first sample"
        require(fits, "start, stop", expected=expected, got=f"{start} to {stop}", remedy=remedy)
        span = slice(*(to_samples(each, self.rate) for each in times))
        arrays = {name: getattr(self, name)[:, span] for name in PER_SAMPLE}
        return self.replace(**arrays)

    @property
    def maybe_healthy(self) -> NDArray:
        """Which trajectories (n,) are labelled as healthy, or not labelled."""
        return np.isin(self.labels, (HEALTHY, UNLABELLED))

    def with_label(self, label: str) -> Trajectories:
        """The trajectories of class `label`."""
        return self[self.labels == label]

    def split(self, fraction: float, *, seed: int) -> tuple[Trajectories, Trajectories]:
        """Two disjoint sets of trajectories, stratified by class.

        Parameters
        ----------
        fraction : float
            The share of the first set, strictly between 0 and 1.
        seed : int
            The seed of the random permutation.

        Raises
        ------
        InputError
            `fraction` is out of range, or leaves a set without any trajectory.

        """
        first, second = self.split_index(fraction, seed=seed)
        expected = f"a share that leaves some of the {len(self)} trajectories to both sets"
        got = f"{fraction!r}, which gives {len(first)} and {len(second)}"
        remedy = "give another share, or more trajectories"
        require(len(first) and len(second), "fraction", expected=expected, got=got, remedy=remedy)
        return self[first], self[second]

    def split_index(self, fraction: float, *, seed: int) -> tuple[NDArray, NDArray]:
        """The sorted indices of the two sets that `split` gives."""
        expected = "a number strictly between 0 and 1"
        remedy = "give the share of the first part"
        require(0 < fraction < 1, "fraction", expected=expected, got=repr(fraction), remedy=remedy)
        rng = np.random.default_rng(seed)
        first = np.zeros(len(self), dtype=bool)
        taken = 0.0
        for label in np.unique(self.labels):
            members = rng.permutation(np.flatnonzero(self.labels == label))
            # The remainder of a class counts for the next, so that the total share is exact.
            taken += fraction * len(members)
            count = int(np.clip(round(taken), 0, len(members)))
            taken -= count
            first[members[:count]] = True
        return np.flatnonzero(first), np.flatnonzero(~first)

    def folds(self, count: int, *, seed: int) -> list[tuple[NDArray, NDArray]]:
        """The folds of a cross-validation, stratified by class.

        Parameters
        ----------
        count : int
            The number of folds, from 2 to the number of trajectories.
        seed : int
            The seed of the random permutation.

        Returns
        -------
        list of (array, array)
            For each fold, the sorted indices of its calibration set and of its test set. Every
            trajectory is in exactly one test set.

        Raises
        ------
        InputError
            `count` is out of range.

        """
        count = whole(
            "folds", count, at_least=2, at_most=len(self), remedy="give fewer folds or more data"
        )
        rng = np.random.default_rng(seed)
        fold = np.empty(len(self), dtype=int)
        assigned = 0
        for label in np.unique(self.labels):
            members = rng.permutation(np.flatnonzero(self.labels == label))
            fold[members] = (assigned + np.arange(len(members))) % count
            assigned += len(members)
        return [(np.flatnonzero(fold != k), np.flatnonzero(fold == k)) for k in range(count)]

    @staticmethod
    def concatenate(sets: Sequence[Trajectories]) -> Trajectories:
        """All trajectories of several sets, padded to the longest, renumbered if ids repeat.

        Raises
        ------
        InputError
            Sample rates or channels differ, or there is no set.

        """
        at_least("sets", sets, 1, "set of trajectories", remedy="give the sets to join")
        first, joining = sets[0], "resample or rename before joining"
        for other in sets[1:]:
            agree("sets", other, first, "the same in every set", remedy=joining)
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
