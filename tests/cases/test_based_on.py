"""A case.toml that is based on another case, and one whose twin lies in another folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import retwin as rt

ROBOT = """<mujoco><worldbody><body><joint name="swing" axis="0 1 0" damping="0.1"/>
<geom size="0.1" pos="0 0 -1"/></body></worldbody>
<actuator><motor name="torque" joint="swing" ctrlrange="-1 1"/></actuator>
<sensor><jointpos name="angle" joint="swing"/></sensor></mujoco>"""
BASE = """
name = "pendulum"
twin = "robot.xml"
rate = 20
commands = { kind = "HoldSampler", duration = 2, hold_durations = [0.2, 0.5] }
[parameters]
"joint.swing.damping" = { unit = "N m s/rad", low = 0, high = 1, start = 0.1 }
"""


@pytest.fixture
def base(tmp_path: Path) -> Path:
    """A case in a folder of its own."""
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "robot.xml").write_text(ROBOT)
    (tmp_path / "plant" / "case.toml").write_text(BASE)
    return tmp_path


def test_it_changes_single_settings_and_keeps_the_others(base: Path) -> None:
    (base / "new.toml").write_text(
        'based_on = "plant/case.toml"\ntitle = "New"\n'
        '[parameters]\n"joint.swing.damping" = { start = 0.4 }\n'
        '"joint.swing.frictionloss" = { unit = "N m", low = 0, high = 1, start = 0.05 }\n'
    )
    case, old = rt.cases.get(str(base / "new.toml")), rt.cases.get(str(base / "plant/case.toml"))
    assert (case.name, case.title, case.sampler) == ("pendulum", "New", old.sampler)
    assert case.parametric is not None
    assert case.parametric.values == (0.4, 0.05)
    assert case.parametric.parameters[0].unit == "N m s/rad"
    commands = np.ones((1, 40, 1))
    slower, faster = (each.twin.simulate(commands, seed=0).observed for each in (case, old))
    assert np.abs(slower).max() < np.abs(faster).max()


def test_it_may_be_based_on_one_that_is_based_on_another(base: Path) -> None:
    (base / "b.toml").write_text('based_on = "plant/case.toml"\nname = "b"\n')
    (base / "c.toml").write_text('based_on = "b.toml"\ntitle = "c"\n')
    case = rt.cases.get(str(base / "c.toml"))
    assert (case.name, case.title) == ("b", "c")


def test_a_built_in_case_takes_parameters() -> None:
    case = rt.cases.get("tanks")
    assert case.parametric is not None
    twin = case.parametric.freed([rt.Parameter("upper", "V/s", 0.01, 0.1, 0.02)])
    assert twin.names == ("upper",)
    changed = dict(zip(case.parametric.names, case.parametric.values, strict=True))
    commands = np.full((1, 30, 1), 3.0)
    other = case.parametric.with_values({**changed, "upper": 0.02})
    np.testing.assert_array_equal(
        twin.simulate(commands, seed=0).observed, other.simulate(commands, seed=0).observed
    )


def test_an_update_of_a_built_in_case_is_used_by_its_records(tmp_path: Path) -> None:
    table = '[parameters]\nlower = { unit = "V/s", low = 0.01, high = 0.2, start = 0.05 }\n'
    (tmp_path / "new.toml").write_text(f'based_on = "tanks"\nname = "own"\n{table}')
    case = rt.cases.get(str(tmp_path / "new.toml"))
    assert (case.name, case.parametric) == ("own", case.twin)
    assert case.records.twin is case.twin  # type: ignore[union-attr]
    assert case.twin.values == (0.05,)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('based_on = "new.toml"', "a case that is not based on this one"),
        ('based_on = "none"', "the name of another case.toml, or one of armpi"),
        ("based_on = 3", "the name of another case.toml"),
        ('based_on = "none.toml"', "expected a case as a TOML file"),
        ('based_on = "tanks"', "parameters: expected some of pump"),
        ('based_on = "tanks"\nrate = 3', "rate"),
        ('based_on = "tanks"\n[parameters]\nnone = { low = 0, high = 1 }', "one of pump"),
        ('based_on = "plant/case.toml"\nparameters = 3', "parameters"),
        ('based_on = "plant/case.toml"\n[parameters]\nnone = 3', "parameters"),
        ('name = "a"\ntwin = "robot.xml"\nfolder = "elsewhere"', "where there is none"),
    ],
)
def test_what_it_cannot_be_based_on_is_refused(text: str, said: str, base: Path) -> None:
    (base / "new.toml").write_text(text)
    with pytest.raises(rt.InputError, match=said):
        rt.cases.get(str(base / "new.toml"))


def test_the_twin_may_lie_in_another_folder(base: Path) -> None:
    moved = BASE.replace('twin = "robot.xml"', 'twin = "robot.xml"\nfolder = "plant"')
    (base / "new.toml").write_text(moved)
    assert rt.cases.get(str(base / "new.toml")).outputs.names == ("angle",)
