"""Damaged files of every format: the command line refuses each in one line, or reads it."""

from __future__ import annotations

from pathlib import Path

import mutation
import pytest

CASES = {
    "npz": 300,
    "zarr": 250,
    "mat": 300,
    "csv": 250,
    "case": 300,
    "model": 250,
    "diagnoser": 200,
    "bundle": 250,
    "onnx": 200,
    "results": 100,
    **{f"log-{kind}": 50 for kind in mutation.LOGS},
}
"""Mutations of each format before a release."""


def failures(samples: Path, work: Path, count: int, *names: str) -> list[str]:
    """A line for each case, with its format and seed, in which a requirement is not met."""
    return mutation.printed(mutation.__file__, samples, work, 0, count, *names)


@pytest.mark.slow
def test_some_mutated_files(samples: Path, tmp_path: Path) -> None:
    """Of every format but ONNX, whose export alone takes 14 s, and logs, which start a process.

    The fast tier damages files of every format where they are read.
    """
    names = [name for name in mutation.NAMES if name != "onnx" and "log-" not in name]
    assert failures(samples, tmp_path, -(-60 // len(names)), *names) == []


@pytest.mark.long
@pytest.mark.parametrize("name", mutation.NAMES)
def test_mutated_files(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    assert sum(CASES.values()) >= 2000
    samples = request.getfixturevalue("exported" if name == "onnx" else "samples")
    assert failures(samples, tmp_path, CASES[name], name) == []
