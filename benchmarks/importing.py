"""Time of `import retwin`. Target: at most 1.5 s."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

from record import record


def seconds(code: str) -> float:
    times = []
    for _ in range(5):
        started = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True)
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def main() -> None:
    bare = seconds("pass")
    rows = {
        "import retwin (s)": seconds("import retwin") - bare,
        "import retwin, then access fit_surrogate (s)": seconds(
            "import retwin; retwin.fit_surrogate"
        )
        - bare,
    }
    record("importing", "median of five processes, without Python's own start", rows)


if __name__ == "__main__":
    main()
