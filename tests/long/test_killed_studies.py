"""A whole study, killed a hundred times and resumed, ends as one that was not interrupted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import killing
import pytest
from mutation import CASE, MODULE

import retwin as rt

KILLS = 100


@pytest.mark.long
def test_a_study_killed_a_hundred_times(tmp_path: Path) -> None:
    # Other tests of this process have a module of the case's name.
    (tmp_path / "own_of_kills.py").write_text(MODULE)
    (tmp_path / "case.toml").write_text(CASE.replace("own_of_mutations", "own_of_kills"))
    case = rt.cases.get(str(tmp_path / "case.toml"))
    made = rt.generate(case.twin, case, per_class=6, seed=5)
    rt.save(made.replace(observed=made.observed + 0.02, emulated=True), tmp_path / "real.npz")
    done = subprocess.run(
        [sys.executable, killing.__file__, str(tmp_path), str(KILLS)],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        # One thread, since a process that has several cannot be forked safely.
        env=os.environ
        | {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1", "PYTHONWARNINGS": "ignore"},
    )
    assert done.stdout.splitlines() == []
