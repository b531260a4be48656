"""`CorrectedTwin`, surrogate, residual model and correction in series (Eq. 4), and `generate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.checks import require, whole
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.serialisation.models import read_about, refusing, write_model
from retwin.serialisation.sizes import Budget
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.system import System
from retwin.twins.twin import Chunk, Twin, checked_commands, checked_seed, simulate_in_chunks
from retwin.twins.wrappers.wrapper import OfTwin
from retwin.update.corrections import measuring
from retwin.update.exact import ExactSurrogate, exact_surrogate, load_surrogate
from retwin.update.forecast_errors import ForecastErrors
from retwin.update.residual import Residual, load_residual
from retwin.update.surrogate import Surrogate
from retwin.update.training_range import training_checked

MAX_PER_CLASS = 10_000_000
"""Trajectories per class that are generated in memory at most: more fit into none."""


@dataclass(frozen=True, eq=False)
class CorrectedTwin(OfTwin):
    """The updated twin, ỹ = g(ŷ, z) with z from the residual model; satisfies `Twin` again.

    Parameters
    ----------
    surrogate : Surrogate
        The IBG, which gives the nominal output ŷ; or a twin in its place (see `ExactSurrogate`).
    residual : Residual
        The RG, which gives the distribution of z and holds the correction g.
    case : str
        Name of the case that it was fitted for; the command line reads it.
    random : bool
        Whether z is drawn; otherwise it is the mean z̄ (Eq. 8), the same in every simulation.
    forecast : ForecastErrors, optional
        Errors of predictions from measurements, by how far ahead; None where none were calibrated.

    """

    surrogate: Surrogate
    residual: Residual
    case: str = ""
    random: bool = True
    forecast: ForecastErrors | None = None
    _field: ClassVar[str] = "surrogate"

    def __post_init__(self) -> None:
        # To simulate, z is applied once: no differences are taken.
        exact = exact_surrogate(self.surrogate, differences=False)
        object.__setattr__(self, "surrogate", exact)

    @property
    def onsets(self) -> NDArray:
        """(k, M) onsets, in s, of the segments of the calibration trajectories."""
        return self.residual.timing / self.rate

    @property
    def unknown_starts(self) -> bool:
        """Whether its twin has a state whose start is not known, which `started` infers."""
        return isinstance(self.surrogate, ExactSurrogate) and self.surrogate.unknown_starts

    def started(self, record: Trajectories) -> CorrectedTwin:
        """The twin with the unknown starts of one record; see `DynamicsTwin.started`."""
        expected = "a model of a StateTwin with unknown starts"
        got = "one whose starts are known, or cannot be set"
        remedy = "simulate it as it is; bounds make a start unknown"
        require(self.unknown_starts, "record", expected=expected, got=got, remedy=remedy)
        surrogate: Any = self.surrogate
        return replace(self, surrogate=surrogate.started(record))

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`. Faults act on the commands; z is drawn, g and the sensor applied.

        z is conditioned on the commands without faults, as in calibration.
        """
        generator = torch.Generator().manual_seed(checked_seed(seed))
        correction = self.residual.correction

        checked = checked_commands(commands, self.inputs).astype(np.float32, copy=False)

        @torch.no_grad()
        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            faulty = {"faulty_commands": chunk.faulty_commands, "frozen": chunk.frozen}
            context = self.residual.context(
                self.surrogate, chunk.commands, chunk.segments, **faulty
            )
            if self.random:
                sampler = self.residual.sampler(context)
                with chunk.turn:  # the same noise, however many threads there are
                    z = sampler(generator)
                    measured = measuring(correction, context, generator)
                outputs = measured(z)
            else:
                outputs = correction.apply(context, self.residual.mean(context))
            return context.nominal.numpy(), outputs.numpy()

        with training_checked(self.surrogate, checked):
            return simulate_in_chunks(
                self, run, checked, faults, seed=seed, progress=progress,
                emulated=self.residual.emulated, threaded=isinstance(self.surrogate, Surrogate),
            )  # fmt: skip

    def save(self, folder: str | Path) -> None:
        """Write one folder with `surrogate` and `residual` inside; a failure leaves no folder.

        Raises InputError for a twin in place of a surrogate that cannot be saved.
        """
        about: dict[str, Any] = {"case": self.case, "random": self.random}
        about["forecast"] = self.forecast and self.forecast.values
        with write_model(folder, "corrected", about, {}) as inside:
            if isinstance(self.surrogate, ExactSurrogate):
                self.surrogate.save(inside / "surrogate", self.case)
            else:
                self.surrogate.save(inside / "surrogate")
            self.residual.save(inside / "residual")

    @classmethod
    def load(cls, folder: str | Path, twin: Twin | None = None) -> CorrectedTwin:
        """Read what `save` wrote; `twin` is the one that it corrects, see `load_twin`.

        Raises InputError if the folder holds no corrected twin or is damaged.
        """
        about = read_about(folder, "corrected")
        folder = Path(folder)
        surrogate = load_surrogate(folder / "surrogate", twin)
        residual = load_residual(folder / "residual")
        with refusing(folder, expected="a corrected twin"):
            forecast = ForecastErrors.of(about.get("forecast"))
            return cls(surrogate, residual, about["case"], about["random"], forecast)


def generate(
    twin: Twin,
    case: System,
    *,
    per_class: int,
    seed: int,
    onsets: NDArray | None = None,
    progress: Progress | None = None,
) -> Trajectories:
    """A labelled set of any size with as many trajectories of each class, from any twin.

    Parameters
    ----------
    twin : Twin
        Plain, surrogate or corrected.
    case : System
        A `Case`, or another object with `faults`, `classes` and a command `sampler`.
    per_class : int
        Trajectories per class, from 1 to 1e7.
    seed : int
        The same seed gives the same bytes on the same machine.
    onsets : NDArray, optional
        (k, M) onsets in s, from which those of the commands are drawn. The default is the onsets of
        the calibration trajectories for a corrected twin, and otherwise the sampler's.
    progress : callable, optional
        Called with the share of the simulations that are done.

    Returns
    -------
    Trajectories
        Sorted by class, with labels.

    Raises
    ------
    InputError
        `per_class` is out of range, or the memory has no room for the set.

    """
    remedy = "give fewer, or write a *.zarr with simulate_to"
    whole("per_class", per_class, at_least=1, at_most=MAX_PER_CLASS, remedy=remedy)
    width = len(twin.inputs) + 2 * len(twin.outputs)
    numbers = per_class * len(case.faults) * case.sampler.steps * width
    # The size of a generated number in bytes, in float32.
    Budget("per_class").take(4 * numbers)
    if onsets is None and isinstance(twin, CorrectedTwin):
        onsets = twin.onsets
    for_commands, for_twin = np.random.SeedSequence(seed).spawn(2)
    faults = [fault for fault in case.faults.values() for _ in range(per_class)]
    rng, own = np.random.default_rng(for_commands), int(for_twin.generate_state(1)[0])
    commands = case.sampler.sample(len(faults), rng=rng, onsets=onsets)
    commands.flags.writeable = False  # no twin changes them, so that none needs a copy
    made = twin.simulate(commands, faults=faults, seed=own, progress=progress)
    # The names of the classes are the case's; a fault has none.
    return made.replace(labels=np.repeat(case.classes, per_class))
