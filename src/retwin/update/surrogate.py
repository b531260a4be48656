"""The surrogate, Ideal Behavior Generator (IBG), Eq. 5: a fast neural twin, G_φ(u) ≈ ŷ."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.arrays import row_blocks
from retwin.catalog import NETWORKS, classes
from retwin.checks import instance, one_per, require
from retwin.data.trajectories import Channels, Trajectories
from retwin.nets.networks import MLP, Network, Standardise, last_layers
from retwin.nets.training import Fit, Training, isolated, train
from retwin.progress import Progress
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, refusing, save_model
from retwin.times import sample_rate
from retwin.twins.commands.range import CommandRange
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Chunk, checked_commands, simulate_in_chunks
from retwin.update.kernels.generation import along_pieces
from retwin.update.piecewise_linear import evaluate_piecewise_linear
from retwin.update.training_range import training_checked

TRAJECTORIES_PER_BATCH = 8
"""Trajectories per evaluation of a network with memory: more do not fit the cache."""
SAMPLES_PER_BLOCK = 2**17
"""Samples, in whole trajectories, that are searched for linear pieces together."""
MIN_TRAJECTORIES = 10
"""Smallest number of trajectories to fit on: a tenth each is held out for validation and test."""
MAX_SAMPLES = 200_000
"""Largest number of distinct samples that a network without memory is trained on; more do not lower
the error."""
MAX_SEQUENCE_SAMPLES = 10_000_000
"""Largest number of samples, in whole trajectories, that a network with memory is trained on."""
TRAINING = {
    "MLP": Training(max_epochs=20, batch_size=256, learning_rate=5e-3),
    "LSTM": Training(max_epochs=10, batch_size=32, learning_rate=5e-3),
    "TCN": Training(max_epochs=10, batch_size=32, learning_rate=5e-3),
    "StateSpace": Training(max_epochs=40, batch_size=16, learning_rate=1e-2),
}
"""Default settings of the training by kind of network."""


class Surrogate(nn.Module):
    """A neural twin: a differentiable function of commands, and a `Twin`.

    Parameters
    ----------
    network : Network
        Config object of the network.
    inputs, outputs : Channels
        Channels of the commands and of the outputs.
    rate : float
        Sample rate of the data that it is trained on, in Hz.

    Attributes
    ----------
    memoryless : bool
        Whether an output depends on the command at the same sample only.
    fitted : Fit or None
        Record of the training; None before it.
    trained : CommandRange or None
        What the training commands contained; None before the training. Commands that they did not
        contain are an `OutsideTrainingWarning`.

    """

    def __init__(
        self, network: Network, *, inputs: Channels, outputs: Channels, rate: float
    ) -> None:
        super().__init__()
        self.config = network
        self.inputs = inputs
        self.outputs = outputs
        self.rate = rate
        self.before = Standardise(len(inputs))
        self.after = Standardise(len(outputs))
        self.network = network.build(len(inputs), len(outputs))
        self.memoryless = isinstance(network, MLP)
        self.fitted: Fit | None = None
        self.trained: CommandRange | None = None

    @property
    def held_out_variance(self) -> Tensor:
        """(d_y,) mean square of the error on held-out simulations of the twin."""
        figures = {} if self.fitted is None else self.fitted.figures
        errors = [figures.get(f"rmse_{name}", 0.0) for name in self.outputs.names]
        return torch.tensor(errors, dtype=torch.float64).square()

    @property
    def unit(self) -> Tensor:
        """(d_y,) the divisors that make outputs comparable: their standard deviations.

        Where all outputs have the same physical unit it is the mean of these.
        """
        spread = self.after.scale
        return spread.mean().expand_as(spread) if self.outputs.comparable else spread

    def forward(self, commands: Tensor) -> Tensor:
        """The outputs (n, T, d_y) for commands (n, T, d_u), both in physical units."""
        return self.after.inverse(self.network(self.before(commands)))

    def predict(self, commands: NDArray) -> NDArray:
        """The outputs (n, T, d_y), float32, for commands (n, T, d_u), without gradient.

        A network without memory is evaluated once for a constant command, and at a few points of a
        ramp (`evaluate_piecewise_linear`), which agrees with `forward` up to rounding.
        """
        with training_checked(self, commands):
            return self._predict(commands)

    @torch.no_grad()
    def _predict(self, commands: NDArray) -> NDArray:
        """As `predict`, without a check of the commands."""
        values = np.ascontiguousarray(commands, dtype=np.float32)
        out = np.empty((*values.shape[:2], len(self.outputs)), dtype=np.float32)
        evaluate: Callable[[Tensor], Tensor] = self
        size = TRAJECTORIES_PER_BATCH
        if self.memoryless:
            evaluate, size = self._piecewise_linear, 1 + SAMPLES_PER_BLOCK // (1 + values.shape[1])
        for begin in range(0, len(values), size):
            part = slice(begin, begin + size)
            out[part] = evaluate(torch.tensor(values[part])).numpy()
        return out

    def _piecewise_linear(self, commands: Tensor) -> Tensor:
        """As `forward`, up to rounding, by interpolation along linear pieces of the commands."""
        compiled = along_pieces(self, commands.numpy())
        if compiled is not None:
            return torch.from_numpy(compiled)

        def function(rows: Tensor) -> Tensor:
            # Samples per evaluation of a network without memory: more do not fit the cache.
            return torch.cat([self(some) for some in rows.split(2048)])

        return evaluate_piecewise_linear(function, commands, self.after.scale)

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`; a frozen response is the output of constant commands."""

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            nominal = self._predict(chunk.commands)
            return nominal, self._predict(chunk.held_commands) if any(chunk.faults) else nominal

        checked = checked_commands(commands, self.inputs).astype(np.float32, copy=False)
        with training_checked(self, checked):
            return simulate_in_chunks(
                self, run, checked, faults, seed=seed, progress=progress, threaded=True
            )

    def save(self, folder: str | Path) -> None:
        """Write the weights and the description; see `read_model` for the layout."""
        about = {
            "network": to_config(self.config, classes(NETWORKS)),
            "inputs": vars(self.inputs),
            "outputs": vars(self.outputs),
            "rate": self.rate,
            "fitted": None if self.fitted is None else asdict(self.fitted),
            "trained": None if self.trained is None else asdict(self.trained),
        }
        save_model(folder, "surrogate", about, self.state_dict())

    @classmethod
    def load(cls, folder: str | Path) -> Surrogate:
        """Read what `save` wrote.

        Raises InputError if the folder holds no surrogate or is damaged.
        """
        about, weights = read_model(folder, "surrogate")
        with refusing(folder, expected="a surrogate model"):
            sample_rate("rate", about["rate"])
            network = from_config(about["network"], classes(NETWORKS))
            channels = {name: Channels.of(about[name]) for name in ("inputs", "outputs")}
            surrogate = cls(network, **channels, rate=about["rate"])
            surrogate.load_state_dict(weights)
            surrogate.fitted = Fit.of(about["fitted"])
            if about["trained"] is not None:
                surrogate.trained = CommandRange.from_json(about["trained"])
                one_per("trained", surrogate.trained.low, len(surrogate.inputs), "command")
        return surrogate.eval()


