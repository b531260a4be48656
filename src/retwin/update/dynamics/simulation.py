"""`FreeSimulation`: corrected dynamics from commands alone, most probable and drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import distinct_rows
from retwin.twins.equations.state_twin import StateTwin


@dataclass(frozen=True, eq=False)
class FreeSimulation:
    """The distribution of the outputs of commands of which nothing is measured.

    The attributes are those of `DynamicsTwin`.
    """

    equations: StateTwin
    values: NDArray
    factor: NDArray
    start_deviation: NDArray
    free_process: NDArray
    noise: NDArray
    widening: NDArray
    constant: NDArray

    def most_probable(self, commands: NDArray) -> tuple[NDArray, NDArray]:
        """Outputs and states without noise; equal commands are simulated once."""
        distinct, own = distinct_rows(commands)
        theta = np.tile(self.values, (len(distinct), 1))
        outputs, states = self.equations.steps().run(distinct, theta)
        return outputs[own], states[own]

    def drawn(self, commands: NDArray, changes: NDArray, rng: np.random.Generator) -> NDArray:
        """Outputs (n, T, d_y) with drawn parameters, starts and noise.

        The outputs are linear in the parameters about the most probable ones: so the distribution
        is that of the approximation by which the posterior was found, and no draw diverges (Immer,
        Korzepa and Bauer, "Improving predictions of Bayesian neural nets via local linearization",
        2021). `changes` (n, T, q) of the parameters over time do not change these derivatives.
        """
        count, samples = commands.shape[:2]
        states = len(self.start_deviation)
        steps, theta = self.equations.steps(), np.tile(self.values, (count, 1))
        kicks = np.sqrt(self.free_process) * rng.normal(size=(count, samples, states))
        changed = np.array([each.any() for each in changes])
        made = steps.run(commands, theta, kicks, changes if changed.any() else None)[0]
        made += np.sqrt(self.noise) * rng.normal(size=made.shape)
        moves = rng.normal(size=(count, self.factor.shape[1])) @ self.factor.T
        moves[:, -states:] += self.start_deviation * rng.normal(size=(count, states))
        distinct, own = distinct_rows(commands)
        for i, each in enumerate(distinct):
            nominal, by_all = (
                found[0] for found in steps.sensitivities(each[None], self.values[None])
            )
            rows = np.flatnonzero(own == i)
            centre = np.tile(nominal, (len(rows), 1, 1))
            if changed[rows].any():
                faulty = rows[changed[rows]]
                centre[changed[rows]] = steps.run(
                    commands[faulty], theta[faulty], changes=changes[faulty]
                )[0]
            moved = np.moveaxis(by_all @ moves[rows].T, -1, 0)
            scale = self.widening
            if self.constant.any():
                scale = self.scale(self._deviation(each[None], by_all[None]))[0]
            made[rows] = centre + scale * (made[rows] - centre + moved)
        return made

    def moments(self, commands: NDArray) -> tuple[NDArray, NDArray]:
        """Means and standard deviations (n, T, d_y), by linear propagation of what is uncertain."""
        theta = np.tile(self.values, (len(commands), 1))
        mean, slopes = self.equations.steps().sensitivities(commands, theta)
        deviation = self._deviation(commands, slopes)
        return mean, self.scale(deviation) * deviation

    def scale(self, deviation: NDArray) -> NDArray:
        """Factors of propagated deviations (n, T, d_y)."""
        given = self.constant / np.maximum(deviation, np.finfo(float).tiny)
        return np.where(self.constant > 0, given, self.widening)

    def _deviation(self, commands: NDArray, slopes: NDArray) -> NDArray:
        """Deviations (n, T, d_y) by parameters, starts and noise, before they are scaled."""
        states = len(self.start_deviation)
        factor = np.pad(self.factor, ((0, 0), (0, states)))
        factor[-states:, -states:] = np.diag(self.start_deviation)
        moved = np.sum((slopes @ factor) ** 2, axis=-1)
        return np.asarray(np.sqrt(self.noise_variance(commands) + moved))

    def noise_variance(self, commands: NDArray) -> NDArray:
        """Variances (n, T, d_y) of the outputs in free simulation by noise alone."""
        theta = np.tile(self.values, (len(commands), 1))
        shape = (*commands.shape[:2], len(self.noise))
        states, steps = len(self.start_deviation), self.equations.steps()
        known, unseen = (
            np.zeros((len(commands), states, states)),
            (np.zeros(shape), np.zeros(shape)),
        )
        variances = self.free_process, self.noise
        found = steps.filter(commands, theta, unseen, known, variances)[1]
        return np.diagonal(found, axis1=2, axis2=3)
