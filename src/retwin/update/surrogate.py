"""Ideal Behavior Generator (IBG), Eq. 5: a fast neural twin, G_φ(u) ≈ ŷ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.arrays import row_blocks
from retwin.data.trajectories import Channels, Trajectories
from retwin.errors import InputError
from retwin.nets.networks import MLP, NETWORKS, Network, Standardise
from retwin.nets.training import Fit, Training, isolated, train
from retwin.progress import Progress
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model
from retwin.twins.faults import Fault
from retwin.twins.twin import Chunk, checked_commands, simulate_in_chunks
from retwin.update.piecewise_linear import evaluate_piecewise_linear

__all__ = ["Surrogate", "fit_surrogate", "surrogate_training"]

CHUNK = 8
"""Trajectories that a network with memory is asked at a time: more leave the cache."""
SPAN = 2**17
"""Samples, in whole trajectories, that are gone through for lines together."""
ROWS = 2048
"""Samples that a network without memory is asked at a time, for the same reason."""


class Surrogate(nn.Module):
    """A trained neural twin: call it on a tensor, or `simulate` as any `Twin`.

    Parameters
    ----------
    network: the config its module was built from.
    inputs, outputs: channels of commands and outputs.
    rate: samples per second it was trained at.

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
        self.fitted: Fit | None = None

    @property
    def memoryless(self) -> bool:
        """Whether an output depends on the command of its own sample only."""
        return isinstance(self.config, MLP)

    @property
    def unit(self) -> Tensor:
        """(d_y,) what outputs are divided by to be compared with each other: their spread.

        One for all where they have the same unit.
        """
        spread = self.after.scale
        return spread.mean().expand_as(spread) if self.outputs.comparable else spread

    def forward(self, commands: Tensor) -> Tensor:
        """Outputs (n, T, d_y) for commands (n, T, d_u), both in physical units."""
        return self.after.inverse(self.network(self.before(commands)))

    @torch.no_grad()
    def predict(self, commands: NDArray, *, progress: Progress | None = None) -> NDArray:
        """Outputs (n, T, d_y), float32, for commands (n, T, d_u), without gradient.

        In chunks that fit the cache; a network without memory is asked once for a held command, and
        at few points of a ramp.
        """
        values = np.ascontiguousarray(commands, dtype=np.float32)
        out = np.empty((*values.shape[:2], len(self.outputs)), dtype=np.float32)
        few = 1 + SPAN // (1 + values.shape[1])
        ask, size = (self._by_lines, few) if self.memoryless else (self, CHUNK)
        for begin in range(0, len(values), size):
            part = slice(begin, begin + size)
            out[part] = ask(torch.tensor(values[part])).numpy()
            if progress is not None:
                progress(min(1.0, (begin + size) / len(values)))
        return out

    def _by_lines(self, commands: Tensor) -> Tensor:
        """As `forward`, up to rounding; asked once for a hold and at few points of a ramp."""

        def ask(rows: Tensor) -> Tensor:
            return torch.cat([self(some) for some in rows.split(ROWS)])

        return evaluate_piecewise_linear(ask, commands, self.after.scale)

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """What the surrogate says, see `Twin.simulate`; frozen responses are held commands."""

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            nominal = self.predict(chunk.commands)
            return nominal, self.predict(chunk.held_commands) if any(chunk.faults) else nominal

        checked = checked_commands(commands, self.inputs).astype(np.float32, copy=False)
        return simulate_in_chunks(self, run, checked, faults, seed=seed, progress=progress)

    def save(self, folder: str | Path) -> None:
        """Write weights and description; see `read_model` for the layout."""
        about = {
            "network": to_config(self.config, NETWORKS),
            "inputs": vars(self.inputs),
            "outputs": vars(self.outputs),
            "rate": self.rate,
            "fitted": None if self.fitted is None else asdict(self.fitted),
        }
        with write_model(folder, "surrogate", about, self.state_dict()):
            pass

    @classmethod
    def load(cls, folder: str | Path) -> Surrogate:
        """Read what `save` wrote; InputError when it is not a surrogate or damaged."""
        about, weights = read_model(folder, "surrogate")
        surrogate = cls(
            from_config(about["network"], NETWORKS),
            inputs=Channels.of(about["inputs"]),
            outputs=Channels.of(about["outputs"]),
            rate=about["rate"],
        )
        surrogate.load_state_dict(weights)
        surrogate.fitted = Fit.of(about["fitted"])
        return surrogate.eval()


ENOUGH = 10
"""Fewest trajectories to fit on: a tenth each is held out for validation and for the error."""

HELD_OUT = 1000
"""Trajectories that tell an error well enough, however many there are."""

SAMPLES = 200_000
"""Distinct samples that are enough for a network without memory."""

WINDOWED = 10_000_000
"""Samples, in whole trajectories, that are enough for a network with memory."""

DEFAULTS = {
    "MLP": Training(max_epochs=20, batch_size=256, learning_rate=5e-3),
    "LSTM": Training(max_epochs=10, batch_size=32, learning_rate=5e-3),
    "TCN": Training(max_epochs=10, batch_size=32, learning_rate=5e-3),
    "StateSpace": Training(max_epochs=40, batch_size=16, learning_rate=1e-2),
}


def surrogate_training(network: Network) -> Training:
    """What suits the network."""
    return DEFAULTS.get(type(network).__name__, Training())


