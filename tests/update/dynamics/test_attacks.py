"""Corrected dynamics with settings, files and requests that are wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

import retwin as rt
from retwin.errors import InputError
from retwin.twins import Parameter, State, StateTwin
from retwin.twins.compiled import model
from retwin.update import Dynamics, DynamicsTwin, Library, fit_dynamics

COMMANDS = np.cumsum(np.random.default_rng(0).normal(size=(2, 120, 1)), axis=1) / 5
LAG = StateTwin(
    (State("x", "m"),),
    lambda x, u: x.x,
    rt.Channels(("u",), ("V",)),
    rt.Channels(("y",), ("m",)),
    20.0,
    derivative=lambda x, u, p: (u.u - p.rate * x.x,),
    parameters=(Parameter("rate", "1/s", 0.1, 20.0, 2.0),),
)
QUICK = Library(1, (), False)


def record() -> rt.Trajectories:
    made = LAG.simulate(COMMANDS, seed=0, parameters={"rate": 3.0})
    noise = 1e-3 * np.random.default_rng(1).normal(size=made.observed.shape)
    return made.replace(observed=made.observed + noise)


@pytest.fixture(scope="module")
def fitted() -> DynamicsTwin:
    return fit_dynamics(LAG, record(), Dynamics(QUICK)).twin


def test_a_switch_that_is_no_bool_is_refused() -> None:
    with pytest.raises(InputError, match="friction"):
        Library(friction="no")  # type: ignore[arg-type]


def test_levels_that_are_no_probabilities_are_refused(fitted: DynamicsTwin) -> None:
    found = fitted.predictive(record())
    with pytest.raises(InputError, match="share"):
        found.coverage(90)
    for level in (95, [0.5, -0.1], float("nan")):
        with pytest.raises(InputError, match="level"):
            found.quantile(level)


def test_nothing_measured_has_no_coverage(fitted: DynamicsTwin) -> None:
    whole = record()
    assert np.isnan(fitted.predictive(whole.replace(mask=whole.mask & False)).coverage()).all()


@pytest.mark.parametrize("substeps", [10**9, 0, 1.5, "4", True])
def test_a_forged_model_cannot_take_forever(fitted: DynamicsTwin, tmp_path, substeps) -> None:
    fitted.save(tmp_path / "model")
    file = tmp_path / "model" / "model.json"
    about = json.loads(file.read_text())
    about["equations"]["substeps"] = substeps
    file.write_text(json.dumps(about))
    with pytest.raises(InputError, match="substeps"):
        DynamicsTwin.load(tmp_path / "model")


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("equations", "slope"), [0, 1]),
        (("equations", "slope"), []),
        (("equations", "results"), []),
        (("equations", "discrete"), "false"),
        (("corrected",), ["nope"]),
        (("emulated",), "no"),
    ],
)
def test_a_forged_description_is_refused(fitted: DynamicsTwin, tmp_path, keys, value) -> None:
    fitted.save(tmp_path / "model")
    file = tmp_path / "model" / "model.json"
    about = json.loads(file.read_text())
    part = about if len(keys) == 1 else about[keys[0]]
    part[keys[-1]] = value
    file.write_text(json.dumps(about))
    with pytest.raises(InputError):
        DynamicsTwin.load(tmp_path / "model")


def test_a_long_forged_model_is_loaded_without_tracing(
    fitted: DynamicsTwin, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tracing takes 0.2 ms per operation: minutes for a file of some MB."""
    fitted.save(tmp_path / "model")
    file = tmp_path / "model" / "model.json"
    about = json.loads(file.read_text())
    equations = about["equations"]
    for _ in range(30_000):
        equations["operations"].append(["sin", [len(equations["operations"]) - 1], ""])
    equations["slope"] = [len(equations["operations"]) - 1]
    file.write_text(json.dumps(about))

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the equations were traced")

    monkeypatch.setattr(model, "trace_model", refuse)
    DynamicsTwin.load(tmp_path / "model")


@pytest.mark.parametrize("observed", [None, COMMANDS, "record.npz"])
def test_what_is_no_record_is_refused(observed: object) -> None:
    with pytest.raises(InputError, match="observed: expected Trajectories, got"):
        fit_dynamics(LAG, observed)  # type: ignore[arg-type]
