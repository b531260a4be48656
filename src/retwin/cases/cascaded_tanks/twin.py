"""Two cascaded tanks: a pump fills the upper one, which drains into the lower one; one is measured.

Torricelli's law, after Schoukens and Noël, "Three benchmarks addressing open challenges in
nonlinear system identification" (2017), with levels in volts of the lower tank's sensor:

    upper level: x' = pump u - upper x^p
    lower level: y' = upper x^p - lower y^q

with p = q = 1/2. A real outlet may be between that and laminar flow, where the power is 1, and a
level need not be counted from the outlet. The upper tank's level is hidden. Its unit is such that
it loses what the lower one gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import RK45

from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.limits import Limits
from retwin.twins.parametric import Parameter, ParametricTwin, values_per_simulation
from retwin.twins.twin import Chunk, simulate_in_chunks

__all__ = ["TanksTwin", "tanks_parametric"]

INPUTS = Channels(("pump",), ("V",))
OUTPUTS = Channels(("level",), ("V",))
RATE = 0.25
"""Samples per second: one every 4 s."""
FULL = 10.0
"""The lower tank's level, in V, at which it overflows."""
WEIR = 0.5
"""What runs over the edge, per V above it and s: so fast that levels stay close to the edge."""
PHYSICS = (
    *("pump", "upper", "lower", "start_upper", "start_lower"),
    *("edge", "spill", "upper_power", "lower_power"),
)


@dataclass(frozen=True)
class TanksTwin:
    """The tanks in simulation, at one sample every 4 s; the pump's voltage is held in between.

    Parameters
    ----------
    pump: what a volt on the pump adds to the upper level, in V/(V s).
    upper, lower: outflow of each tank at a level of 1 V, in V/s.
    start_upper, start_lower: levels at the first sample, in V.
    overflow: whether tanks run over; without, levels know no edge.
    edge: of the upper tank, in V; the lower one's is at 10 V, where its reading ends.
    spill: share of what runs over the upper edge that falls into the lower tank.
    upper_power, lower_power: p and q, of the level in the outflow of each tank.

    `simulate` takes the numbers as `parameters`, by name, one for all trajectories or one each.
    The defaults are the least-squares fit to the benchmark's estimation record, see
    `benchmarks/tanks.py`. The upper level is told badly by the lower one, and so is its start.

    """

    pump: float = 0.074680
    upper: float = 0.053939
    lower: float = 0.089720
    start_upper: float = 14.0431
    start_lower: float = 5.1309
    overflow: bool = False
    edge: float = 10.0
    spill: float = 0.5
    upper_power: float = 0.5
    lower_power: float = 0.5

    @property
    def inputs(self) -> Channels:
        """The pump's voltage."""
        return INPUTS

    @property
    def outputs(self) -> Channels:
        """The lower tank's level."""
        return OUTPUTS

    @property
    def rate(self) -> float:
        """Samples per second."""
        return RATE

    @property
    def limits(self) -> Limits:
        """A pump does not suck."""
        return Limits((0.0,), (10.0,))

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> Trajectories:
        """See `TakesParameters.simulate`; a stuck pump holds its voltage."""
        count = len(commands)
        own = values_per_simulation(parameters, PHYSICS, count)
        numbers = {name: own.get(name, np.full(count, getattr(self, name))) for name in PHYSICS}

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            some = {name: values[chunk.index] for name, values in numbers.items()}
            nominal = self._levels(chunk.commands, some)
            return nominal, self._levels(chunk.held_commands, some) if any(
                chunk.faults
            ) else nominal

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, size=512
        )

    def _levels(self, commands: NDArray, numbers: Mapping[str, NDArray]) -> NDArray:
        """The lower level (n, T, 1); the upper one is not told."""
        voltage = commands[..., 0].T.astype(np.float64)
        levels = np.concatenate([numbers["start_upper"], numbers["start_lower"]])
        told = np.empty(voltage.shape)
        for sample, held in enumerate(voltage):
            told[sample] = levels[len(held) :]
            levels = self._after(levels, held, numbers)
        if self.overflow:
            np.minimum(told, FULL, out=told)
        return told.T[..., None].astype(commands.dtype)

    def _after(self, levels: NDArray, voltage: NDArray, numbers: Mapping[str, NDArray]) -> NDArray:
        """Both levels (2 n,) one sample later: one step of Dormand and Prince's method.

        The step is never refused, whatever its error: trajectories are integrated together, and
        one must not depend on those beside it. A sample is short against the tanks' time.
        """
        solver = RK45(
            lambda _, now: self._rates(now, voltage, numbers),
            0.0,
            levels,
            1 / RATE,
            first_step=1 / RATE,
            atol=np.inf,
        )
        solver.step()
        return np.maximum(solver.y, 0.0)

    def _rates(self, levels: NDArray, voltage: NDArray, numbers: Mapping[str, NDArray]) -> NDArray:
        x, y = np.split(np.maximum(levels, 0.0), 2)
        between = numbers["upper"] * x ** numbers["upper_power"]
        upper = numbers["pump"] * voltage - between
        lower = between - numbers["lower"] * y ** numbers["lower_power"]
        if self.overflow:
            over = WEIR * np.maximum(x - numbers["edge"], 0.0)
            upper -= over
            lower += numbers["spill"] * over - WEIR * np.maximum(y - FULL, 0.0)
        return np.concatenate([upper, lower])


def tanks_parametric(overflow: bool = False) -> ParametricTwin:
    """The tanks with their numbers as free parameters, for identification (Eq. 2, 3).

    Five of them, of the simple physics. With `overflow` all that is known: also the upper tank's
    edge, the share that spills into the lower tank, and the powers of the outflows. The start
    levels are the system's own, the same in every record.
    """
    bounds = {
        "pump": ("V/(V s)", 0.005, 0.3),
        "upper": ("V/s", 0.005, 0.3),
        "lower": ("V/s", 0.005, 0.3),
        "start_upper": ("V", 0.1, 30.0 if overflow else 15.0),
        "start_lower": ("V", 0.1, 10.0),
    }
    if overflow:
        bounds |= {
            "edge": ("V", 2.0, 40.0),
            "spill": ("1", 0.0, 1.0),
            "upper_power": ("1", 0.25, 1.0),
            "lower_power": ("1", 0.25, 1.0),
        }
    twin = TanksTwin(overflow=overflow)
    free = (Parameter(name, *bound, getattr(twin, name)) for name, bound in bounds.items())
    return ParametricTwin(twin, tuple(free))
