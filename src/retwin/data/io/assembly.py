"""Trajectories from the arrays of a file, validated against a case."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.sizes import Budget


class DataCase(Protocol):
    """Channels, sample rate and classes of the data of one system."""

    @property
    def inputs(self) -> Channels:
        """Names and units of the commands."""

    @property
    def outputs(self) -> Channels:
        """Names and units of the outputs."""

    @property
    def rate(self) -> float:
        """Samples per second; 0 where any will do, as with a twin that has no rate of its own."""

    @property
    def classes(self) -> tuple[str, ...]:
        """The class names, in their fixed order; () where any will do."""

    def complete(
        self, trajectories: Trajectories, *, progress: Progress | None = None
    ) -> Trajectories:
        """`trajectories` with the commands that the file does not hold, and their channels."""


@dataclass(frozen=True)
class Raw:
    """One trajectory as it is in a file.

    Attributes
    ----------
    where : str
        Its name in messages.
    label : str
        Its class name, "" if unknown.
    nominal, observed : (T, d_y) array
        The ideal outputs and the measured ones, NaN where one is missing.
    commands : (T, d_u) array or None
        None if the file holds none.
    id : str or None
        Its name in the set.
    rate : float or None
        The sample rate in Hz, None if the file does not hold it.

    """

    where: str
    label: str
    nominal: NDArray
    observed: NDArray
    commands: NDArray | None = None
    id: str | None = None
    rate: float | None = None

    @property
    def blocks(self) -> dict[str, NDArray]:
        """Its arrays by name; commands (T, 0) where the file holds none."""
        none = np.zeros((len(self.nominal), 0), self.nominal.dtype)
        commands = none if self.commands is None else self.commands
        return {"nominal": self.nominal, "observed": self.observed, "commands": commands}

    @classmethod
    def of_columns(
        cls, block: NDArray, where: str, case: DataCase | None, label: str, name: str | None = None
    ) -> Raw:
        """One whose columns (T, k) are commands, nominal and observed, or these two alone.

        Raises
        ------
        InputError
            The number of columns fits neither layout.

        """
        first, half = _widths(block.shape[1], where, case)
        commands = block[:, :first] if first else None
        nominal, observed = block[:, first : first + half], block[:, first + half :]
        return cls(where, label, nominal, observed, commands, name)


def _widths(width: int, where: str, case: DataCase | None) -> tuple[int, int]:
    """The number of columns of commands, 0 if there are none, and of outputs."""
    if case is None:
        first, (half, odd) = 0, divmod(width, 2)
        fine, remedy = half and not odd, "give the case when commands come first"
        expected = "an even number of columns, nominal outputs then observed ones"
    else:
        half, first = len(case.outputs), width - 2 * len(case.outputs)
        fine, remedy = first in (0, len(case.inputs)), "give the case that the data belong to"
        expected = f"{2 * half} columns (nominal, observed) or "
        expected += f"{len(case.inputs) + 2 * half} (commands, nominal, observed)"
    require(fine, where, expected=expected, got=f"{width} columns", remedy=remedy)
    return first, half


def assemble(
    raws: Sequence[Raw],
    *,
    source: Provenance,
    case: DataCase | None,
    rate: float | None,
    budget: Budget,
    inputs: Channels | None = None,
) -> Trajectories:
    """Trajectories from `raws`; shorter ones are padded with the last value and mask False.

    Parameters
    ----------
    raws : sequence of Raw
        At least one.
    source : Provenance
        Where they come from.
    case : DataCase or None
        Sets the sample rate.
    rate : float or None
        The sample rate in Hz, None if the case or every file holds it.
    budget : Budget
        The memory that the padded arrays may take.
    inputs : Channels or None
        Names of the commands, None for numbered ones.

    Raises
    ------
    InputError
        Widths, sample rates or the presence of commands differ among `raws`, no sample rate is
        known, a command or nominal output is not finite, or the padded arrays are too large.

    """
    first = raws[0]
    for raw in raws:
        fits = (raw.commands is None) == (first.commands is None)
        expected = "commands in every trajectory or in none"
        got = "commands in some trajectories only"
        require(fits, raw.where, expected=expected, got=got, remedy="split the data into two sets")
        for name, block in raw.blocks.items():
            _check_block(name, block, raw, first)
    steps = max(len(raw.nominal) for raw in raws)
    width = sum(block.shape[1] for block in first.blocks.values())
    budget.take(len(raws) * steps * width * (first.nominal.itemsize + 1))
    lengths = np.array([len(raw.nominal) for raw in raws])
    arrays: Any = {name: _pad([raw.blocks[name] for raw in raws], steps) for name in first.blocks}
    present = np.arange(steps)[None, :, None] < lengths[:, None, None]
    return Trajectories(
        **arrays,
        rate=_common_rate(raws, case, rate),
        mask=np.isfinite(arrays["observed"]) & present,
        labels=np.array([raw.label for raw in raws], dtype=np.str_),
        ids=np.array([raw.id for raw in raws], np.str_) if first.id is not None else None,  # type: ignore[arg-type]
        inputs=inputs,  # type: ignore[arg-type]
        provenance=(source,),
    )


def settle(
    trajectories: Trajectories, case: DataCase | None, rate: float | None, progress: Progress | None
) -> Trajectories:
    """`trajectories` with the channels of `case`, labels checked, commands completed.

    Raises
    ------
    InputError
        Widths, sample rate (Hz), channels or class names are not those of the case, or the sample
        rate is not `rate`.

    """
    if rate is not None:
        expected = f"{trajectories.rate:g} Hz, the sample rate of the file"
        got = f"{rate:g} Hz"
        remedy = "leave rate out"
        require(_close(rate, trajectories.rate), "rate", expected=expected, got=got, remedy=remedy)
    if case is None:
        return trajectories
    expected = f"{case.rate:g} Hz, the sample rate of the case"
    got = f"{trajectories.rate:g} Hz"
    remedy = "resample the data, or leave the case out"
    require(case.rate in (0, trajectories.rate), "rate", expected=expected, got=got, remedy=remedy)
    width = trajectories.commands.shape[2]
    channels_of = [("outputs", "y", trajectories.outputs, case.outputs)]
    if width:
        channels_of.append(("inputs", "u", trajectories.inputs, case.inputs))
    for name, prefix, channels, wanted in channels_of:
        # A set that was saved before anyone named its channels may be named now.
        unnamed = Channels.numbered(prefix, len(wanted))
        # What has no classes is a twin, of which a unit of "1" may be one that nobody stated.
        units = zip(channels.units, wanted.units, strict=False)
        open_units = not case.classes and all(b in (a, "1") for a, b in units)
        same = channels.names == wanted.names and open_units
        alike = channels in (wanted, unnamed) or same
        expected = f"the channels of the case, {wanted}"
        remedy = "give the case that the data belong to"
        require(alike, name, expected=expected, got=channels, remedy=remedy)
    unknown = sorted(trajectories.known_labels - set(case.classes))
    expected = f"classes of the case, {', '.join(case.classes)}"
    got = f"the unknown class {''.join(unknown[:1])!r}"
    remedy = "rename the class, or give the case that the data belong to"
    require(not unknown or not case.classes, "labels", expected=expected, got=got, remedy=remedy)
    settled = trajectories
    if case.classes:
        settled = trajectories.replace(
            outputs=case.outputs, inputs=case.inputs if width else trajectories.inputs
        )
    if width or not len(case.inputs):
        return settled
    return case.complete(settled, progress=progress)


def _pad(blocks: Sequence[NDArray], steps: int) -> NDArray:
    """(n, steps, k) from blocks (T, k), each padded with its last value."""
    kind = np.result_type(*{block.dtype for block in blocks})
    padded = np.empty((len(blocks), steps, blocks[0].shape[1]), kind)
    for row, block in zip(padded, blocks, strict=True):
        row[: len(block)] = block
        row[len(block) :] = block[-1:]
    return padded


def _check_block(name: str, block: NDArray, raw: Raw, first: Raw) -> None:
    """Raise InputError for another width than the first one's, and for values that are not finite.

    Outputs that were not measured may be NaN.
    """
    width = first.blocks[name].shape[1]
    expected = f"{width} columns of {name}, as in {first.where}"
    remedy = "keep data of different systems apart"
    require(
        block.shape[1] == width, raw.where, expected=expected, got=block.shape[1], remedy=remedy
    )
    measured = name == "observed"
    bad = np.isinf(block) if measured else ~np.isfinite(block)
    if bad.any():
        sample, column = np.argwhere(bad)[0]
        repair = "replace infinite measurements by NaN"
        got = f"{block[sample, column]} in sample {sample}, column {column}"
        remedy = repair if measured else "repair or drop that trajectory"
        raise InputError(raw.where, expected=f"finite values of {name}", got=got, remedy=remedy)


def _common_rate(raws: Sequence[Raw], case: DataCase | None, rate: float | None) -> float:
    """The sample rate of the set in Hz: given, the case's, or that in every file."""
    found = [(rate, "the argument")] if rate is not None else []
    found += [(float(case.rate), "the case")] if case is not None and case.rate else []
    found += [(raw.rate, raw.where) for raw in raws if raw.rate is not None]
    expected = "the sample rate, which the file does not hold"
    remedy = "give rate (in Hz) or case; on the command line --rate or --case"
    require(found, "rate", expected=expected, got="none", remedy=remedy)
    first, origin = found[0]
    for value, where in found[1:]:
        expected = f"one sample rate, {first:g} Hz as in {origin}"
        got = f"{value:g} Hz in {where}"
        remedy = "resample, or load the parts one by one"
        require(_close(value, first), "rate", expected=expected, got=got, remedy=remedy)
    return first if case is None else float(case.rate or first)


def _close(rate: float, other: float) -> bool:
    # Relative difference of sample rates that count as equal: files round their times.
    return bool(np.isclose(rate, other, rtol=1e-3, atol=0))
