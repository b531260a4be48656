"""`check_records`: what a user must know of records before anything is learned from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.agreement import GENERAL, explained_shares, find_disagreements
from retwin.data.quality.copies import find_copies
from retwin.data.quality.finding import Finding, summarise
from retwin.data.quality.jumps import find_jumps
from retwin.data.quality.readings import readings_of
from retwin.data.quality.sensors import find_constant, find_noise, find_stretches
from retwin.data.trajectories import Trajectories


@dataclass(frozen=True, eq=False)
class Checked:
    """Records, and what a user must know of them.

    Attributes
    ----------
    records : Trajectories
        The records, with the nominal outputs that they were compared with.
    findings : tuple of Finding
        In the order of the records; none for clean records.
    explained : dict of str to dict of str to float
        Share of the variance of each output that its nominal output explains, for `healthy` and
        `faulty` records; empty where nominal outputs are not known.

    """

    records: Trajectories
    findings: tuple[Finding, ...] = ()
    explained: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def sentences(self) -> list[str]:
        """How much of the variance nominal outputs explain, in a sentence; none where unknown."""
        parts = []
        for kind, shares in self._known.items():
            own = ", ".join(_describe_share(name, share) for name, share in shares.items())
            which = "" if len(self.explained) == 1 else f" in {kind} records"
            parts += [f"{own}{which}"] * bool(own)
        return [f"The twin that was given explains {'; '.join(parts)} (variance)."] * bool(parts)

    @property
    def values(self) -> dict[str, Any]:
        """The same as JSON values, without the shares of outputs that never change."""
        return {"findings": [asdict(each) for each in self.findings], "explained": self._known}

    @property
    def _known(self) -> dict[str, dict[str, float]]:
        """`explained` without NaN, which findings state as outputs that never change."""
        return {
            kind: {name: share for name, share in shares.items() if np.isfinite(share)}
            for kind, shares in self.explained.items()
        }


def check_records(records: Trajectories) -> Checked:
    """What is wrong with records, as far as their arrays show it.

    Copies and near copies; outputs that freeze, stop at a limit, jump, drop to zero, or are noise;
    units that are wrong by a power of ten; and, where nominal outputs are known, records that do
    not belong to their commands, exchanged channels, a wrong time base, and labels that do not
    suit the motion.

    Parameters
    ----------
    records : Trajectories
        Recorded outputs with commands; `nominal` counts as known where it changes.

    Returns
    -------
    Checked
        Its `findings` are none for clean records.

    """
    ids = records.ids.tolist()
    found = [
        Finding(name, "", "unmeasured", "nothing was measured: it is not used", severity="unusable")
        for name, mask in zip(ids, records.mask, strict=True)
        if not mask.any()
    ]
    scales = list(find_scales(records))
    # What is in another unit would hide all else.
    rest = records[~np.isin(records.ids, [each.record for each in scales])] if scales else records
    for every in readings_of(rest):
        constant = list(find_constant(every))
        found += constant or find_jumps(every)
        healthy = [each for each in every if each.healthy]  # a faulty machine may stand still
        if healthy and not constant:
            found += [*find_stretches(healthy), *find_noise(healthy)]
    found += [
        Finding(ids[i], "", "copy", f"a copy of {ids[j]}" + f", {why}" * bool(why))
        for i, j, why in find_copies(records.measured)
    ]
    found += [*scales, *find_disagreements(rest)]
    # A record of which more is known needs no more general finding.
    other = {each.record for each in found if each.kind not in GENERAL}
    found = [each for each in found if each.kind not in GENERAL or each.record not in other]
    order = {name: place for place, name in enumerate(ids)}
    found.sort(key=lambda each: order.get(each.record, -1))
    known = len(records) > 0 and np.ptp(records.nominal) > 0
    return Checked(records, tuple(found), explained_shares(rest) if known else {})


def doubtful(records: Trajectories) -> str:
    """Sentences about outputs that show nothing, or hold a value that seems to stand for none.

    It is quick, for verbs that are called many times.
    """
    every = readings_of(records, samples=1)
    return "; ".join(summarise(found for each in every for found in find_constant(each)))


def _describe_share(output: str, share: float) -> str:
    """What is explained of an output, in words where it is less than nothing."""
    return f"{100 * share:.0f} % of {output}" if share >= 0 else f"less of {output} than its mean"


def find_scales(records: Trajectories) -> Iterator[Finding]:
    """Channels whose values are larger by a power of ten than in all other records.

    Magnitude and range are compared, as far as the other records agree in them.
    """
    commands = np.where(
        (np.arange(records.steps) < records.lengths[:, None])[..., None], records.commands, np.nan
    )
    measured = records.measured
    for channels, values in ((records.inputs, commands), (records.outputs, measured)):
        for k, name in enumerate(channels.names):
            known = [own[np.isfinite(own)] for own in values[..., k].astype(float)]
            ends = np.full((len(known), 3), np.nan)
            for row, own in zip(ends, known, strict=True):
                if len(own):
                    row[:] = *np.quantile(own, [0.02, 0.98]), np.quantile(np.abs(own), 0.98)
            low, high, size = ends.T
            powers = [each for each in map(_powers, (size, high - low)) if each is not None]
            for i in range(len(records) if powers else 0):
                power = {int(each[i]) for each in powers}
                if len(power) == 1 and power != {0}:
                    text = f"10^{power.pop()} times as large as in the others: another unit than "
                    text += f"{channels.units[k]}?"
                    yield Finding(str(records.ids[i]), name, "unit", text)


def _powers(sizes: NDArray, *, alike: float = 0.3, close: float = 0.05) -> NDArray | None:
    """The power of ten (n,) by which each size differs, 0 for none; None if sizes do not agree.

    Parameters
    ----------
    alike : float, default 0.3
        Decades within which the other records agree, so that one that differs is named.
    close : float, default 0.05
        Decades from a power of ten, at most, beside half of those within which the others agree.

    """
    known = np.isfinite(sizes) & (sizes > 0)
    if known.sum() < 3:
        return None
    decades = np.log10(np.where(known, sizes, 1.0))
    off = np.abs(decades - np.median(decades[known])) > 0.5
    others = decades[known & ~off]
    if len(others) <= max(1, (known & off).sum()) or np.ptp(others) > alike:
        return None
    apart = np.where(known & off, decades - np.median(others), 0.0)
    power = np.rint(apart)
    return np.where(np.abs(apart - power) < close + np.ptp(others) / 2, power, 0.0)
