"""What the README and the docs show is true: code runs, commands exist, the drawing is complete."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from test_architecture import ROOMS

import retwin as rt
from retwin.cli import command_tree

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
MADE = re.compile(r"(cli|api(/\w+)?)\.md")
"""Pages that are made from the code when the site is built; the build checks links to them."""


def blocks(page: Path, *languages: str) -> list[str]:
    """The fenced blocks of a page in one of the languages."""
    found = re.findall(r"^```(\w*)[^\n]*\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)
    return [text for language, text in found if language in languages]


def section(page: str, title: str) -> str:
    """The part of a page of docs/ under the heading, or in the tab, of this title."""
    text = (ROOT / "docs" / f"{page}.md").read_text("utf-8")
    tab = re.search(rf"^/// tab \| {re.escape(title)}\n(.*?)^///$", text, re.M | re.S)
    if tab:
        return tab[1]
    prose = re.sub(
        r"^```.*?^```", lambda code: re.sub(r"[^\n]", " ", code[0]), text, flags=re.M | re.S
    )
    begin = re.search(rf"^(#+) {re.escape(title)}$", prose, re.M)
    assert begin, f"docs/{page}.md has no heading {title!r}"
    end = re.search(rf"^#{{1,{len(begin[1])}}} ", prose[begin.end() :], re.M)
    return text[begin.end() :][: end.start() if end else None]


def python_of(page: str, title: str) -> list[str]:
    """The Python blocks of a part of a page."""
    return re.findall(r"^```python\n(.*?)^```", section(page, title), re.M | re.S)


def shown(page: Path) -> list[tuple[str, bool]]:
    """Every `retwin …` command of a page, and whether it is whole (a line of a shell block)."""
    lines = [
        line.strip()
        for block in blocks(page, "sh", "bash", "console", "shell")
        for line in block.replace("\\\n", " ").splitlines()
    ]
    whole = [line for line in lines if re.match(r"(\$ )?([A-Z_]+=\S+ )*retwin\s", line)]
    prose = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)
    mentioned = re.findall(r"`(retwin\s[^`]+)`", prose)
    return [(re.sub(r"^.*?retwin\s", "", line), True) for line in whole] + [
        (line.removeprefix("retwin "), False) for line in mentioned
    ]


def check(line: str, *, whole: bool) -> None:
    """Compare a command with the command line; `whole`: no argument may be missing."""
    command: Any = command_tree()
    words = shlex.split(re.split(r"\s(?:&&|\||>)\s", line)[0], comments=True)
    while words and hasattr(command, "commands") and not words[0].startswith("-"):
        assert words[0] in command.commands, f"no command {words[0]!r} in: retwin {line}"
        command = command.commands[words.pop(0)]
    if whole and words != ["--version"]:
        assert not hasattr(command, "commands"), f"an unfinished command: retwin {line}"
        command.make_context(command.name, words)
    known = {name for each in command.params for name in each.opts} | {"--help"}
    unknown = {word.split("=")[0] for word in words if word.startswith("--")} - known
    assert not unknown, f"no option {unknown} in: retwin {line}"


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text("utf-8")) <= 7000


@pytest.mark.slow
def test_the_code_of_the_readme_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = blocks(ROOT / "README.md", "python")
    exec(compile(code, "README.md", "exec"), {})
    assert "macro_f1" in capsys.readouterr().out


@pytest.mark.slow
def test_the_first_path_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a simulator and CSV files to bands and a monitor that names what broke."""
    shutil.copytree(ROOT / "examples" / "heater", tmp_path, dirs_exist_ok=True)
    monkeypatch.setenv("COLUMNS", "200")
    (block,) = (each for each in blocks(ROOT / "README.md", "sh") if "examples/heater" in each)
    _, *lines = block.splitlines()
    printed = ""
    for line in lines:
        program, *words = shlex.split(line)
        words = words if program == "python" else ["-m", "retwin", *words]
        done = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        printed = done.stdout
    assert re.search(r"run6\.csv, from 6\d\d s.*\n +heater: another effect", printed), printed
    assert len((tmp_path / "bands.csv").read_text().splitlines()) == 1201


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_every_command_shown_exists(page: Path) -> None:
    for line, whole in shown(page):
        check(line, whole=whole)


@pytest.mark.parametrize("line", ["nonsense", "data nonsense", "fit armpi --nonsense 1", "data"])
def test_a_wrong_command_is_seen(line: str) -> None:
    with pytest.raises(Exception, match=r"nonsense|unfinished"):
        check(line, whole=True)


def test_the_drawing_lists_the_rooms_in_their_order() -> None:
    (house,) = (
        block for block in blocks(ROOT / "docs" / "architecture.md", "") if "src/retwin/" in block
    )
    source = ROOT / "src" / "retwin"
    built = {path.stem for path in source.iterdir() if not path.name.startswith("__")}
    drawn = re.findall(r"^  (\w+)(?:\.py|/) ", house, re.M)
    assert drawn == [module for room in ROOMS for module in room if module in built]


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)", page.read_text("utf-8")):
        if not target.startswith("http") and not MADE.fullmatch(target):
            assert (page.parent / target).exists(), target


def test_versions_agree() -> None:
    assert f"\nversion: {rt.__version__}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"## [{rt.__version__}]" in (ROOT / "CHANGELOG.md").read_text("utf-8")
