"""`Bundle`: a corrected twin, its diagnoser and its guard in one sealed folder."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from retwin._version import __version__
from retwin.cases.case import Case
from retwin.data.segments import Segments
from retwin.data.trajectories import Trajectories
from retwin.deploy.bundle.facts import SAMPLERS, Facts
from retwin.deploy.bundle.guard import Guard
from retwin.deploy.bundle.seal import SCHEMA, distrusting, read_sealed, seal
from retwin.deploy.bundle.verdicts import Prediction
from retwin.diagnosis import FittedDiagnoser, load_diagnoser
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.models import read_model, write_model
from retwin.update.corrected import CorrectedTwin, generate

__all__ = ["Bundle"]


@dataclass(frozen=True, eq=False)
class Bundle:
    """All that was fitted for one machine; works without the data that it was fitted to.

    Attributes
    ----------
    twin: surrogate, residual model, correction and sensor.
    guard: which trajectories it may be asked about.
    diagnoser: tells the classes apart; None where there are none.
    facts: what it keeps of its case.
    provenance: versions, data with their SHA-256, and what the maker wishes to add.

    """

    twin: CorrectedTwin
    guard: Guard
    facts: Facts
    diagnoser: FittedDiagnoser | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

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
        case, twin, guard, diagnoser: what goes together.
        data: the sets that it was fitted to, the calibration first; only names, SHA-256 and the
            number of movements are kept.
        notes: plain values beside the provenance, such as the command and its seed.

        Raises
        ------
        InputError: a diagnoser of other classes than the case's.

        """
        if diagnoser is not None and set(diagnoser.classes) != set(case.classes):
            raise InputError(
                "diagnoser",
                expected=f"one of the classes of {case.name}, {', '.join(case.classes)}",
                got=", ".join(diagnoser.classes),
                remedy="train it on trajectories of this case",
            )
        probe = case.sampler.sample(8, rng=np.random.default_rng(0))
        movements = [Segments.from_commands(each.commands).max_count for each in data if len(each)]
        facts = Facts(
            case=case.name,
            faults=dict(case.faults),
            sensor_rate=case.sensor_rate,
            steps=case.sampler.steps,
            movements=max([Segments.from_commands(probe).max_count, *movements]),
            sampler=case.sampler if isinstance(case.sampler, SAMPLERS) else None,
        )
        provenance = {
            "retwin": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
            "data": [vars(source) for each in data for source in each.provenance],
            **(notes or {}),
        }
        return cls(twin, guard, facts, diagnoser, provenance)

    @property
    def case(self) -> Case:
        """A case made from the facts alone, its twin the corrected one.

        Raises InputError where commands are drawn by code of the case, which a bundle cannot hold.
        """
        if self.facts.sampler is None:
            raise InputError(
                "case",
                expected=f"the case {self.facts.case!r} itself, whose code draws commands",
                got="the bundle alone",
                remedy="give the case (--case NAME)",
            )
        correction = self.twin.residual.correction
        return Case(
            name=self.facts.case,
            title=self.facts.case,
            faults=self.facts.faults,
            twin=self.twin,
            emulator=None,
            sampler=self.facts.sampler,
            correction=correction,
            output_correction=correction,
            sensor_rate=self.facts.sensor_rate,
        )

    def predict(self, trajectories: Trajectories) -> Prediction:
        """Diagnose trajectories, and say which of them the bundle was not made for.

        A trajectory that is outside has no diagnosis, and its probabilities are NaN.

        Raises
        ------
        InputError: a bundle without a diagnoser; other channels or another rate than it was made
            for, or no commands.

        """
        if self.diagnoser is None:
            raise InputError(
                "bundle",
                expected="one with a diagnoser",
                got="one without",
                remedy="train a diagnoser and make the bundle anew",
            )
        verdicts = self.guard.judge(self.twin.surrogate, trajectories, steps=self.facts.steps)
        return Prediction.of(
            self.diagnoser.classes, verdicts, trajectories, self.diagnoser.predict_proba
        )

    def generate(
        self,
        case: Case | None = None,
        *,
        per_class: int,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """A balanced labelled set, see `retwin.generate`; by default for `self.case`."""
        return generate(
            self.twin, case or self.case, per_class=per_class, seed=seed, progress=progress
        )

    def save(self, folder: str | Path) -> None:
        """Write one sealed folder, whole or not at all; the same bundle gives the same bytes."""
        about = {
            "schema": SCHEMA,
            **self.facts.about(),
            "diagnoser": self.diagnoser is not None,
            "provenance": dict(self.provenance),
        }
        with write_model(folder, "bundle", about, {}) as inside:
            self.twin.save(inside / "twin")
            with write_model(
                inside / "guard", "guard", self.guard.about(), self.guard.state_dict()
            ):
                pass
            if self.diagnoser is not None:
                self.diagnoser.save(inside / "diagnoser")
            seal(inside)

    @classmethod
    def load(cls, folder: str | Path) -> Bundle:
        """Read what `save` wrote, after its seal was verified.

        Raises
        ------
        InputError: a file that was changed, is missing or was added; another kind or schema; or a
            folder that was sealed but holds no bundle.

        """
        about = read_sealed(folder, "bundle")
        folder = Path(folder)
        remedy = "make it anew with Bundle.save"
        with distrusting(folder, expected="a bundle", remedy=remedy):
            return cls(
                twin=CorrectedTwin.load(folder / "twin"),
                guard=Guard.of(*read_model(folder / "guard", "guard")),
                facts=Facts.of(about),
                diagnoser=load_diagnoser(folder / "diagnoser") if about["diagnoser"] else None,
                provenance=dict(about["provenance"]),
            )
