"""Odd arguments, and the real command line on each; run as a script.

`python arguments.py SAMPLES WORK` gives every number of every command an odd value, and every name
that a command writes to a place that cannot be written. `python arguments.py SAMPLES WORK FIRST
COUNT` mutates the words of all commands instead, with the seeds FIRST to FIRST + COUNT - 1. Both
print a line for every requirement that was not met: what is refused is refused with code 2, in one
line, before any work, and leaves nothing. Everything is imported once; each case runs in a forked
process of its own.
"""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mutation import broken, call, files_in, import_all

# The heaviest of what the commands import, so that the cases need not.
import retwin.cases.animation
import retwin.deploy.bundle.guard
import retwin.deploy.onnx.portable
import retwin.report.page
import retwin.study  # noqa: F401
from retwin.cli import command_tree

with contextlib.suppress(ImportError):  # when it is imported, it writes a file of its own
    import onnxruntime  # noqa: F401

LONG = "x" * 300
HUGE = "99999999999999999999"
NUMBERS = ("nan", "inf", "-inf", "-1", "0", HUGE, "1e308", "1e-300", "")
POSSIBLE = {
    "0": {"seed", "encoder_noise", "index", "port", "hold_out"},
    HUGE: {"chunk", "max_bytes", "processes", "workers", "rate"},
    "1e308": {"rate"},
    "1e-300": {"rate", "seconds", "hold_out"},
}
"""Options for which an odd number may be accepted."""
LONG_WORK = (*("demo", "diagnose fit", "export actuator", "fit", "monitor run", "study"),)
"""Commands that work for a long time, or download, on what they accept; it is not tried."""
NOT_RUN = (*("demo", "doctor", "export actuator", "export onnx", "monitor run", "study"),)
"""Commands of which only the reading of words is tried with mutated ones: they work for a long
time, or need a network."""
ODD_WORDS = ("", "-", "--", "-1", "nan", HUGE, "x" * 300, "none", "..", "set", "study", "--seed")
"""Words that replace one of a command."""
CHARACTERS = "\x01\x1b $%*:=,.0-[\\é\u202e\udcff"
"""Characters that replace one of a word; the last one is a byte that is no UTF-8."""
NO_PLACE = ("/", "/proc/none", "reach.toml/none", LONG, f"none/{LONG}", "study", "")
"""Names at which nothing can be written: the last but one is the folder of another study."""

BASE = {
    "bundle save": "model real.npz --case reach.toml",
    "data convert": "set",
    "data info": "set",
    "data map": "log.csv",
    "demo": "--runs 1",
    "diagnose fit": "real.npz",
    "diagnose predict": "cnn real.npz",
    "fit": "reach.toml --real real.npz --simulations 20",
    "generate": "model --case reach.toml --per-class 1",
    "evaluate": "model --real real.npz --case reach.toml",
    "export actuator": "model --torchscript-only",
    "export fmu": "model",
    "export onnx": "sealed",
    "identify": "own_of_mutations:reach real.npz --inputs first,second --outputs far,high --rate 10"
    " --free length=0.5:2",
    "monitor audit": "alarms.jsonl",
    "monitor fit": "model real.npz",
    "monitor recalibrate": "store --asset press",
    "monitor replay": "model real.npz",
    "monitor run": "--config reach.toml",
    "next": "reach.toml model --real real.npz --candidates 5 --count 1",
    "study": "reach.toml --real real.npz --folds 2 --sources dt,ibg --runs 1 --per-class 5",
    "twin info": "own_of_mutations:reach --inputs first,second --outputs far,high",
    "twin simulate": "reach.toml --n 2",
}
"""The least words with which each command works, but for those that name what it writes."""


def leaves(command: Any, *words: str) -> Iterator[tuple[str, Any]]:
    """Every command, by its words."""
    for name, each in command.commands.items():
        if hasattr(each, "commands"):
            yield from leaves(each, *words, name)
        else:
            yield " ".join((*words, name)), each


def is_option(parameter: Any) -> bool:
    return parameter.opts[0].startswith("-")


def is_number(parameter: Any) -> bool:
    return is_option(parameter) and parameter.metavar in ("N", "HZ", "X")


def is_target(parameter: Any) -> bool:
    """Whether it names what a command writes."""
    if is_option(parameter):
        return bool(parameter.name == "out")
    return str(parameter.metavar).endswith("OUT")


def is_odd(parameter: Any) -> bool:
    return is_number(parameter) or is_target(parameter)


