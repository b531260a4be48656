"""`results.json`: what one model writes, the same model reads; files of schema 1 open."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from retwin.catalog import METRICS
from retwin.errors import InputError
from retwin.results import Results, read_results
from retwin.scores import classification

FILES = sorted((Path(__file__).parent / "schema_1").glob("*.json"))


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_a_file_of_schema_1_is_read_and_written_the_same(file: Path, tmp_path: Path) -> None:
    text = file.read_text("utf-8")
    (tmp_path / "results.json").write_text(text, encoding="utf-8")
    results = read_results(tmp_path)
    assert json.loads(results.to_json()) == json.loads(text)
    assert Results.model_validate_json(results.to_json()).to_json() == results.to_json()


def test_both_kinds_of_study_are_among_the_files() -> None:
    found = {file.stem: Results.model_validate_json(file.read_text("utf-8")) for file in FILES}
    assert found["arm"].classes
    assert found["arm"].overlay is not None
    assert [point.healthy for point in found["arm"].learning_curve or []] == [1, 2, 3]
    assert not found["plant"].classes
    assert math.isnan(found["plant"].sources["twin"].mean("coverage90"))


def test_null_is_nan_for_a_number_and_absent_for_anything_else() -> None:
    content = {
        "schema": 1,
        "case": "a",
        "title": None,
        "runs": 2,
        "sources": {"dt": {"auroc": [0.5, None], "notes": None, "update_s": None}},
        "timing": {"total_s": math.nan},
    }
    results = Results.model_validate(content)
    assert results.title == ""
    assert results.sources["dt"].mean("auroc") == 0.5
    written = json.loads(results.to_json())
    assert written["sources"]["dt"] == {"auroc": [0.5, None], "update_s": None}
    assert written["timing"] == {"total_s": None}


def test_every_score_of_a_diagnoser_is_a_metric_of_the_catalog() -> None:
    assert set(classification.METRICS) <= set(METRICS)


def test_the_model_needs_no_numpy() -> None:
    code = "import sys, retwin.results; assert not {'numpy', 'torch'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def changed(folder: Path, name: str, change) -> Path:
    content = json.loads((FILES[0].parent / name).read_text("utf-8"))
    change(content)
    (folder / "results.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("part", ["sources", "comparisons", "fidelity"])
def test_names_of_sources_that_do_not_agree_are_refused(tmp_path: Path, part: str) -> None:
    def rename(content) -> None:
        if part == "comparisons":
            content[part][0]["b"] = "other"
        else:
            content[part] = {f"other_{name}": each for name, each in content[part].items()}

    with pytest.raises(InputError, match="is none of the sources"):
        read_results(changed(tmp_path, "arm.json", rename))


def test_results_that_are_nested_too_deeply_are_refused(tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text('{"schema": 1, "x": ' + "[" * 100_000)
    with pytest.raises(InputError, match="nested too deeply"):
        read_results(tmp_path)
