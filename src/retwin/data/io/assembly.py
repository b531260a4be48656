"""Blocks of numbers from a file, assembled into trajectories and validated against a case."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress

__all__ = ["DataCase", "Raw", "assemble", "settle", "split_columns"]


class DataCase(Protocol):
    """What a case says about its data."""

    @property
    def inputs(self) -> Channels:
        """Names and units of the commands."""
        ...

    @property
    def outputs(self) -> Channels:
        """Names and units of the outputs."""
        ...

    @property
    def rate(self) -> float:
        """Samples per second."""
        ...

    @property
    def classes(self) -> tuple[str, ...]:
        """The class names, in their fixed order."""
        ...

    def complete(
        self, trajectories: Trajectories, *, progress: Progress | None = None
    ) -> Trajectories:
        """`trajectories` with the commands that the file does not hold, and their channels."""
        ...


@dataclass(frozen=True)
class Raw:
    """One trajectory as a file gives it: commands (T, d_u) or none, nominal and observed (T, d_y).

    `where` names it in messages, `clock` is the sample rate that the file itself tells, if any.
    """

    where: str
    label: str
    nominal: NDArray
    observed: NDArray
    commands: NDArray | None = None
    id: str | None = None
    clock: float | None = None


def split_columns(block: NDArray, where: str, case: DataCase | None) -> tuple[NDArray, ...]:
    """Columns (T, k) as commands, nominal and observed; commands are (T, 0) when k = 2 d_y."""
    width = block.shape[1]
    if case is None:
        half, odd = divmod(width, 2)
        if odd or not half:
            raise InputError(
                where,
                expected="an even number of columns, nominal outputs then observed ones",
                got=f"{width} columns",
                remedy="give the case when commands come first",
            )
        first = 0
    else:
        half, first = len(case.outputs), width - 2 * len(case.outputs)
        if first not in (0, len(case.inputs)):
            raise InputError(
                where,
                expected=f"{2 * half} columns (nominal, observed) or "
                f"{len(case.inputs) + 2 * half} (commands, nominal, observed)",
                got=f"{width} columns",
                remedy="give the case that the data belong to",
            )
    return block[:, :first], block[:, first : first + half], block[:, first + half :]


def assemble(
    raws: Sequence[Raw],
    *,
    source: Provenance,
    case: DataCase | None,
    rate: float | None,
    inputs: Channels | None = None,
) -> Trajectories:
    """Trajectories from `raws`, the shorter ones padded: last value held, mask False.

    Raises
    ------
    InputError: widths, rates or the presence of commands differ among `raws`; no rate is known.

    """
    first = raws[0]
    for raw in raws:
        if (raw.commands is None) != (first.commands is None):
            raise InputError(
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
    _check_known(raws, commands)
    lengths = np.array([len(raw.nominal) for raw in raws])
    observed = _held([raw.observed for raw in raws], steps)
    present = np.arange(steps)[None, :, None] < lengths[:, None, None]
    return Trajectories(
        commands=_held(commands, steps),
        nominal=_held([raw.nominal for raw in raws], steps),
        observed=observed,
        rate=_common_rate(raws, case, rate),
        mask=np.isfinite(observed) & present,
        labels=np.array([raw.label for raw in raws], dtype=np.str_),
        ids=np.array([raw.id for raw in raws], np.str_) if first.id is not None else None,  # type: ignore[arg-type]
        inputs=inputs,  # type: ignore[arg-type]
        provenance=(source,),
    )


def settle(
    trajectories: Trajectories, case: DataCase | None, progress: Progress | None
) -> Trajectories:
    """`trajectories` with the channels and rate of `case`, labels checked, commands completed.

    Raises
    ------
    InputError: widths, rate, channels or class names that are not those of the case.

    """
    if case is None:
        return trajectories
    if trajectories.rate != case.rate:
        raise InputError(
            "rate",
            expected=f"{case.rate:g} Hz, the rate of the case",
            got=f"{trajectories.rate:g} Hz",
            remedy="resample the data, or leave the case out",
        )
    width = trajectories.commands.shape[2]
    held = [("outputs", "y", trajectories.outputs, case.outputs)]
    if width:
        held.append(("inputs", "u", trajectories.inputs, case.inputs))
    for name, prefix, channels, wanted in held:
        # A set that was saved before anyone named its channels may be named now.
        unnamed = Channels.numbered(prefix, len(wanted))
        if channels not in (wanted, unnamed):
            raise InputError(
                name,
                expected=f"the channels of the case, {_told(wanted)}",
                got=_told(channels),
                remedy="give the case that the data belong to",
            )
    unknown = sorted(trajectories.known_labels - set(case.classes))
    if unknown:
        raise InputError(
            "labels",
            expected=f"classes of the case, {', '.join(case.classes)}",
            got=f"the unknown class {unknown[0]!r}",
            remedy="rename the class, or give the case that the data belong to",
        )
    settled = trajectories.replace(
        outputs=case.outputs, inputs=case.inputs if width else trajectories.inputs
    )
    if width or not len(case.inputs):
        return settled
    return case.complete(settled, progress=progress)


def _held(blocks: Sequence[NDArray], steps: int) -> NDArray:
    """(n, steps, k) from blocks (T, k), the last value of each held."""
    kind = np.result_type(*{block.dtype for block in blocks})
    held = np.empty((len(blocks), steps, blocks[0].shape[1]), kind)
    for row, block in zip(held, blocks, strict=True):
        row[: len(block)] = block
        row[len(block) :] = block[-1:]
    return held


def _same_width(name: str, raw: Raw, first: Raw) -> None:
    mine, wanted = getattr(raw, name), getattr(first, name)
    if mine is not None and mine.shape[1] != wanted.shape[1]:
        raise InputError(
            raw.where,
            expected=f"{wanted.shape[1]} columns of {name}, as in {first.where}",
            got=f"{mine.shape[1]}",
            remedy="keep data of different systems apart",
        )


def _check_known(raws: Sequence[Raw], commands: Sequence[NDArray]) -> None:
    """Name the place where a known input is NaN or infinite, or a measurement infinite."""
    for raw, told in zip(raws, commands, strict=True):
        for name, block, bad in (
            ("nominal", raw.nominal, ~np.isfinite(raw.nominal)),
            ("commands", told, ~np.isfinite(told)),
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
    """The one sample rate of the set, in Hz: given, the case's, or told by every file."""
    told = [(raw.clock, raw.where) for raw in raws if raw.clock is not None]
    known = [(rate, "rate")] if rate is not None else []
    known += [(float(case.rate), "the case")] if case is not None else []
    known += told
    if not known:
        raise InputError(
            "rate",
            expected="the sample rate, which the file does not hold",
            got="none",
            remedy="give rate (in Hz) or case; on the command line --rate or --case",
        )
    first, said_by = known[0]
    for value, where in known[1:]:
        if not np.isclose(value, first, rtol=1e-3, atol=0):
            raise InputError(
                "rate",
                expected=f"one sample rate, {first:g} Hz as {said_by} says",
                got=f"{value:g} Hz in {where}",
                remedy="resample, or load the parts one by one",
            )
    return known[0][0] if case is None else float(case.rate)


def _told(channels: Channels) -> str:
    return (
        ", ".join(f"{n} [{u}]" for n, u in zip(channels.names, channels.units, strict=True))
        or "none"
    )
