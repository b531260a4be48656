"""Help that fits the screen and shows examples that work; tables without cut-off texts."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress
from test_readme import check

import retwin as rt
from retwin.cli import command_tree
from retwin.cli.terminal import _TimeLeft, answer, bar, be_quiet, note, show_warnings, table
from retwin.progress import FinishedStage

WITHOUT_TABLES = {
    *("data convert", "twin simulate", "diagnose fit", "bundle save", "generate", "report"),
    "monitor run",
}
"""Commands that print a line at most; all others have --json."""


def commands(command: Any, *words: str) -> Iterator[tuple[str, Any]]:
    """Every command and group below one, by its words."""
    for name, each in getattr(command, "commands", {}).items():
        yield " ".join((*words, name)), each
        yield from commands(each, *words, name)


ALL: dict[str, Any] = dict(commands(command_tree()))


@pytest.fixture
def narrow(call, monkeypatch: pytest.MonkeyPatch):
    """Run `retwin …` as on a screen of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    return call


@pytest.fixture
def on_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard error is taken for a terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TTY_INTERACTIVE", "1")
    monkeypatch.setenv("TERM", "xterm")


def test_all_commands_fit_one_screen(narrow) -> None:
    code, out, err = narrow("--help")
    assert (code, err) == (0, "")
    lines = out.rstrip("\n").splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    for name, command in command_tree().commands.items():  # type: ignore[attr-defined]
        if command.hidden:
            continue
        (line,) = (line for line in lines if line.startswith(f"│ {name} "))
        assert "…" not in line


@pytest.mark.parametrize("name", [name for name, each in ALL.items() if hasattr(each, "params")])
def test_the_help_of_a_command_fits_50_lines(narrow, name: str) -> None:
    code, out, _ = narrow(*name.split(), "--help")
    assert code == 0
    assert len(out.splitlines()) <= 50


RECORDED = (
    *("data info", "data convert", "identify", "fit", "generate", "next", "study"),
    *("diagnose fit", "diagnose predict", "bundle save", "monitor fit", "monitor replay"),
)
"""Commands that take recorded data, which may be a log."""


@pytest.mark.parametrize("name", RECORDED)
def test_recorded_data_may_be_a_log_with_a_mapping(name: str) -> None:
    (option,) = (each for each in ALL[name].params if "--mapping" in each.opts)
    assert option.help == "What `retwin data map` wrote.", "the same everywhere"


@pytest.mark.parametrize("name", ALL)
def test_help_shows_an_example_that_works(name: str, narrow) -> None:
    code, out, _ = narrow(*name.split(), "--help")
    assert code == 0
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80
    (shown,) = (line.strip() for line in lines if "Example: " in line)
    example = shown.removeprefix("Example: retwin ")
    assert example.startswith(name), "one line, of this very command"
    check(example, whole=True)


def test_what_prints_a_table_prints_json() -> None:
    leaves = {name: each for name, each in ALL.items() if not hasattr(each, "commands")}
    with_json = {
        name for name, each in leaves.items() if any("--json" in p.opts for p in each.params)
    }
    assert with_json == set(leaves) - WITHOUT_TABLES


