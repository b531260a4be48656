"""The data of a study, without running one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.errors import InputError
from retwin.study.data import real_data


def test_real_sets_may_be_logs_with_a_mapping(tmp_path: Path) -> None:
    case = rt.cases.get("tanks")
    names = (*case.inputs.names, *case.outputs.names)
    text = "\n".join(
        [f"rate = {case.rate}", "[cut]", 'by = "length"', f"length = {20 / case.rate}"]
        + [f'[commands.{name}]\nsignal = "{name}"' for name in case.inputs.names]
        + [f'[outputs.{name}]\nsignal = "{name}"' for name in case.outputs.names]
    )
    (tmp_path / "m.toml").write_text(text)
    rows = [
        ",".join(
            [
                f"{k / case.rate}",
                *(f"{1 + (k + i) % 5 + k // 20 * (k % 2)}" for i in range(len(names))),
            ]
        )
        for k in range(90)
    ]
    (tmp_path / "log.csv").write_text("\n".join([",".join(("time", *names)), *rows]))
    given = rt.StudyData(real=tmp_path / "log.csv", mapping=tmp_path / "m.toml")
    made, roles = real_data(case, rt.StudyPlan(folds=2), given, lambda *_: None)
    assert (len(made), made.steps, len(roles.folds)) == (4, 20, 2)
    np.testing.assert_allclose(made.observed[0, :5, -1], 1 + (np.arange(5) + len(names) - 1) % 5)
    with pytest.raises(InputError, match="make one: retwin data map"):
        real_data(case, rt.StudyPlan(), rt.StudyData(real=tmp_path / "log.csv"), lambda *_: None)
    with pytest.raises(InputError, match="mapping: expected real sets that are logs"):
        rt.StudyData(records=tmp_path / "log.csv", mapping=tmp_path / "m.toml")


def test_a_trajectory_in_both_sets_is_refused(tmp_path: Path) -> None:
    """Also under another name: its measurements would be known before the test."""
    case = rt.cases.get("tanks")
    commands = case.sampler.sample(3, rng=np.random.default_rng(0))
    made = case.twin.simulate(commands, seed=0)
    rt.save(made[:2].replace(ids=np.array(["a", "b"])), tmp_path / "first.npz")
    rt.save(made[1:].replace(ids=np.array(["c", "d"])), tmp_path / "second.npz")
    rt.save(made[2:].replace(ids=np.array(["e"])), tmp_path / "third.npz")

    def read(test: str) -> int:
        given = rt.StudyData(calibration=tmp_path / "first.npz", test=tmp_path / test)
        return len(real_data(case, rt.StudyPlan(), given, lambda *_: None)[0])

    assert read("third.npz") == 3
    with pytest.raises(InputError, match="got c, which is b of the calibration; leave"):
        read("second.npz")
