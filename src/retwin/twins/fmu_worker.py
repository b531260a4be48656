"""The worker process of an FMU: it loads the FMU once and runs it again and again.

An FMU is native code. Only these processes load it, and the parent process does not call it.
"""

from __future__ import annotations

import os
import shutil
import signal

from numpy.typing import NDArray

from retwin.twins.fmu_instance import Instance, Outcome, RunSettings, Start

__all__ = ["Outcome", "RunSettings", "Start", "load", "orphaned", "run", "start"]

_folder: str
_job: RunSettings
_instance: Instance | None = None


def start(folder: str, job: RunSettings) -> None:
    """Prepare this process for runs.

    Parameters
    ----------
    folder : str
        Where the FMU is unpacked.
    job : RunSettings
        Settings of the runs.

    """
    import fmpy  # noqa: F401  before the time limit of the first run begins

    global _folder, _job
    _folder, _job = folder, job
    # Python's handlers wait for native code to return, which a hung FMU never does.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # The output of an FMU must not mix with that of the program.
    os.dup2(2, 1)


def orphaned(folder: str, job: RunSettings) -> None:
    """Remove the unpacked FMU when the parent process, which would have done it, has died.

    Parameters
    ----------
    folder, job
        See `start`.

    """
    shutil.rmtree(folder, ignore_errors=True)


def load() -> str:
    """Load the FMU, unless it is loaded.

    Returns
    -------
    str
        The reason why it cannot be loaded; "" when it is loaded.

    """
    global _instance
    if _instance is None:
        try:
            _instance = Instance(_folder, _job)
        except Exception as error:  # FMPy raises nothing more special
            return " ".join(str(error).split())
    return ""


def run(commands: NDArray, values: Start) -> Outcome:
    """Run the FMU once.

    Parameters
    ----------
    commands : ndarray, shape (T, d_u)
        Commands of one trajectory.
    values : mapping of str to float or str
        Start values.

    Returns
    -------
    Outcome
        Outputs, or the reason of the failure.

    Raises
    ------
    Retired
        Another process has to do it.

    """
    reason = load()
    return Outcome(reason=reason) if _instance is None else _instance.run(commands, values)
