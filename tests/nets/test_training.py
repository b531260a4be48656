from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from retwin.catalog import CLASSIFIERS, NETWORKS, classes
from retwin.nets.networks import CNN, LSTM, MLP, TCN, LSTMClassifier, Network, Standardise
from retwin.nets.training import Training, isolated, train
from retwin.serialisation.configs import from_config, to_config

pytestmark = pytest.mark.numerical

KINDS = (*classes(NETWORKS), *classes(CLASSIFIERS, Network))


def line(n: int = 200, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    x = torch.randn(n, 2, generator=torch.Generator().manual_seed(seed))
    return x, x @ torch.tensor([[1.0], [-2.0]]) + 0.5


def squared(network: nn.Module, batch: tuple[torch.Tensor, ...]) -> torch.Tensor:
    return (network(batch[0]) - batch[1]).square().mean()


def test_a_line_is_learnt_and_the_best_weights_are_kept() -> None:
    network = nn.Linear(2, 1)
    fit = train(network, squared, line(), line(seed=1), Training(60, 32, 0.05), seed=0)
    assert squared(network, line(seed=2)) < 1e-4
    assert fit.history["validation"][fit.best_epoch - 1] == min(fit.history["validation"])
    assert fit.reason == "all 60 epochs done"


def test_early_stopping_says_so() -> None:
    network = nn.Linear(2, 1)
    noise = torch.randn(200, 1, generator=torch.Generator().manual_seed(5))
    fit = train(
        network,
        squared,
        (line()[0], noise),
        line(seed=1),
        Training(500, 32, 0.05, patience=3),
        seed=0,
    )
    assert fit.reason == "no better validation loss for 3 epochs"
    assert len(fit.history["train"]) == fit.best_epoch + 3


def test_same_seed_same_weights_and_nothing_global_is_touched() -> None:
    before = torch.random.get_rng_state()
    weights = []
    for _ in range(2):
        with isolated(3):
            network = nn.Sequential(nn.Linear(2, 8), nn.Dropout(0.5), nn.Linear(8, 1))
        train(network, squared, line(), None, Training(3, 32, 0.01), seed=4)
        weights.append(network[0].weight.detach().numpy().tobytes())
        torch.rand(5)
        torch.random.set_rng_state(before)
    assert weights[0] == weights[1]
    assert torch.equal(torch.random.get_rng_state(), before)


def test_a_loss_that_is_not_finite_ends_training() -> None:
    x, y = line()
    with pytest.raises(RuntimeError, match="the loss is nan in epoch 1"):
        train(nn.Linear(2, 1), squared, (x, y * torch.nan), None, Training(3), seed=0)


def test_modules_in_evaluation_mode_stay_in_it() -> None:
    """What is frozen by `eval` is so in every epoch, also after a validation."""
    modes = []

    class Watched(nn.Linear):
        def forward(self, values: torch.Tensor) -> torch.Tensor:
            modes.append((self.training, frozen.training))
            return super().forward(values)

    frozen, fresh = nn.Dropout(0.5).eval(), Watched(2, 1)
    network = nn.Sequential(frozen, fresh)
    train(network, squared, line(64), line(64), Training(2, 32), seed=0)
    assert modes == 2 * [(True, False), (True, False), (False, False)]


def test_an_interrupted_training_ends_at_once() -> None:
    def interrupt(share: float) -> None:
        raise KeyboardInterrupt

    network = nn.Linear(2, 1)
    before = torch.random.get_rng_state(), torch.get_num_threads()
    with pytest.raises(KeyboardInterrupt):
        train(network, squared, line(), None, Training(3), seed=0, progress=interrupt)
    assert torch.equal(torch.random.get_rng_state(), before[0])
    assert torch.get_num_threads() == before[1]


@pytest.mark.parametrize("config", [MLP((8,)), LSTM(8), TCN(8, levels=3)], ids=repr)
def test_sequence_networks_are_causal(config: MLP | LSTM | TCN) -> None:
    with isolated(0):
        network = config.build(2, 3).eval()
    values = torch.randn(4, 50, 2, generator=torch.Generator().manual_seed(0))
    changed = values.clone()
    changed[:, 30:] += 1
    first, second = network(values), network(changed)
    assert first.shape == (4, 50, 3)
    torch.testing.assert_close(first[:, :30], second[:, :30])
    assert (first[:, 30:] != second[:, 30:]).any()


@pytest.mark.parametrize("config", [CNN((8, 8)), LSTMClassifier(8)], ids=repr)
@pytest.mark.parametrize("steps", [7, 100])
def test_classifiers_take_any_length(config: CNN | LSTMClassifier, steps: int) -> None:
    network = config.build(6, 9).eval()
    assert network(torch.zeros(3, steps, 6)).shape == (3, 9)


@pytest.mark.parametrize("config", [MLP((8,)), LSTM(), TCN(), CNN(), LSTMClassifier()], ids=repr)
def test_configs_survive_json(config: object) -> None:
    import json

    assert from_config(json.loads(json.dumps(to_config(config, KINDS))), KINDS) == config


def test_standardise_and_back() -> None:
    values = torch.tensor(np.random.default_rng(0).normal(5, [1, 100, 0], (50, 4, 3))).float()
    layer = Standardise(3).fit(values)
    standard = layer(values)
    torch.testing.assert_close(standard.mean((0, 1)), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(
        standard.std((0, 1), correction=0), torch.tensor([1.0, 1, 0]), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(layer.inverse(standard), values)


def test_unknown_settings_are_refused() -> None:
    from retwin import InputError

    with pytest.raises(InputError, match=r"decay: expected one of cosine, step, got 'linear'"):
        Training(decay="linear")
    with pytest.raises(InputError, match=r"max_epochs: expected .* at least 1, got 0"):
        Training(max_epochs=0)
    with pytest.raises(InputError, match=r"learning_rate: .*, got nan"):
        Training(learning_rate=float("nan"))


def test_a_network_that_could_not_be_loaded_is_not_saved() -> None:
    from retwin import InputError

    class Mine(nn.Module):
        pass

    with pytest.raises(InputError, match=r"expected one of MLP, .* got Mine"):
        to_config(Mine(), KINDS)


@pytest.mark.parametrize("epochs", [1, 2, 5, 10])
def test_any_number_of_steps_can_be_trained(epochs: int) -> None:
    """Ten steps in all are one of warming up: none that torch's schedule could divide by."""
    how = Training(max_epochs=epochs, batch_size=8, learning_rate=0.1)
    fit = train(nn.Linear(2, 1), squared, line(8), line(8), how, seed=0)
    assert len(fit.history["train"]) == epochs


def test_threads_are_those_of_before() -> None:
    before = torch.get_num_threads()
    with isolated(0):
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before
