"""`TanksTwin`: a pump fills the upper of two tanks, which drains into the lower, measured one.

Torricelli's law, with levels in volts of the lower tank's sensor:

    upper level: x' = pump u - upper x^p
    lower level: y' = upper x^p - lower y^q

with p = q = 1/2. A real outlet may be between that and laminar flow, where the exponent is 1, and a
level need not be counted from the outlet. The level of the upper tank is hidden; in its unit the
upper tank loses as much as the lower one gains.

References
----------
M. Schoukens and J. P. Noël, "Three benchmarks addressing open challenges in nonlinear system
identification", IFAC-PapersOnLine 50 (2017).

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.limits import Limits
from retwin.twins.parameter_values import values_per_simulation
from retwin.twins.parametric import Parameter, ParametricTwin
from retwin.twins.twin import Chunk, simulate_in_chunks

__all__ = ["TanksTwin", "tanks_parametric"]

INPUTS = Channels(("pump",), ("V",))
OUTPUTS = Channels(("level",), ("V",))
RATE = 0.25
"""Sample rate in Hz: one sample every 4 s, as in the benchmark."""
FULL = 10.0
"""Level of the lower tank in V at which it overflows, where its sensor saturates."""
WEIR = 0.5
"""Overflow in V/s per V above the edge, so high that levels stay close to the edge."""
PHYSICS = (
    *("pump", "upper", "lower", "start_upper", "start_lower"),
    *("edge", "spill", "upper_power", "lower_power"),
)
"""Names of the parameters."""
TRAJECTORIES_PER_CHUNK = 512
"""Number of trajectories that are integrated together."""


@dataclass(frozen=True)
class TanksTwin:
    """The tanks, at one sample every 4 s; the pump's voltage is held in between.

    `simulate` takes the numbers as `parameters`. The defaults are the least-squares fit to the
    benchmark's estimation record, see `benchmarks/tanks.py`. The lower level determines the upper
    level and its start only weakly.

    Parameters
    ----------
    pump : float
        Inflow of the upper tank in V/s per volt on the pump.
    upper, lower : float
        Outflow of each tank in V/s at a level of 1 V.
    start_upper, start_lower : float
        Levels at the first sample in V.
    overflow : bool, default False
        Whether the tanks overflow.
    edge : float
        Level in V at which the upper tank overflows; the lower one overflows at 10 V.
    spill : float
        Fraction of the upper tank's overflow that falls into the lower tank, from 0 to 1.
    upper_power, lower_power : float
        Exponents p and q of the levels in the outflow of each tank.

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
        """Sample rate in Hz."""
        return RATE

    @property
    def limits(self) -> Limits:
        """Range of the pump's voltage in V."""
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
        own = values_per_simulation(parameters, count, allowed=PHYSICS)
        numbers = {name: own.get(name, np.full(count, getattr(self, name))) for name in PHYSICS}

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            some = {name: values[chunk.index] for name, values in numbers.items()}
            nominal = self._levels(chunk.commands, some)
            if not any(chunk.faults):
                return nominal, nominal
            return nominal, self._levels(chunk.held_commands, some)

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, size=TRAJECTORIES_PER_CHUNK
        )

    def _levels(self, commands: NDArray, numbers: Mapping[str, NDArray]) -> NDArray:
        """The lower level (n, T, 1)."""
        voltage = commands[..., 0].T.astype(np.float64)
        levels = np.concatenate([numbers["start_upper"], numbers["start_lower"]])
        measured = np.empty(voltage.shape)
        for sample, held in enumerate(voltage):
            measured[sample] = levels[len(held) :]
            levels = self._after(levels, held, numbers)
        if self.overflow:
            np.minimum(measured, FULL, out=measured)
        return measured.T[..., None].astype(commands.dtype)

    def _after(self, levels: NDArray, voltage: NDArray, numbers: Mapping[str, NDArray]) -> NDArray:
        """Both levels (2 n,) one sample later: one step of Dormand and Prince's method.

        The step is accepted whatever its error, because trajectories are integrated together and
        must not depend on each other. A sample is short compared with the tanks' time constants.
        """
        # Imported here, since it takes longer than all that a description of the twin needs.
        from scipy.integrate import RK45

        solver = RK45(
            lambda _, now: self._derivatives(now, voltage, numbers),
            0.0,
            levels,
            1 / RATE,
            first_step=1 / RATE,
            atol=np.inf,
        )
        solver.step()
        return np.maximum(solver.y, 0.0)

    def _derivatives(
        self, levels: NDArray, voltage: NDArray, numbers: Mapping[str, NDArray]
    ) -> NDArray:
        """Time derivatives (2 n,) of both levels in V/s."""
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

    Parameters
    ----------
    overflow : bool, default False
        Whether the complete physics is free: also the edge of the upper tank, the fraction that
        spills into the lower tank, and the exponents of the outflows.

    Returns
    -------
    ParametricTwin
        Five or nine free parameters. The start levels are the system's own, the same in every
        record.

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
