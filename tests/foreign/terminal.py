"""`retwin …` as a user types it: words in, exit code and printed text out."""

from __future__ import annotations

import io
import json
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from retwin.cli import main


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code, stdout, stderr."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """What it printed with --json; a NaN in it is an error."""
        return json.loads(self.out, parse_constant=_refuse)

    @property
    def lines(self) -> list[str]:
        """The lines of stderr."""
        return self.err.splitlines()


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} in JSON")


def retwin(folder: Path, line: str, *, code: int = 0) -> Ended:
    """`retwin -q LINE` in that folder, which ends with that code."""
    out, err = io.StringIO(), io.StringIO()
    words = ["retwin", "-q", *line.split()]
    given = mock.patch.object(sys, "argv", words), mock.patch.dict("os.environ", COLUMNS="200")
    with chdir(folder), redirect_stdout(out), redirect_stderr(err), given[0], given[1]:
        try:
            main()
        except SystemExit as end:
            found = int(end.code or 0)
    ended = Ended(found, out.getvalue(), err.getvalue())
    assert ended.code == code, f"retwin {line}: {ended}"
    return ended
