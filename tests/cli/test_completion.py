"""Completion in a shell: of commands, options and names, as those who own the names know them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from retwin import cases, catalog

PROGRAM = Path(sys.executable).with_name("retwin")


@pytest.mark.parametrize("name", catalog.CASES)
def test_the_recorded_case_of_the_catalog_is_that_of_the_case(name: str) -> None:
    case, recorded = cases.get(name), cases.data_case(name)
    for each in ("classes", "inputs", "outputs", "rate"):
        assert getattr(case, each) == getattr(recorded, each), each
    assert recorded.recover is case.recover


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (("stu",), ["study"]),
        (("study", "--lea"), ["--learning-curve"]),
        (("study", ""), list(catalog.CASES)),
        (
            ("study", "armpi", "--sources", "ibg,dt,ibg_"),
            ["ibg,dt,ibg_rg", "ibg,dt,ibg_rg_command"],
        ),
        (("study", "armpi", "--sources", "al"), ["all"]),
        (("study", "armpi", "--preset", ""), ["quick", "paper"]),
        (("diagnose", "fit", "made.npz", "--classifier", "r"), ["rocket"]),
        (("fit", "armpi", "--density", "f"), ["flow"]),
        (("twin", "info", ""), list(catalog.TWINS)),
        (
            ("twin", "simulate", "armpi-kinematic", "--fault", "Motor_2"),
            ["Motor_2_Stuck", "Motor_2_Steady_state_error"],
        ),
        (("twin", "simulate", "mine.toml", "--fault", ""), ["none", "all", "Healthy", "leak"]),
        (("data", "convert", "--public", ""), ["armpi"]),
        (("data", "info", "re"), []),
    ],
    ids=" ".join,
)
def test_what_bash_offers(
    typed: tuple[str, ...],
    offered: list[str],
    call,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "mine.toml").write_text("[faults]\nleak = { kind = 'Stuck' }\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("_RETWIN_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", " ".join(("retwin", *typed)))
    monkeypatch.setenv("COMP_CWORD", str(len(typed)))
    code, out, err = call()
    assert (code, out.split(), err) == (0, offered, "")


def test_a_shell_with_what_was_installed(tmp_path: Path) -> None:
    """The script that is installed, in a real bash."""
    variables = {
        **os.environ,
        "HOME": str(tmp_path),
        "PATH": f"{PROGRAM.parent}:{os.environ['PATH']}",
    }
    variables["_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"] = "1"
    install = [PROGRAM, "--install-completion", "bash"]
    subprocess.run(install, env=variables, check=True, capture_output=True)
    typed = "COMP_WORDS=(retwin bundle ver); COMP_CWORD=2; _retwin_completion retwin"
    script = f"source ~/.bashrc; {typed}; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    command = ["bash", "--norc", "-c", script]
    done = subprocess.run(command, env=variables, check=True, capture_output=True, text=True)
    assert done.stdout == "verify\n"


def test_neither_help_nor_completion_waits_for_torch() -> None:
    code = (
        "import sys; sys.argv = ['retwin', '--help']\n"
        "from retwin.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "assert not {'torch', 'sklearn', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
