"""Trajectories from the arrays of a file, validated against a case."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.sizes import Budget

RATE_TOLERANCE = 1e-3
"""Relative difference of sample rates that count as equal: files round their times."""


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
        half, odd = divmod(width, 2)
        require(
            half and not odd,
            where,
            expected="an even number of columns, nominal outputs then observed ones",
            got=f"{width} columns",
            remedy="give the case when commands come first",
        )
        first = 0
    else:
        half, first = len(case.outputs), width - 2 * len(case.outputs)
        require(
            first in (0, len(case.inputs)),
            where,
            expected=f"{2 * half} columns (nominal, observed) or "
            f"{len(case.inputs) + 2 * half} (commands, nominal, observed)",
            got=f"{width} columns",
            remedy="give the case that the data belong to",
        )
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
        require(
            (raw.commands is None) == (first.commands is None),
            raw.where,
            expected="commands in every trajectory or in none",
            got="commands in some trajectories only",
            remedy="split the data into two sets",
        )
        for name in ("nominal", "observed", "commands"):
            _same_width(name, raw, first)
    steps = max(len(raw.nominal) for raw in raws)
    empty = [np.zeros((len(raw.nominal), 0), raw.nominal.dtype) for raw in raws]
    commands = [
        none if raw.commands is None else raw.commands
        for raw, none in zip(raws, empty, strict=True)
    ]
    _check_finite(raws, commands)
    width = commands[0].shape[1] + 2 * first.nominal.shape[1]
    budget.take(len(raws) * steps * width * (first.nominal.itemsize + 1))
    lengths = np.array([len(raw.nominal) for raw in raws])
    observed = _pad([raw.observed for raw in raws], steps)
    present = np.arange(steps)[None, :, None] < lengths[:, None, None]
    return Trajectories(
        commands=_pad(commands, steps),
        nominal=_pad([raw.nominal for raw in raws], steps),
        observed=observed,
        rate=_common_rate(raws, case, rate),
        mask=np.isfinite(observed) & present,
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
        require(
            _close(rate, trajectories.rate),
            "rate",
            expected=f"{trajectories.rate:g} Hz, the sample rate of the file",
            got=f"{rate:g} Hz",
            remedy="leave rate out",
        )
    if case is None:
        return trajectories
    require(
        case.rate in (0, trajectories.rate),
        "rate",
        expected=f"{case.rate:g} Hz, the sample rate of the case",
        got=f"{trajectories.rate:g} Hz",
        remedy="resample the data, or leave the case out",
    )
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
        require(
            channels in (wanted, unnamed) or same,
            name,
            expected=f"the channels of the case, {wanted}",
            got=channels,
            remedy="give the case that the data belong to",
        )
    unknown = sorted(trajectories.known_labels - set(case.classes))
    require(
        not unknown or not case.classes,
        "labels",
        expected=f"classes of the case, {', '.join(case.classes)}",
        got=f"the unknown class {''.join(unknown[:1])!r}",
        remedy="rename the class, or give the case that the data belong to",
    )
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


def _same_width(name: str, raw: Raw, first: Raw) -> None:
    array, wanted = getattr(raw, name), getattr(first, name)
    if array is not None:
        require(
            array.shape[1] == wanted.shape[1],
            raw.where,
            expected=f"{wanted.shape[1]} columns of {name}, as in {first.where}",
            got=array.shape[1],
            remedy="keep data of different systems apart",
        )


def _check_finite(raws: Sequence[Raw], commands: Sequence[NDArray]) -> None:
    """Raise InputError, which names the sample, for inputs and outputs that are not finite."""
    for raw, given in zip(raws, commands, strict=True):
        for name, block, bad in (
            ("nominal", raw.nominal, ~np.isfinite(raw.nominal)),
            ("commands", given, ~np.isfinite(given)),
            ("observed", raw.observed, np.isinf(raw.observed)),
        ):
            if bad.any():
                sample, column = np.argwhere(bad)[0]
                raise InputError(
                    raw.where,
                    expected=f"finite values of {name}",
                    got=f"{block[sample, column]} in sample {sample}, column {column}",
                    remedy="replace infinite measurements by NaN"
                    if name == "observed"
                    else "repair or drop that trajectory",
                )


def _common_rate(raws: Sequence[Raw], case: DataCase | None, rate: float | None) -> float:
    """The sample rate of the set in Hz: given, the case's, or that in every file."""
    found = [(rate, "the argument")] if rate is not None else []
    found += [(float(case.rate), "the case")] if case is not None and case.rate else []
    found += [(raw.rate, raw.where) for raw in raws if raw.rate is not None]
    require(
        found,
        "rate",
        expected="the sample rate, which the file does not hold",
        got="none",
        remedy="give rate (in Hz) or case; on the command line --rate or --case",
    )
    first, origin = found[0]
    for value, where in found[1:]:
        require(
            _close(value, first),
            "rate",
            expected=f"one sample rate, {first:g} Hz as in {origin}",
            got=f"{value:g} Hz in {where}",
            remedy="resample, or load the parts one by one",
        )
    return first if case is None else float(case.rate or first)


def _close(rate: float, other: float) -> bool:
    return bool(np.isclose(rate, other, rtol=RATE_TOLERANCE, atol=0))
