from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.cases.silver_box.case import ARROW, REALISATIONS, silverbox
from retwin.testing import check_twin
from retwin.update.identification import LeastSquares, identify


def test_the_twin_passes_its_contract() -> None:
    case = silverbox()
    check_twin(case.twin, case.sampler.sample(3, rng=np.random.default_rng(0))[:, :200])


def test_records_do_not_overlap() -> None:
    rows = sorted([ARROW, *REALISATIONS])
    assert all(end <= first for (_, end), (first, _) in pairwise(rows))
    assert rows[-1][1] <= 131_072


@pytest.mark.slow
@pytest.mark.real_data
def test_a_cubic_spring_explains_the_real_circuit() -> None:
    """Realisations 1 to 9 identify it; the arrow and realisation 10 are simulated."""
    file = Path(os.environ.get("RETWIN_DATA", "")) / "silverbox" / "SNLS80mV.csv"
    if not file.is_file():
        pytest.skip("RETWIN_DATA names no folder with silverbox/SNLS80mV.csv")
    case = rt.cases.get("silverbox")
    calibration, test = case.records(file)

    def rmse(twin: rt.Twin) -> np.ndarray:
        error = twin.simulate(test.commands, seed=0).observed - test.observed
        return 1000 * np.sqrt(np.nanmean(np.where(test.mask, error, np.nan) ** 2, axis=(1, 2)))

    np.testing.assert_allclose(rmse(case.twin), [7.25, 14.4], rtol=0.01)
    method = LeastSquares(starts=1, loss="linear")
    found = identify(case.parametric, calibration, seed=0, method=method)
    np.testing.assert_allclose(rmse(found.twin), [0.31, 0.39], atol=0.02)
