"""Records in one CSV table: a column for each channel, one record per set of data."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import HEALTHY, Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import sha256
from retwin.twins.twin import Twin

__all__ = ["ColumnRecords"]


@dataclass(frozen=True)
class ColumnRecords:
    """A function of a CSV file with a header that gives a calibration record and a test record.

    Each is one healthy trajectory. It ends where its commands end; an output that is missing before
    is masked. `nominal` is the output of the twin.

    Parameters
    ----------
    twin : Twin
        Its channels and sample rate are those of the records.
    calibration, test : mapping of str to str
        The column of each channel.

    Raises
    ------
    InputError
        There is not one column for each input and output. When called: the file cannot be read or
        lacks a column, or a command is no number.

    """

    twin: Twin
    calibration: Mapping[str, str]
    test: Mapping[str, str]

    def __post_init__(self) -> None:
        wanted = (*self.twin.inputs.names, *self.twin.outputs.names)
        for name in ("calibration", "test"):
            given = getattr(self, name)
            require(
                set(given) == set(wanted),
                name,
                expected=f"a column for each of {', '.join(wanted)}",
                got=", ".join(given) or "none",
                remedy='write for each channel NAME = "COLUMN"',
            )

    def __call__(self, path: str | Path) -> tuple[Trajectories, Trajectories]:
        """The calibration record and the test record in a CSV file."""
        path = Path(path)
        table = _read(path, [*self.calibration.values(), *self.test.values()])
        source = Provenance(path.name, sha256(path))
        return (
            self._record(table, "calibration", source),
            self._record(table, "test", source),
        )

    def _record(self, table: Mapping[str, NDArray], name: str, source: Provenance) -> Trajectories:
        columns = getattr(self, name)

        def values(channels: Channels) -> NDArray:
            return np.stack([table[columns[each]] for each in channels.names], axis=-1)[None]

        commands = values(self.twin.inputs)
        known = np.isfinite(commands[0]).all(axis=1)
        steps = int(np.flatnonzero(known).max(initial=-1)) + 1
        require(
            steps >= 2 and known[:steps].all(),
            source.name,
            expected="a number for every command until the record ends, two rows at least",
            got=f"{int(known.sum())} of {steps} rows of the {name} record",
            remedy="fill in the missing commands, which are known inputs",
        )
        commands = commands[:, :steps]
        return Trajectories(
            commands=commands,
            nominal=self.twin.simulate(commands, seed=0).nominal,
            observed=values(self.twin.outputs)[:, :steps],
            rate=self.twin.rate,
            labels=np.array([HEALTHY]),
            ids=np.array([name]),
            inputs=self.twin.inputs,
            outputs=self.twin.outputs,
            provenance=(source,),
        )


def _read(path: Path, names: list[str]) -> dict[str, NDArray]:
    """Columns of a CSV file; NaN where a cell is empty."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as lines:
            rows = list(csv.DictReader(lines, strict=True))
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(
            str(path),
            expected=f"a CSV file with a header and numbers in columns {', '.join(names)}",
            got=f"{type(error).__name__}: {error}",
            remedy="name the columns as the file does",
        ) from None
