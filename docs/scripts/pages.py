"""Pages of the site that are made when it is built, from the code and from outside of docs/.

MkDocs calls the functions that begin with `on_` (hooks in mkdocs.yml).
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from pathlib import Path
from typing import Any, get_origin

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from typer.cli import get_docs_for_click

import retwin
from retwin.cli import app

sys.path.insert(0, str(Path(__file__).parent))  # MkDocs runs hooks as single files
from executing import executed

ROOT = Path(__file__).parents[2]
OUTSIDE = {
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "examples/heater": "heater.md",
    "examples/two_tanks": "two_tanks.md",
    "tests/testing/crane.xml": "crane.xml",
}
"""Files and folders outside of docs/ that the site has too, and their names there."""
OUTSIDE |= {
    f"benchmarks/results/{file.name}": f"results_{file.name}"
    for file in sorted((ROOT / "benchmarks" / "results").glob("*.md"))
}
EXECUTED = ("tutorial.md",)
"""Pages whose Python runs when the site is built; the examples of the API do, too."""
CONTINUED = {"api/report.md": "api/study.md"}
"""Pages whose Python goes on where that of another page, which stands before it, has ended."""
FOLDED = tuple(f"results_{part}.md" for part in ("arm", "systems", "monitor", "speed"))
"""Pages whose tables are folded."""
MEASURED = tuple(Path(name).stem for name in OUTSIDE if name.startswith("benchmarks/"))
"""The files of results."""
TABLE = re.compile(r"^\|.*\n(?:\|.*\n?){3,}", re.MULTILINE)
TAB = re.compile(r'<input[^>]* id="([^"]+)"')
DETAILS = '<details markdown="1"><summary>Table</summary>\n\n{table}\n\n</details>\n'
ABOUT_COMMANDS = """
Results go to stdout; progress, notes, warnings and errors to stderr. `retwin --quiet …`, or
`RETWIN_QUIET=1` in the environment, leaves out progress and notes. Where a command prints a table,
`--json` prints the same as JSON instead, and nothing else. After Ctrl-C one line says which command
goes on. `retwin --install-completion` lets bash, zsh, fish or PowerShell complete commands, options
and names: cases, twins, sources, faults, classifiers. Exit codes: 0 done, 1 failed, 2 bad input,
130 interrupted.
"""
LANGUAGES = {".py": "python", ".toml": "toml"}


def on_config(config: MkDocsConfig) -> None:
    """A page per room joins the overview of the API."""
    (reference,) = (part["Reference"] for part in config.nav if "Reference" in part)
    (api,) = (part["API"] for part in reference if isinstance(part, dict))
    api += [{module: f"api/{module}.md"} for module in modules()]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what is made from the code, and what lies elsewhere."""
    made = {"cli.md": commands(), "api.md": overview()}
    made |= {f"api/{module}.md": reference(module) for module in modules()}
    for path, name in OUTSIDE.items():
        if (ROOT / path).is_dir():
            made[name] = listing(ROOT / path)
        else:
            files.append(File.generated(config, name, abs_src_path=str(ROOT / path)))
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links stay within the site, examples are executed, and long tables are folded."""
    for path, name in OUTSIDE.items():
        markdown = re.sub(rf"\]\(\.\./{re.escape(path)}(?=[)#])", f"]({name}", markdown)
    if page.file.src_uri in OUTSIDE.values():
        markdown = re.sub(rf"\]\(({'|'.join(MEASURED)})\.md", r"](results_\1.md", markdown)
        markdown = re.sub(r"\]\((?:\.\./)*docs/", "](", markdown)
    name = page.file.src_uri
    if name in EXECUTED or name.startswith("api/"):
        markdown = executed(markdown, re.sub(r"\W", "_", CONTINUED.get(name, name)))
    return folded(markdown) if name in FOLDED else markdown


def on_page_content(html: str, page: Any, **_: Any) -> None:
    """Tabs get their anchors after MkDocs has collected those of a page, so collect them here."""
    page.present_anchor_ids |= set(TAB.findall(html))


def folded(markdown: str) -> str:
    """The page with its tables folded, so that its figures come first."""
    return TABLE.sub(lambda found: DETAILS.format(table=found[0]), markdown)


def listing(folder: Path) -> str:
    """The files of a folder, as a page."""
    parts = [f"# {folder.relative_to(ROOT)}"]
    for file in sorted(file for file in folder.iterdir() if file.suffix in LANGUAGES):
        text = file.read_text("utf-8")
        parts += [f"## {file.name}", f"```{LANGUAGES[file.suffix]}\n{text}```"]
    return "\n\n".join(parts)


def commands() -> str:
    """The command line as a page, as Typer knows it."""
    command: Any = typer.main.get_command(app)
    _say_whole_lines(command)
    context = typer.Context(command, info_name="retwin")
    text = get_docs_for_click(obj=command, ctx=context, name="retwin", title="Command line")
    text = re.sub(r"^\* `--help`: .*\n", "", text, flags=re.M)
    text = re.sub(r"(?<!`)\*\.\w+", r"`\g<0>`", text)  # two stars would make a text italic
    text = re.sub(r"^Example: (.*)", r"**Example**:\n\n```console\n$ \1\n```", text, flags=re.M)
    title, rest = text.split("\n", 1)
    return f"{title}\n{ABOUT_COMMANDS}{rest}"


def _say_whole_lines(command: Any) -> None:
    """In lists of commands, the first line of their help is not cut short."""
    for each in getattr(command, "commands", {}).values():
        each.short_help = (each.help or "").strip().split("\n")[0]
        _say_whole_lines(each)


def modules() -> dict[str, list[str]]:
    """Room to the dotted names of its public objects, rooms in the order of the architecture page.

    An object is public if `retwin` or its room has it.
    """
    names = {f"{home}.{name}" for name, home in retwin._HOME.items()}
    for room in retwin._ROOMS:
        names |= {f"{room}.{name}" for name in getattr(_module(room), "__all__", ())}
    drawn = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    rooms = re.findall(r"^  (\w+)(?:\.py|/) ", drawn, re.M)
    objects: dict[str, dict[str, str]] = {room: {} for room in rooms}
    for name in sorted(names):
        room = name.split(".")[0]
        objects[room].setdefault(_path(name), name)
    return {room: list(found.values()) for room, found in objects.items() if found}


def overview() -> str:
    """Every public name with its first line."""
    lines = ["# API reference", "", "Generated from the docstrings.", ""]
    for room, names in modules().items():
        lines += [f"## [retwin.{room}](api/{room}.md)", "", *_first(_module(room)), ""]
        lines += ["| name | is |", "|---|---|"]
        for name in names:
            (text,) = _first(_found(name)) or ("",)
            lines.append(f"| [`{_shown(name)}`](api/{room}.md#{_path(name)}) | {text} |")
        lines.append("")
    return "\n".join(lines)


def reference(room: str) -> str:
    """The page of one room."""
    lines = [f"# retwin.{room}", "", *_first(_module(room)), ""]
    example = ROOT / "docs" / "examples" / f"{room}.md"
    if example.exists():
        lines += ["## Examples", "", example.read_text("utf-8"), ""]
    for name in modules()[room]:
        lines += [f"::: {_path(name)}", "    options:", f"      heading: {_shown(name)}", ""]
    return "\n".join(lines)


def _shown(name: str) -> str:
    """How a user writes a dotted name."""
    last = name.rpartition(".")[2]
    return f"retwin.{last if last in retwin._HOME else name}"


def _path(name: str) -> str:
    """Where an object is defined."""
    found = _found(name)
    if inspect.isclass(found) or inspect.isfunction(found):
        return f"{found.__module__}.{found.__qualname__}"
    room, _, last = name.rpartition(".")
    home = getattr(_module(room), "_HOME", {}).get(last)
    return f"retwin.{room}.{home}.{last}" if home else f"retwin.{name}"


def _found(name: str) -> Any:
    home, _, last = name.rpartition(".")
    return getattr(_module(home), last)


def _module(name: str) -> Any:
    return importlib.import_module(f"retwin.{name}")


def _first(documented: Any) -> list[str]:
    """The first line of its docstring; of a value, which has none of its own, what it is."""
    if not (inspect.ismodule(documented) or inspect.isclass(documented) or callable(documented)):
        return [f"a constant, `{type(documented).__name__}`"]
    if get_origin(documented) is not None:
        return ["a type"]
    text = inspect.getdoc(documented) or ""
    return [text.split("\n\n")[0].replace("\n", " ").replace("|", "\\|")] if text else []
