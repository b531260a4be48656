"""Time and accuracy of command recovery.

Needs RETWIN_DATA. Targets: forward kinematics of the recovered commands within 0.05 mm RMS of the
desired path for at least 99 % of trajectories, and at most 60 s for 3600 trajectories.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from record import record

import retwin as rt
from retwin.cases.armpi_fpv.recovery import recover_commands
from retwin.cases.armpi_fpv.twin import ARM


def main() -> None:
    folder = os.environ.get("RETWIN_DATA")
    if not folder:
        sys.exit("recovery: set RETWIN_DATA to the folder of the public data")
    rows: dict[str, float] = {}
    for name in ("real_a", "sim"):
        path = rt.load(Path(folder) / "armpi" / f"{name}.mat", rate=100.0).nominal
        started = time.perf_counter()
        found = recover_commands(path, arm=ARM)
        rows[f"{name}: trajectories"] = len(path)
        rows[f"{name}: seconds"] = time.perf_counter() - started
        rows[f"{name}: share within 0.05 mm RMS"] = float((found.rms <= 5e-5).mean())
        rows[f"{name}: ambiguous segments"] = float(found.ambiguous.sum())
    record("recovery", "command recovery", rows)


if __name__ == "__main__":
    main()
