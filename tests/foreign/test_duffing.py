"""An oscillator with its resonance at 68 Hz, sampled at 610 Hz, through the command line alone."""

from __future__ import annotations

import json
from pathlib import Path

import duffing
import numpy as np
import pytest
from terminal import retwin

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the user, and a study of them."""
    made = tmp_path_factory.mktemp("duffing")
    duffing.write_case(made)
    duffing.write_record(made / "record.csv", 1)
    words = "--data record.csv --per-class 100 --runs 1 --processes 1 --out study --json"
    (made / "study.json").write_text(retwin(made, f"study duffing.toml {words}").out)
    return made


def test_the_twin_is_described(folder: Path) -> None:
    found = retwin(folder, "twin info duffing.toml --json").json
    assert found["rate"] == 610
    assert found["inputs"] == [{"name": "force", "unit": "N", "low": -2, "high": 2}]
    assert found["outputs"] == [{"name": "x", "unit": "mm", "low": None, "high": None}]


def test_the_corrected_twin_is_closer_to_the_records(folder: Path) -> None:
    found = json.loads((folder / "study.json").read_text())
    rows = {(row["a"], row["b"], row["metric"]): row for row in found["comparisons"]}
    against_twin = rows["ibg_rg", "twin", "crps"]
    assert against_twin["bootstrap_ci95"][1] < 0
    assert against_twin["outcome"] == "", "one run is too few for a verdict"
    (inside,) = found["sources"]["ibg_rg"]["coverage90"]
    assert 0.8 < inside < 0.98
    # The surrogate is that of the twin: it changes the error by little.
    errors = {name: found["sources"][name]["rmse"][0] for name in ("twin", "ibg")}
    assert errors["ibg"] == pytest.approx(errors["twin"], rel=0.1)


def test_the_page_is_written_again(folder: Path) -> None:
    page = folder / "study" / "report.html"
    before = page.read_bytes()
    retwin(folder, "report study")
    assert page.read_bytes() == before


def test_unmeasured_rows_and_a_sentinel(folder: Path) -> None:
    """NaN is a missing sample; a number that no sensor gives is refused by name."""
    header, *rows = (folder / "record.csv").read_text().splitlines()
    for name, value in (("nan", "nan"), ("sentinel", "3.4e38")):
        changed = [row.rpartition(",")[0] + f",{value}" for row in rows[500:520]]
        text = "\n".join([header, *rows[:500], *changed, *rows[520:]])
        (folder / f"{name}.csv").write_text(text)
    words = "--simulations 20 --no-yardstick --out"
    retwin(folder, f"fit duffing.toml --real nan.csv {words} holes")
    retwin(folder, "generate holes --per-class 2 --out holes.npz")
    with np.load(folder / "holes.npz") as made:
        assert np.isfinite(made["observed"]).all()
    ended = retwin(folder, f"fit duffing.toml --real sentinel.csv {words} wrong", code=2)
    *notes, line = ended.lines
    assert all("3.4e+38" in each for each in notes), notes
    assert line.startswith("error: calibration-1: expected numbers below ")
    assert "3.4e+38 for x" in line
    assert not (folder / "wrong").exists()