def fit_surrogate(
    twin: Trajectories,
    network: Network = MLP(),  # noqa: B008 - a frozen config
    *,
    seed: int,
    training: Training | None = None,
    progress: Progress | None = None,
) -> Surrogate:
    """Train an IBG on what a twin says its nominal output is (Eq. 5).

    Parameters
    ----------
    twin: commands and nominal outputs; faults in `observed` do not matter. A tenth of the
        trajectories is held out for validation and another tenth for the reported error, a
        thousand each at most. Of a set larger than that needs, a random part is learned from.
    network: `MLP` (no memory, the default), `LSTM`, `TCN` or `StateSpace`.
    seed: same seed, same weights on the same machine.
    training: epochs, batch, rate; by default what suits the network.

    The result's `fitted.figures` hold, for every output, `rmse_NAME` in its unit and `nrmse_NAME`
    (over its standard deviation) on held-out trajectories.

    Raises
    ------
    InputError: fewer than ten trajectories, or a set without commands.

    """
    if len(twin) < ENOUGH or twin.commands.shape[2] == 0:
        raise InputError(
            "twin",
            expected=f"at least {ENOUGH} trajectories with commands",
            got=f"{len(twin)} trajectories with {twin.commands.shape[2]} command channels",
            remedy="load the file with its case, which recovers commands, or simulate more",
        )
    order = np.random.default_rng(seed).permutation(len(twin))
    tenth = min(max(1, len(twin) // 10), HELD_OUT)
    test, valid, train_part = order[:tenth], order[tenth : 2 * tenth], order[2 * tenth :]
    with isolated(seed):
        surrogate = Surrogate(network, inputs=twin.inputs, outputs=twin.outputs, rate=twin.rate)
    rows = _samples if isinstance(network, MLP) else _windows
    fitted = rows(twin, train_part, seed)
    commands, nominal, there = fitted
    surrogate.before.fit(commands[there])
    surrogate.after.fit(nominal[there])

    def loss(module: Any, batch: tuple[Tensor, ...]) -> Tensor:
        commands, nominal, there = batch
        error = module.network(module.before(commands)) - module.after(nominal)
        return error[there].square().mean()

    result = train(
        surrogate,
        loss,
        fitted,
        rows(twin, valid, seed + 1),
        training or surrogate_training(network),
        seed=seed,
        progress=progress,
    )
    whole = _there(twin, test)
    error = (surrogate.predict(twin.commands[test]) - twin.nominal[test])[whole]
    rmse = np.sqrt(np.square(error, dtype=np.float64).mean(axis=0))
    spread = twin.nominal[test][whole].std(axis=0, dtype=np.float64)
    figures = {"held_out": float(tenth)}
    for name, error_of, spread_of in zip(twin.outputs.names, rmse, spread, strict=True):
        figures[f"rmse_{name}"] = float(error_of)
        figures[f"nrmse_{name}"] = float(error_of / spread_of) if spread_of > 0 else 0.0
    surrogate.fitted = replace(result, figures=figures)
    return surrogate


def _there(twin: Trajectories, part: NDArray) -> NDArray:
    """(len(part), T) bool, what is no padding: there a nominal output is held, not the twin's."""
    return np.arange(twin.steps) < twin.lengths[part][:, None]


def _samples(twin: Trajectories, part: NDArray, seed: int) -> tuple[Tensor, ...]:
    """Distinct samples of those trajectories, at most SAMPLES: a hold says the same all over."""
    count = sum(len(fresh) for _, fresh in _fresh(twin, part))
    chosen = np.arange(count)
    if count > SAMPLES:
        rng = np.random.default_rng(seed)
        chosen = rng.choice(count, SAMPLES, replace=False, shuffle=False)
    kinds = (twin.commands, twin.nominal)
    found = [np.empty((len(chosen), kind.shape[2]), np.float32) for kind in kinds]
    seen = 0
    for some, fresh in _fresh(twin, part):
        here = np.flatnonzero((chosen >= seen) & (chosen < seen + len(fresh)))
        for values, kind in zip(found, kinds, strict=True):
            values[here] = kind[some].reshape(-1, kind.shape[2])[fresh[chosen[here] - seen]]
        seen += len(fresh)
    commands, nominal = map(torch.from_numpy, found)
    return commands, nominal, torch.ones(len(chosen), dtype=torch.bool)


def _fresh(twin: Trajectories, part: NDArray) -> Iterator[tuple[NDArray, NDArray]]:
    """Block by block, which trajectories, and at which of their samples the command is a new one.

    The samples of a block are counted through; the first of a trajectory is new if it is not the
    last of the one before.
    """
    last = np.full(twin.commands.shape[2], np.nan)
    for rows in row_blocks(twin.commands, len(part)):
        some = part[rows]
        commands = twin.commands[some].reshape(-1, twin.commands.shape[2])
        before = np.concatenate([last[None].astype(commands.dtype), commands[:-1]])
        yield some, np.flatnonzero((commands != before).any(axis=1))
        last = commands[-1]


def _windows(twin: Trajectories, part: NDArray, seed: int) -> tuple[Tensor, ...]:
    """Whole trajectories, WINDOWED samples at most, and what of them is no padding."""
    part = part[: max(1, WINDOWED // twin.steps)]
    return (
        torch.tensor(twin.commands[part], dtype=torch.float32),
        torch.tensor(twin.nominal[part], dtype=torch.float32),
        torch.as_tensor(_there(twin, part)),
    )