def surrogate_training(network: Network) -> Training:
    """Default settings of the training of a surrogate with this network."""
    return TRAINING.get(type(network).__name__, Training())


def fit_surrogate(
    twin: Trajectories,
    network: Network = MLP(),  # noqa: B008 - a frozen config
    *,
    seed: int,
    training: Training | None = None,
    progress: Progress | None = None,
) -> Surrogate:
    """Train a surrogate on the nominal outputs of a twin (Eq. 5).

    Parameters
    ----------
    twin : Trajectories
        Commands and nominal outputs of at least ten trajectories; `observed` is not used. What
        follows the last measurement of a trajectory is left out: a simulation that ended early
        has no outputs there. A tenth of them is held out for validation and another tenth for the
        reported error, at most a thousand each. A network without memory is trained on at most
        200,000 distinct samples, drawn at random, one with memory on at most ten million.
    network : Network
        `MLP` (no memory, the default), `LSTM`, `TCN` or `StateSpace`.
    seed : int
        The same seed gives the same weights on the same machine.
    training : Training, optional
        Settings of the training; by default `surrogate_training(network)`.
    progress : callable, optional
        Called with the share of the epochs that are done.

    Returns
    -------
    Surrogate
        Its `fitted.figures` hold, for each output, `rmse_NAME` in its unit and `nrmse_NAME`, which
        is divided by the output's standard deviation, on held-out trajectories.

    Raises
    ------
    InputError
        Fewer than ten trajectories, or trajectories without commands.

    """
    instance("twin", twin, Trajectories, remedy="simulate the twin, and give what it returns")
    channels = twin.commands.shape[2]
    enough = len(twin) >= MIN_TRAJECTORIES and channels
    expected = f"at least {MIN_TRAJECTORIES} trajectories with commands"
    got = f"{len(twin)} trajectories with {channels} command channels"
    remedy = "load the file with its case, which recovers commands, or simulate more"
    require(enough, "twin", expected=expected, got=got, remedy=remedy)
    order = np.random.default_rng(seed).permutation(len(twin))
    # Largest number of trajectories that are held out for validation, and for test: the relative
    # standard error of an RMSE from a thousand is about 2 %.
    tenth = min(max(1, len(twin) // 10), 1000)
    test, valid, fitted = order[:tenth], order[tenth : 2 * tenth], order[2 * tenth :]
    with isolated(seed):
        surrogate = Surrogate(network, inputs=twin.inputs, outputs=twin.outputs, rate=twin.rate)
    examples = _samples if surrogate.memoryless else _sequences
    training_set = examples(twin, fitted, seed)
    commands, nominal, valid_samples = training_set
    surrogate.before.fit(commands[valid_samples])
    surrogate.after.fit(nominal[valid_samples])

    def loss(module: Any, batch: tuple[Tensor, ...]) -> Tensor:
        commands, nominal, valid_samples = batch
        error = module.network(module.before(commands)) - module.after(nominal)
        squares = error.square().mean(dim=-1)
        return (squares * valid_samples).sum() / valid_samples.sum()

    how, held_out = training or surrogate_training(network), examples(twin, valid, seed + 1)
    result = train(surrogate, loss, training_set, held_out, how, seed=seed, progress=progress)
    _hold_constant(surrogate, nominal[valid_samples])
    surrogate.trained = CommandRange.of(twin.commands, twin.rate)
    surrogate.fitted = replace(result, figures=_errors(surrogate, twin, test))
    return surrogate


@torch.no_grad()
def _hold_constant(surrogate: Surrogate, nominal: Tensor) -> None:
    """Make outputs that never change in training exactly constant.

    Their scale is 1 in any unit, so that a small error of the network in standard units
    can be a thousand times their value.
    """
    constant = nominal.amax(dim=0) == nominal.amin(dim=0)
    for layer in last_layers(surrogate.network):
        for weights in layer.parameters():
            weights[constant] = 0.0
    surrogate.after.mean[constant] = nominal[0, constant]


def _errors(surrogate: Surrogate, twin: Trajectories, test: NDArray) -> dict[str, float]:
    """RMSE and normalised RMSE of each output on the trajectories `test`."""
    valid = known_samples(twin, test)
    error = (surrogate._predict(twin.commands[test]) - twin.nominal[test])[valid]
    rmse = np.sqrt(np.square(error, dtype=np.float64).mean(axis=0))
    deviation = twin.nominal[test][valid].std(axis=0, dtype=np.float64)
    nrmse = np.divide(rmse, deviation, out=np.zeros_like(rmse), where=deviation > 0)
    figures = {"held_out": float(len(test))}
    for name, absolute, normalised in zip(twin.outputs.names, rmse, nrmse, strict=True):
        figures[f"rmse_{name}"] = float(absolute)
        figures[f"nrmse_{name}"] = float(normalised)
    return figures


def known_samples(twin: Trajectories, part: NDArray) -> NDArray:
    """(len(part), T) bool, the samples up to the last measurement; all where none was measured."""
    measured = twin.mask[part].any(axis=2)
    later = np.logical_or.accumulate(measured[:, ::-1], axis=1)[:, ::-1]
    return later | ~measured.any(axis=1, keepdims=True)


def _samples(twin: Trajectories, part: NDArray, seed: int) -> tuple[Tensor, ...]:
    """Distinct commands of the trajectories `part` and their outputs, at most MAX_SAMPLES."""
    count = sum(len(changes) for _, changes in _changes(twin, part))
    chosen = np.arange(count)
    if count > MAX_SAMPLES:
        rng = np.random.default_rng(seed)
        chosen = rng.choice(count, MAX_SAMPLES, replace=False, shuffle=False)
    sources = (twin.commands, twin.nominal)
    copies = [np.empty((len(chosen), source.shape[2]), np.float32) for source in sources]
    before = 0
    for some, changes in _changes(twin, part):
        here = np.flatnonzero((chosen >= before) & (chosen < before + len(changes)))
        rows = changes[chosen[here] - before]
        for values, source in zip(copies, sources, strict=True):
            values[here] = source[some].reshape(-1, source.shape[2])[rows]
        before += len(changes)
    commands, nominal = map(torch.from_numpy, copies)
    return commands, nominal, torch.ones(len(chosen), dtype=torch.bool)


def _changes(twin: Trajectories, part: NDArray) -> Iterator[tuple[NDArray, NDArray]]:
    """Per block of trajectories, their indices and the known samples with another command.

    Samples are indexed over all trajectories of the block, in series.
    """
    last = np.full(twin.commands.shape[2], np.nan)
    for rows in row_blocks(twin.commands, len(part)):
        some = part[rows]
        commands = twin.commands[some].reshape(-1, twin.commands.shape[2])
        before = np.concatenate([last[None].astype(commands.dtype), commands[:-1]])
        changed = (commands != before).any(axis=1)
        yield some, np.flatnonzero(changed & known_samples(twin, some).reshape(-1))
        last = commands[-1]


def _sequences(twin: Trajectories, part: NDArray, seed: int) -> tuple[Tensor, ...]:
    """Whole trajectories, at most MAX_SEQUENCE_SAMPLES, and which samples are known."""
    part = part[: max(1, MAX_SEQUENCE_SAMPLES // twin.steps)]
    return (
        torch.tensor(twin.commands[part], dtype=torch.float32),
        torch.tensor(twin.nominal[part], dtype=torch.float32),
        torch.as_tensor(known_samples(twin, part)),
    )
