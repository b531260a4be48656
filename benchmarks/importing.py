"""How long does `import retwin` take? At most 1.5 s."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

from record import record


def seconds(code: str) -> float:
    took = []
    for _ in range(5):
        started = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True)
        took.append(time.perf_counter() - started)
    return statistics.median(took)


def main() -> None:
    bare = seconds("pass")
    rows = {
        "import retwin (s)": seconds("import retwin") - bare,
        "import retwin, then ask for fit_surrogate (s)": seconds(
            "import retwin; retwin.fit_surrogate"
        )
        - bare,
    }
    record("importing", "median of five processes, Python's own start taken off", rows)


if __name__ == "__main__":
    main()
