"""`CorrectedTwin`: surrogate, residual model and correction in series (Eq. 4); and `generate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.data.trajectories import Channels, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.models import read_about, write_model
from retwin.twins.faults import Fault
from retwin.twins.system import System
from retwin.twins.twin import (
    Chunk,
    Twin,
    checked_commands,
    checked_seed,
    simulate_in_chunks,
)
from retwin.update.corrections import measured_outputs
from retwin.update.residual import Residual, load_residual
from retwin.update.surrogate import Surrogate

__all__ = ["CorrectedTwin", "generate"]


@dataclass(frozen=True, eq=False)
class CorrectedTwin:
    """The updated twin, ỹ = g(ŷ, z) with z from the residual model; satisfies `Twin` again.

    Attributes
    ----------
    surrogate: the IBG.
    residual: the RG; it holds the correction g.
    case: name of the case it was fitted for, for the command line.
    random: whether z is drawn; else it is the RG's mean z̄ (Eq. 8), the same in every simulation.

    """

    surrogate: Surrogate
    residual: Residual
    case: str = ""
    random: bool = True

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        return self.surrogate.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        return self.surrogate.outputs

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.surrogate.rate

    @property
    def timing(self) -> NDArray:
        """(k, M) onsets in samples of the trajectories it was calibrated on."""
        return self.residual.timing

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`. Faults act on the commands, then z is drawn, g applied, and read.

        z is drawn for the clean commands: the RG is not told of faults.
        """
        generator = torch.Generator().manual_seed(checked_seed(seed))
        correction = self.residual.correction

        @torch.no_grad()
        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            context = self.residual.context(
                self.surrogate,
                chunk.commands,
                chunk.segments,
                faulty_commands=chunk.faulty_commands,
                frozen=chunk.frozen,
            )
            if self.random:
                z = self.residual.sample(context, generator=generator)
                outputs = measured_outputs(correction, context, z, generator)
            else:
                outputs = correction.apply(context, self.residual.mean(context))
            return context.nominal.numpy(), outputs.numpy()

        return simulate_in_chunks(
            self,
            run,
            checked_commands(commands, self.inputs).astype(np.float32, copy=False),
            faults,
            seed=seed,
            progress=progress,
            emulated=self.residual.emulated,
        )

    def save(self, folder: str | Path) -> None:
        """Write one folder with `surrogate` and `residual` inside, or nothing."""
        about = {"case": self.case, "random": self.random}
        with write_model(folder, "corrected", about, {}) as inside:
            self.surrogate.save(inside / "surrogate")
            self.residual.save(inside / "residual")

    @classmethod
    def load(cls, folder: str | Path) -> CorrectedTwin:
        """Read what `save` wrote; InputError when it is not a corrected twin or damaged."""
        about = read_about(folder, "corrected")
        folder = Path(folder)
        surrogate = Surrogate.load(folder / "surrogate")
        residual = load_residual(folder / "residual")
        return cls(surrogate, residual, about["case"], about["random"])


def generate(
    twin: Twin,
    case: System,
    *,
    per_class: int,
    seed: int,
    timing: NDArray | None = None,
    progress: Progress | None = None,
) -> Trajectories:
    """A balanced labelled set of any size from any twin.

    Parameters
    ----------
    twin: plain, learned or corrected.
    case: a `Case`, or anything else with `faults`, `classes` and a command `sampler`.
    per_class: trajectories per class.
    seed: same seed, same bytes on the same machine.
    timing: (k, M) onsets in samples to draw the command timing from; by default what a corrected
        twin saw when it was calibrated, else the sampler's own.

    Raises
    ------
    InputError: `per_class` below 1.

    """
    if per_class < 1:
        raise InputError(
            "per_class",
            expected="a whole number of at least 1",
            got=repr(per_class),
            remedy="say how many trajectories each class gets",
        )
    if timing is None and isinstance(twin, CorrectedTwin):
        timing = twin.timing
    for_commands, for_twin = np.random.SeedSequence(seed).spawn(2)
    faults = [fault for fault in case.faults.values() for _ in range(per_class)]
    commands = case.sampler.sample(
        len(faults), rng=np.random.default_rng(for_commands), timing=timing
    )
    made = twin.simulate(
        commands, faults=faults, seed=int(for_twin.generate_state(1)[0]), progress=progress
    )
    # The case names its classes; a fault only says what it is.
    return made.replace(labels=np.repeat(case.classes, per_class))
