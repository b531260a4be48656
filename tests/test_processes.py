"""Worker processes: they begin and end without output."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import os, signal, time
from retwin.workers.pools import worker_pool

if __name__ != "__main__":  # in a worker, before it knows its task
    time.sleep(0.1 * (os.getpid() % 8))


def deaf():
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


if __name__ == "__main__":
    try:
        with worker_pool(4) as pool:
            pool.schedule(deaf).result()
            raise KeyError
    except KeyError:
        print("done")
"""


def test_a_pool_may_end_while_its_workers_still_start(tmp_path: Path) -> None:
    """A worker that ignores SIGTERM delays the end while others open locks that might be gone."""
    (tmp_path / "main.py").write_text(SCRIPT)
    result = subprocess.run([sys.executable, tmp_path / "main.py"], capture_output=True, text=True)
    assert (result.stdout, result.stderr) == ("done\n", "")
