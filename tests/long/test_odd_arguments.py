"""Odd arguments: each command refuses them in one line, before any work, and leaves nothing."""

from __future__ import annotations

import shutil
from pathlib import Path

import arguments
import log_files
import mutation
import pytest

from retwin.cli import command_tree


@pytest.fixture
def together(samples: Path, tmp_path: Path) -> Path:
    """One folder with a sample of everything that a command reads."""
    folder = tmp_path / "together"
    shutil.copytree(samples / "csv", folder)
    for name in ("model/model", "diagnoser/cnn", "bundle/sealed", "results/study"):
        shutil.copytree(samples / name, folder / Path(name).name)
    shutil.copy(samples / "npz" / "a.npz", folder / "real.npz")
    shutil.copy(samples / "case" / "case.toml", folder / "reach.toml")
    shutil.copy(samples / "case" / "own_of_mutations.py", folder)
    log_files.csv(folder / "log.csv")
    (folder / "alarms.jsonl").touch()  # a log without entries
    return folder


def test_every_command_with_a_number_or_a_target_is_tried() -> None:
    for name, command in arguments.leaves(command_tree()):
        odd = [each for each in command.params if arguments.is_odd(each)]
        assert name in arguments.BASE or not odd, name


@pytest.mark.slow
def test_odd_arguments(together: Path, tmp_path: Path) -> None:
    assert len(list(arguments.cases())) >= 300
    (tmp_path / "work").mkdir()
    assert mutation.printed(arguments.__file__, together, tmp_path / "work") == []


def mutated(together: Path, work: Path, first: int, count: int) -> list[str]:
    """A line for each mutated list of words with which a requirement is not met."""
    work.mkdir()
    return mutation.printed(arguments.__file__, together, work, first, count)


@pytest.mark.slow
def test_some_mutated_words(together: Path, tmp_path: Path) -> None:
    assert mutated(together, tmp_path / "work", 0, 150) == []


@pytest.mark.long
def test_mutated_words(together: Path, tmp_path: Path) -> None:
    assert mutated(together, tmp_path / "work", 150, 2000) == []
