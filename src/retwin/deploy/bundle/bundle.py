"""`Bundle`: a corrected twin, its diagnoser and its guard in one sealed folder."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin._version import __version__
from retwin.cases.case import Case
from retwin.checks import given
from retwin.data.segments import Segments
from retwin.data.trajectories import UNKNOWN, Trajectories
from retwin.deploy.bundle.facts import SAMPLERS, Facts
from retwin.deploy.bundle.guard import Guard
from retwin.deploy.bundle.seal import SCHEMAS, open_sealed, seal
from retwin.deploy.bundle.verdicts import Prediction, present_diagnoser
from retwin.diagnosis import FittedDiagnoser, conclude, load_diagnoser
from retwin.progress import Progress
from retwin.serialisation.models import read_model, refusing, save_model, write_model
from retwin.update.corrected import CorrectedTwin, generate


@dataclass(frozen=True, eq=False)
class Bundle:
    """Everything that was fitted for one machine; it works without the data it was fitted to.

    Attributes
    ----------
    twin : CorrectedTwin
        Surrogate, residual model, correction and sensor.
    guard : Guard
        Checks of whether a trajectory can be diagnosed.
    facts : Facts
        The values of the case that are kept.
    diagnoser : diagnoser or None
        Classifier of trajectories; None for a bundle that only simulates.
    provenance : mapping
        Versions, data with their SHA-256, and the maker's notes.

    """

    twin: CorrectedTwin
    guard: Guard
    facts: Facts
    diagnoser: FittedDiagnoser | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.facts.check_classes(self.diagnoser)

    @classmethod
    def of(
        cls,
        case: Case,
        twin: CorrectedTwin,
        guard: Guard,
        diagnoser: FittedDiagnoser | None = None,
        *,
        data: Sequence[Trajectories] = (),
        notes: Mapping[str, Any] | None = None,
    ) -> Bundle:
        """A bundle of what was fitted for `case`.

        Parameters
        ----------
        case : Case
            The case; its faults, sensor rate and, if possible, its command sampler are kept.
        twin, guard, diagnoser : CorrectedTwin, Guard, diagnoser or None
            What was fitted.
        data : sequence of Trajectories
            The sets that it was fitted to, the calibration set first. Only their names, SHA-256
            and greatest number of segments are kept.
        notes : mapping, optional
            Plain values for the provenance, such as the command and its seed.

        Returns
        -------
        Bundle
            The bundle, not yet saved.

        Raises
        ------
        InputError
            If the diagnoser's classes are not the case's.

        """
        probe = case.sampler.sample(8, rng=np.random.default_rng(0))
        sets = [probe, *(each.commands for each in data if len(each))]
        facts = Facts(
            case=case.name,
            faults=dict(case.faults),
            sensor_rate=case.sensor_rate,
            steps=case.sampler.steps,
            max_segments=max(Segments.from_commands(commands).max_count for commands in sets),
            sampler=case.sampler if isinstance(case.sampler, SAMPLERS) else None,
        )
        provenance = {
            "retwin": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
            "data": [source.plain() for each in data for source in each.provenance],
            **(notes or {}),
        }
        return cls(twin, guard, facts, diagnoser, provenance)

    @property
    def case(self) -> Case:
        """A case from the facts alone, with the corrected twin as its twin.

        Raises
        ------
        InputError
            If commands are drawn by code of the case, which a bundle cannot hold.

        """
        expected = f"the case {self.facts.case!r} itself, whose code draws commands"
        got, remedy = "the bundle alone", "give the case (--case NAME)"
        sampler = given("case", self.facts.sampler, expected, got=got, remedy=remedy)
        correction = self.twin.residual.correction
        return Case(
            name=self.facts.case,
            title=self.facts.case,
            faults=self.facts.faults,
            twin=self.twin,
            emulator=None,
            sampler=sampler,
            correction=correction,
            output_correction=correction,
            sensor_rate=self.facts.sensor_rate,
        )

    def predict(self, trajectories: Trajectories) -> Prediction:
        """Diagnose trajectories, and flag those that the bundle was not made for.

        Parameters
        ----------
        trajectories : Trajectories
            The n trajectories, with commands; labels are not used.

        Returns
        -------
        Prediction
            Probabilities and verdicts; a trajectory that is outside has no diagnosis, and its
            probabilities are NaN. So is one that the diagnoser calls unknown.

        Raises
        ------
        InputError
            If the bundle has no diagnoser, or if channels or rate are not those of the bundle.

        """
        diagnoser = present_diagnoser(self.diagnoser)
        verdicts = self.guard.assess(self.twin.surrogate, trajectories, steps=self.facts.steps)

        def probabilities(some: Trajectories) -> NDArray:
            found = conclude(diagnoser, some)
            rest: NDArray = np.where(found.labels == UNKNOWN, np.nan, 1.0)
            return found.probabilities * rest[:, None]

        return Prediction.of(diagnoser.classes, verdicts, trajectories, probabilities)

    def generate(
        self,
        case: Case | None = None,
        *,
        per_class: int,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """A balanced labelled set, see `retwin.generate`; by default of `self.case`."""
        return generate(
            self.twin, case or self.case, per_class=per_class, seed=seed, progress=progress
        )

    def save(self, folder: str | Path) -> None:
        """Write one sealed folder, atomically; the same bundle gives the same bytes."""
        about = {
            "schema": SCHEMAS["bundle"],
            **self.facts.about(),
            "diagnoser": self.diagnoser is not None,
            "provenance": dict(self.provenance),
        }
        with write_model(folder, "bundle", about, {}) as inside:
            self.twin.save(inside / "twin")
            save_model(inside / "guard", "guard", self.guard.about(), self.guard.state_dict())
            if self.diagnoser is not None:
                self.diagnoser.save(inside / "diagnoser")
            seal(inside)

    @classmethod
    def load(cls, folder: str | Path) -> Bundle:
        """Read what `save` wrote, after its seal was verified.

        Raises
        ------
        InputError
            If a file was changed, removed or added; if the folder is of another kind or schema; or
            if it is sealed and holds no bundle.

        """
        folder = Path(folder)
        with open_sealed(folder, "bundle") as about, refusing(folder, expected="a bundle"):
            twin = CorrectedTwin.load(folder / "twin")
            return cls(
                twin=twin,
                guard=Guard.of(*read_model(folder / "guard", "guard")),
                facts=Facts.of(about),
                diagnoser=load_diagnoser(folder / "diagnoser") if about["diagnoser"] else None,
                provenance=dict(about["provenance"]),
            )
