from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retwin.cases.styrofoam_incubator.case import WARM_UP, incubator, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR, POWER
from retwin.testing import check_twin
from retwin.update.identification import LeastSquares, identify


def test_the_twin_passes_its_contract() -> None:
    case = incubator()
    sampler = replace(case.sampler, duration=600.0, hold_durations=(15.0, 90.0))
    check_twin(case.twin, sampler.sample(3, rng=np.random.default_rng(0)))


def test_heat_is_conserved_at_rest() -> None:
    """What the heater gives is lost to the room, through both conductances."""
    g_box, g_heater = (
        each.start for each in INCUBATOR.parameters if each.name in ("g_box", "g_heater")
    )
    states = INCUBATOR.hidden(np.tile([0.3, 21.0], (1, 4000, 1)))[0, -1]
    air = 21 + 0.3 * POWER / g_box
    np.testing.assert_allclose(states, [air + 0.3 * POWER / g_heater, air], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.filterwarnings("ignore:not identified|at a bound")
def test_four_parameters_follow_the_real_incubator_to_a_kelvin() -> None:
    """The start is inferred from the first 120 s, and the rest simulated (docs/results.md)."""
    folder = Path(os.environ.get("RETWIN_DATA", "")) / "incubator"
    if not folder.is_dir():
        pytest.skip("RETWIN_DATA names no folder with incubator/*.csv")
    calibration, scored = measurements()(folder)
    _, test = measurements(warm_up=0)(folder)
    assert calibration.mask.all()
    assert calibration.commands[0, :, 0].mean() == pytest.approx(92 / 2348, abs=1e-4)
    method = LeastSquares(starts=1, loss="linear")
    found = identify(INCUBATOR.parametric(), calibration, seed=0, method=method)
    assert found.figures["rms_after"] == pytest.approx(1.73, abs=0.01)
    physics = found.twin.holding(*(each.name for each in INCUBATOR.parameters))
    rmse = []
    for index in range(len(test)):
        one = test[[index]]
        warm = identify(physics, one.between(0, WARM_UP), seed=0, method=method)
        error = warm.twin.simulate(one.commands, seed=0).observed - scored[[index]].observed
        rmse.append(np.sqrt(np.mean(error[scored.mask[[index]]] ** 2)))
    np.testing.assert_allclose(rmse, [1.08, 0.843, 0.938], atol=0.02)
    assert scored.mask.any(axis=2).sum(axis=1).tolist() == [939, 1081, 180]
