from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.nets.training import Training


@pytest.mark.slow
def test_default_reaches_a_third_of_a_millimetre(case: rt.Case) -> None:
    """RMSE <= 0.3 mm per axis on held-out trajectories, for the default network and training."""
    twin = rt.generate(case.twin, case, per_class=400, seed=0)
    ibg = rt.fit_surrogate(twin, seed=0)
    assert ibg.fitted.figures["held_out"] == 360
    for axis in "xyz":
        assert ibg.fitted.figures[f"rmse_{axis}"] <= 3e-4


@pytest.mark.slow
@pytest.mark.parametrize("network", [rt.LSTM(16), rt.TCN(16, levels=3)], ids=repr)
def test_networks_with_memory_learn_too(
    network: rt.LSTM | rt.TCN, twin_set: rt.Trajectories
) -> None:
    short = Training(max_epochs=8, batch_size=8, learning_rate=1e-2)
    ibg = rt.fit_surrogate(twin_set, network, seed=0, training=short)
    for axis in "xyz":
        assert ibg.fitted.figures[f"nrmse_{axis}"] < 0.5, "far better than the mean"


def test_the_fast_path_is_the_plain_one(ibg: rt.Surrogate, twin_set: rt.Trajectories) -> None:
    commands = twin_set.commands[:20]
    with torch.no_grad():
        plain = ibg(torch.tensor(commands)).numpy()
    np.testing.assert_allclose(ibg.predict(commands), plain, atol=1e-6)


@pytest.mark.parametrize(
    "network", [rt.MLP((8,)), rt.LSTM(4), rt.TCN(4, levels=2), rt.StateSpace(2, 4)], ids=repr
)
def test_an_output_that_never_changes_is_exact_in_any_unit(network: rt.LSTM | rt.TCN) -> None:
    """With a scale of 1 for a constant output the network's error was 1e4 times a value of 1 µm."""

    def function(commands: np.ndarray) -> np.ndarray:
        ones = np.ones_like(commands)
        return np.concatenate([commands, 1e-6 * ones, 101325 * ones], axis=2)

    outputs = rt.Channels(("y", "gap", "pressure"), ("1", "m", "Pa"))
    twin = rt.FunctionTwin(function, rt.Channels(("u",), ("V",)), outputs, rate=10.0)
    commands = np.random.default_rng(0).uniform(-1, 1, size=(12, 20, 1))
    brief = Training(max_epochs=1)
    surrogate = rt.fit_surrogate(twin.simulate(commands, seed=0), network, seed=0, training=brief)
    found = surrogate.predict(commands)
    np.testing.assert_array_equal(found[..., 1], np.float32(1e-6))
    np.testing.assert_array_equal(found[..., 2], np.float32(101325))
    assert np.ptp(found[..., 0]) > 0, "outputs that change are learned as before"


@pytest.mark.slow
def test_same_seed_same_bytes(twin_set: rt.Trajectories, tmp_path: Path) -> None:
    brief = Training(max_epochs=1)
    for name in ("a", "b"):
        rt.fit_surrogate(twin_set, rt.MLP((8,)), seed=7, training=brief).save(tmp_path / name)
    for file in ("model.json", "weights.safetensors"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_saved_and_loaded_is_the_same(
    ibg: rt.Surrogate, twin_set: rt.Trajectories, tmp_path: Path
) -> None:
    ibg.save(tmp_path / "ibg")
    back = rt.Surrogate.load(tmp_path / "ibg")
    np.testing.assert_array_equal(
        back.predict(twin_set.commands[:3]), ibg.predict(twin_set.commands[:3])
    )
    assert back.fitted == ibg.fitted
    assert (back.inputs, back.outputs, back.rate) == (ibg.inputs, ibg.outputs, ibg.rate)


def test_bad_input_is_refused(twin_set: rt.Trajectories, tmp_path: Path) -> None:
    with pytest.raises(rt.InputError, match="at least 10 trajectories"):
        rt.fit_surrogate(twin_set[:5], seed=0)
    bare = twin_set.replace(commands=twin_set.commands[..., :0], inputs=None)
    with pytest.raises(rt.InputError, match="0 command channels"):
        rt.fit_surrogate(bare, seed=0)
    with pytest.raises(rt.InputError, match="expected a surrogate model"):
        rt.Surrogate.load(tmp_path / "nowhere")


@pytest.mark.parametrize("network", [rt.MLP((4,)), rt.LSTM(4)], ids=repr)
def test_outputs_after_an_early_end_are_not_learned(
    network: rt.MLP | rt.LSTM, twin_set: rt.Trajectories
) -> None:
    """They are the last known ones, while the commands go on."""
    few = twin_set[:30]
    mask, nominal = few.mask.copy(), few.nominal.copy()
    mask[::2, few.steps // 3 :] = False
    nominal[~mask] = 7.0
    weights = [
        rt.fit_surrogate(each, network, seed=0, training=Training(max_epochs=1)).state_dict()
        for each in (few.replace(mask=mask), few.replace(mask=mask, nominal=nominal))
    ]
    torch.testing.assert_close(weights[0], weights[1], rtol=0, atol=0)


@pytest.mark.parametrize("damage", ["truncate", "not json", "other kind", "newer"])
def test_damaged_models_are_refused(ibg: rt.Surrogate, tmp_path: Path, damage: str) -> None:
    ibg.save(tmp_path / "m")
    about, weights = tmp_path / "m" / "model.json", tmp_path / "m" / "weights.safetensors"
    if damage == "truncate":
        weights.write_bytes(weights.read_bytes()[:100])
    elif damage == "not json":
        about.write_text("{")
    elif damage == "other kind":
        about.write_text(about.read_text().replace('"surrogate"', '"residual"'))
    else:
        about.write_text(about.read_text().replace('"schema": 1', '"schema": 99'))
    with pytest.raises(rt.InputError, match="expected a surrogate model"):
        rt.Surrogate.load(tmp_path / "m")
