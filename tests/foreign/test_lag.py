"""FMUs of a user's own, sound and unsound, through the command line alone."""

from __future__ import annotations

import json
from pathlib import Path

import lag
import numpy as np
import pytest
from fmus import c_fmu
from terminal import retwin

pytestmark = pytest.mark.slow
FORGETFUL = {"good": 0, "forgetful": 2}
LIMITS = "low = [-10, -1, -1]\nhigh = [10, 1, 1]"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two FMUs, their cases, and a record."""
    made = tmp_path_factory.mktemp("lag")
    for name, reset in FORGETFUL.items():
        c_fmu(made, reset=reset, name=name)
        lag.write_case(made, name, name)
    lag.write_case(made, "good", "arrays", inputs=("u", "pair"), more=("sums",), limits=LIMITS)
    trouble = "low = [-10, 0]\nhigh = [10, 3]"
    lag.write_case(made, "good", "trouble", inputs=("u", "trouble"), limits=trouble)
    lag.write_record(made / "record.csv", 1)
    return made


def test_an_fmu_is_simulated_as_its_equation(folder: Path) -> None:
    assert retwin(folder, "twin simulate good.toml --n 6 --out good.npz").err == ""
    with np.load(folder / "good.npz") as made:
        exact = lag.followed(made["commands"][..., 0].astype(float))
        np.testing.assert_allclose(made["observed"][..., 0], exact, atol=1e-5)


def test_one_that_forgets_to_reset_gives_the_same_with_a_warning(folder: Path) -> None:
    """Whatever the number of workers."""
    retwin(folder, "twin simulate good.toml --n 6 --seed 3 --chunk 3 --out right.zarr")
    retwin(folder, "data convert right.zarr right.npz")
    for workers in (1, 2):
        words = f"--n 6 --seed 3 --workers {workers} --chunk 3 --out forgetful-{workers}.zarr"
        ended = retwin(folder, f"twin simulate forgetful.toml {words}")
        (line,) = ended.lines
        assert line.startswith("warning: forgetful.fmu: its reset does not restore")
        retwin(folder, f"data convert forgetful-{workers}.zarr forgetful-{workers}.npz")
        with (
            np.load(folder / f"forgetful-{workers}.npz") as made,
            np.load(folder / "right.npz") as right,
        ):
            np.testing.assert_array_equal(made["observed"], right["observed"])


def test_arrays_are_channels(folder: Path) -> None:
    found = retwin(folder, "twin info arrays.toml --json").json
    assert [each["name"] for each in found["inputs"]] == ["u", "pair[0]", "pair[1]"]
    assert [each["name"] for each in found["outputs"]] == ["x", "sums[0]", "sums[1]"]
    retwin(folder, "twin simulate arrays.toml --n 2 --out arrays.npz")
    with np.load(folder / "arrays.npz") as made:
        pair = made["commands"][..., 1:].astype(float)
        sums = np.cumsum(pair, axis=1) - pair
        np.testing.assert_allclose(made["observed"][..., 1], 3 * sums[..., 0], atol=1e-4)
        np.testing.assert_allclose(made["observed"][..., 2], sums[..., 1], atol=1e-4)


@pytest.mark.parametrize(
    ("trouble", "reason"), [(1, "5 s"), (2, "crash|SIGSEGV|signal"), (4, "x is nan from 1.02 s")]
)
def test_a_run_that_fails_is_named_and_the_others_are_kept(
    trouble: int, reason: str, folder: Path
) -> None:
    """It hangs, crashes, or gives NaN."""
    lag.write_commands(folder / f"runs-{trouble}", [0, trouble, 0])
    words = f"--commands runs-{trouble} --out failed-{trouble}.npz"
    ended = retwin(folder, f"twin simulate trouble.toml {words}", code=1)
    (line,) = ended.lines
    assert line.startswith("error: ")
    assert any(word in line for word in reason.split("|")), line
    assert "1 of 3" in line
    assert "trajectory 1" in line
    with np.load(folder / f"failed-{trouble}.npz") as made:
        assert made["ids"].tolist() == ["00000", "00002"]
        assert np.isfinite(made["observed"]).all()


def test_a_study_of_an_fmu(folder: Path) -> None:
    words = "--data record.csv --per-class 60 --runs 1 --processes 1 --out study --json"
    found = retwin(folder, f"study good.toml {words}").json
    rmse, crps = (
        {name: source[metric][0] for name, source in found["sources"].items()}
        for metric in ("rmse", "crps")
    )
    assert rmse["ibg"] == pytest.approx(rmse["twin"], rel=0.15)
    assert rmse["ibg_rg"] < 0.7 * rmse["twin"]
    assert crps["ibg_rg"] < 0.7 * crps["twin"]
    assert 0.75 < found["sources"]["ibg_rg"]["coverage90"][0] <= 1
    results = json.loads((folder / "study" / "results.json").read_text())
    assert all(row["no_verdict"] for row in results["comparisons"])
