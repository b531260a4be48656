"""A synthetic study as fixtures, and what is made of its folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from synthetic_study import Study, synthetic

from retwin.report.page import render
from retwin.report.sections import sections_of
from retwin.report.study import read_study


@pytest.fixture
def study() -> Study:
    """A synthetic study with ten runs."""
    return synthetic()


@pytest.fixture
def single() -> Study:
    """A synthetic study with one run."""
    return synthetic(runs=1)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[Study], Path]:
    """Writes a study to a folder as `retwin study` does."""

    def _write(study: Study) -> Path:
        results, arrays = study
        (tmp_path / "results.json").write_text(json.dumps(results), encoding="utf-8")
        if arrays:
            np.savez(tmp_path / "arrays.npz", allow_pickle=False, **arrays)
        return tmp_path

    return _write


@pytest.fixture
def rendered() -> Callable[[Path], str]:
    """The page of the study in a folder, without images."""

    def _rendered(folder: Path) -> str:
        whole = read_study(folder)
        return render(whole, sections_of(whole))

    return _rendered
