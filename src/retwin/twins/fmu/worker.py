"""The tasks of the process of an FMU: it loads the FMU once and runs it again and again.

An FMU is native code. Only these processes load it, and the parent process does not call it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from numpy.typing import NDArray

from retwin.twins.fmu.instance import Instance, Outcome, RunSettings, Start
from retwin.workers.process import Frame

_folder: str
_job: RunSettings
_instance: Instance | None = None


def start(job: dict[str, Any]) -> Iterator[Frame]:
    """Prepare this process for runs of the FMU that is unpacked in a folder."""
    import fmpy  # noqa: F401  before the time limit of the first run begins

    global _folder, _job
    _folder, _job = job["folder"], RunSettings(**job["settings"])
    yield None, []


def load(_: None) -> Iterator[Frame]:
    """Load the FMU; yields an `Outcome` with the reason why it cannot be loaded."""
    yield _frame(Outcome(reason=_load()))


def _load() -> str:
    global _instance
    if _instance is None:
        try:
            _instance = Instance(_folder, _job)
        except Exception as error:  # FMPy raises nothing more special
            return " ".join(str(error).split())
    return ""


def run(values: Start, commands: NDArray) -> Iterator[Frame]:
    """Run the FMU once, on commands (T, d_u) with start values; yields an `Outcome`."""
    reason = _load()
    outcome = Outcome(reason=reason) if _instance is None else _instance.run(commands, values)
    yield _frame(outcome)


def _frame(outcome: Outcome) -> Frame:
    about = asdict(outcome)
    return about, [about.pop("outputs")]