def suffix(name: str, target: Any) -> str:
    """The suffix that a command wants of that name."""
    if target.metavar == "FOLDER":
        return ""
    own = {"data map": ".toml"}
    return own.get(name, ".csv" if "predict" in name else ".npz")


def cases() -> Iterator[tuple[str, list[str], bool]]:
    """Each command, its words with an odd value, and whether that may be accepted."""
    for name, command in leaves(command_tree()):
        if name not in BASE:
            continue
        places = [each for each in command.params if is_target(each)]

        def words(odd: dict[str, str], name: str = name, places: list[Any] = places) -> list[str]:
            made = [*name.split(), *BASE[name].split()]
            for each in places:
                if each.required or each.name in odd:
                    value = odd.get(each.name, f"new-{each.name}{suffix(name, each)}")
                    made += [each.opts[-1], value] if is_option(each) else [value]
            return made

        for option in command.params:
            if not is_number(option):
                continue
            for value in NUMBERS:
                possible = option.name in POSSIBLE.get(value, ())
                if not (possible and name in LONG_WORK):
                    yield name, [*words({}), option.opts[0], value], possible
        for place in places:
            for value in NO_PLACE:
                ending = suffix(name, place)
                odd = value + ending if value and value not in ("/", "study") else value
                yield name, words({place.name: odd}), False


def mutated(words: list[str], options: Sequence[str], rng: np.random.Generator) -> list[str]:
    """The words of a command, with one to three mutations of what follows its name."""
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(words) + 1))
        word = words[at % len(words)] if words else "x"
        odd = (*ODD_WORDS, *options)[rng.integers(len(ODD_WORDS) + len(options))]
        new = [
            [],
            [word, word],
            [odd],
            [odd, word],
            [word[: len(word) // 2]],
            [flipped(word, rng)],
        ][rng.integers(6)]
        words = [*words[:at], *new, *words[at + 1 :]]
    return words


def flipped(word: str, rng: np.random.Generator) -> str:
    """The word with another character in one place."""
    at = int(rng.integers(max(len(word), 1)))
    return word[:at] + CHARACTERS[rng.integers(len(CHARACTERS))] + word[at + 1 :]


def run_mutated(samples: Path, work: Path, first: int, count: int) -> Iterator[str]:
    """Every requirement that mutated words of a command make it break."""
    folder, output = work / "folder", work / "stderr"
    shutil.copytree(samples, folder)
    before = files_in(folder)
    commands = dict(leaves(command_tree()))
    names = sorted(commands)
    for seed in range(first, first + count):
        name = names[seed % len(names)]
        options = [opt for each in commands[name].params for opt in each.opts if is_option(each)]
        rest = mutated(sound(name, commands[name]), options, np.random.default_rng(seed))
        words = [*name.split(), *(["--none-such"] if name in NOT_RUN else []), *rest]
        ended = call(folder, words, output)
        problem = broken(ended, before, ended.files - before)
        if problem:
            yield f"{seed}: retwin {' '.join(words)[:200]}: {problem}"
        if ended.code == 0 or ended.files != before:
            shutil.rmtree(folder)
            shutil.copytree(samples, folder)


def sound(name: str, command: Any) -> list[str]:
    """Words with which a command works, without its name."""
    made = BASE.get(name, "").split()
    for each in command.params:
        if is_target(each) and each.required:
            value = f"new-{each.name}{suffix(name, each)}"
            made += [each.opts[-1], value] if is_option(each) else [value]
    return made


def run(samples: Path, work: Path, chosen: Sequence[str]) -> Iterator[str]:
    """Every requirement that an odd argument of a command makes it break."""
    folder, output = work / "folder", work / "stderr"
    shutil.copytree(samples, folder)
    before, modules, tried = files_in(folder), work / "modules", ""
    for name, words, possible in cases():
        if name not in chosen:
            continue
        ended = call(folder, words, output, modules if name != tried else None)
        if name != tried:
            tried = name
            import_all(modules)
        made = frozenset(name for name in ended.files if name.startswith("new-"))
        problem = broken(ended, before, made)
        if not problem and ended.code == 0 and not possible:
            problem = "is accepted"
        if problem:
            yield f"retwin {' '.join(words)[:200]}: {problem}"
        if ended.files != before:
            shutil.rmtree(folder)
            shutil.copytree(samples, folder)


if __name__ == "__main__":
    samples, work, *rest = sys.argv[1:]
    places = Path(samples), Path(work)
    numbers = [int(each) for each in rest if each.isdigit()]
    for failure in run_mutated(*places, *numbers) if numbers else run(*places, rest or list(BASE)):
        print(failure, flush=True)