@pytest.mark.parametrize("width", [40, 80])
def test_nothing_in_a_table_is_cut_off(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    long = "a_name_without_any_space_" * 3
    answer(None, table(("[id]", "class"), [(long, "[red]Motor[/]"), (7, "x" * 50)]))
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= width
    whole = "".join(out.split()).replace("─", "")
    for text in ("[id]", "[red]Motor[/]"):
        assert text in whole
    assert "…" not in out
    assert [whole.count(letter) for letter in "7x"] == [1, 50]
    assert sum(out.count(letter) for letter in "_") == long.count("_")


def test_json_has_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    printed = {
        "a": float("nan"),
        "b": [float("inf"), 1.5],
        "c": "ö",
        "d": rt.scores.Scores(*(8 * [0.5]), 2),
    }
    answer(printed, "for people", as_json=True)
    read = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert (read["a"], read["b"], read["c"], read["d"]["n"]) == (None, [None, 1.5], "ö", 2)


def test_json_is_alone_on_stdout(narrow) -> None:
    code, out, err = narrow("twin", "info", "--json")
    assert (code, err) == (0, "")
    printed = json.loads(out)
    assert printed.keys() == {"built_in", "forms"}
    assert all(each.keys() == {"name", "title"} for each in printed["built_in"])
    assert all(each.keys() == {"form", "title"} for each in printed["forms"])
    code, out, err = narrow("twin", "info", "armpi-kinematic", "--json")
    assert (code, err) == (0, "")
    printed = json.loads(out)
    assert printed.keys() == {"title", "rate", "inputs", "outputs", "runs"}
    for each in (*printed["inputs"], *printed["outputs"]):
        assert each.keys() == {"name", "unit", "low", "high"}
    assert (printed["rate"], len(printed["inputs"]), len(printed["outputs"])) == (100, 4, 3)


def test_quiet_stands_before_the_command(narrow, monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    words = ("twin", "simulate", "armpi-kinematic", "--n", 2, "--out", tmp_path / "a.npz")
    assert narrow("--quiet", *words) == (0, "", "")
    assert "Wrote 2" in narrow(*words)[2], "the next command is not quiet"
    monkeypatch.setenv("RETWIN_QUIET", "1")
    assert narrow(*words) == (0, "", "")
    code, out, err = narrow("twin", "info", "nonsense")
    assert (code, out) == (2, "")
    assert "no such twin" in err, "errors are printed"
    monkeypatch.delenv("RETWIN_QUIET")
    assert "before the command" in narrow(*words, "--quiet")[2]


def test_a_bar_shows_the_time_left(on_screen, capsys: pytest.CaptureFixture[str]) -> None:
    with bar("study") as tell:
        for share in (0.0, 0.5, 0.9, 0.1):
            tell("diagnosis", share)
        time_left = capsys.readouterr().err
    assert "study: diagnosis" in time_left
    assert "left" in time_left
    assert max(len(line) for line in Console().render_str(time_left).plain.splitlines()) < 200


def test_the_time_left_counts_a_standstill_and_not_what_was_done_before() -> None:
    now = [0.0]
    progress = Progress(_TimeLeft(), get_time=lambda: now[0])
    place = progress.add_task("study", total=1.0, before=0.0)
    task = progress.tasks[place]
    progress.update(place, completed=0.1)
    now[0] = 1.0
    assert _TimeLeft().render(task).plain == "-:--:-- left", "too early to tell"
    now[0] = 100.0  # nothing moved
    assert _TimeLeft().render(task).plain == "0:15:00 left"
    progress.update(place, completed=0.6, before=0.5)  # half was done before
    assert _TimeLeft().render(task).plain == "0:06:40 left"


def test_a_log_shows_the_progress_of_long_work_only(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("retwin.cli.terminal.time.monotonic", lambda: now[0])
    with bar("fit") as tell:
        for second in range(11):
            now[0] = float(second)
            tell("net [1]", second / 10)
        now[0] = 20.0
        tell("distribution", 0.0)
        now[0] = 40.0
        tell("distribution", 0.5)
        tell("distribution", 0.51)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "fit: net [1] 20%, 8 s left"
    assert lines[-2:] == ["fit: distribution 0%", "fit: distribution 50%, 20 s left"]
    assert len(lines) == 11


def test_finished_stages_stay(on_screen, capsys: pytest.CaptureFixture[str]) -> None:
    with bar("study") as show:
        show("surrogate", 0.4)
        show(FinishedStage("surrogate"), 0.5)
        show("diagnoses", 0.6)
    shown = Console().render_str(capsys.readouterr().err).plain
    assert re.search(r"✓\S* 0:00  surrogate\s*\n", shown)
    assert "✓ 0:00  diagnoses" not in shown


def test_a_warning_has_a_line_of_its_own_while_a_bar_is_shown(
    on_screen, capsys: pytest.CaptureFixture[str]
) -> None:
    with show_warnings(), bar("study") as show:
        show("data", 0.4)
        warnings.warn("some commands are not certain", stacklevel=1)
        show("data", 0.5)
    printed = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().err)
    assert "warning: some commands are not certain" in printed
    assert not re.search(r"left *warning", printed), "the bar is erased before it"


def test_a_warning_is_shown_once(capsys: pytest.CaptureFixture[str]) -> None:
    with show_warnings():
        for _ in range(3):
            warnings.warn("its reset does not restore the initial state", stacklevel=1)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
        warnings.warn("another", stacklevel=1)
    assert capsys.readouterr().err.count("warning: ") == 2


def test_quiet_leaves_out_bars_and_notes(on_screen, capsys: pytest.CaptureFixture[str]) -> None:
    be_quiet(True)
    try:
        with bar("fit") as tell:
            tell("net", 0.5)
        note("saved")
        answer(None, "result")
    finally:
        be_quiet(False)
    assert tuple(capsys.readouterr()) == ("result\n", "")


def test_names_do_not_steer_the_terminal(
    on_screen, narrow, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Escape codes, a lone byte of a file's name, text that runs to the left."""
    odd = "a\x1b[31m\x9b1m\udcff\u202e"
    shown = r"a\u001b[31m\u009b1m\udcff\u202e"
    answer(None, odd, table((odd, "b"), [(1, odd)]))
    answer({"name": odd[:-2]}, as_json=True)
    note(odd)
    with bar("read") as show:
        show(odd, 0.5)
    with show_warnings():
        warnings.warn(odd, stacklevel=1)
    printed = capsys.readouterr()
    _, out, err = narrow("data", "info", tmp_path / odd)
    for text in (printed.out, printed.err, out, err):
        assert not set("\x9b\udcff\u202e") & set(text)
        assert odd[:6] not in text
    assert shown in err
    assert printed.out.count(shown) == 3
    assert printed.err.count(shown) >= 3


def test_bytes_of_a_name_that_are_no_text_are_shown(narrow, tmp_path, monkeypatch) -> None:
    name = os.fsdecode(b"a\xff.npz")
    made = rt.Trajectories(np.zeros((2, 5, 1)), np.zeros((2, 5, 1)), np.zeros((2, 5, 1)), 10.0)
    monkeypatch.chdir(tmp_path)
    rt.save(made, name)
    for more in ((), ("--json",)):
        code, out, _ = narrow("data", "info", name, *more)
        assert code == 0
        assert r"a\udcff.npz" in out
