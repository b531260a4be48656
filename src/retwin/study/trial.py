"""`Trial`: the models and the real data that one source may use in one run and fold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.cases.case import Case
from retwin.data.segments import Segments
from retwin.data.trajectories import HEALTHY, UNLABELLED, Trajectories
from retwin.diagnosis import FittedDiagnoser, NetworkDiagnoser, fit_diagnoser
from retwin.progress import Progress
from retwin.serialisation.models import read_about
from retwin.study.files import Files, Job
from retwin.study.plan import StudyPlan
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.blackbox import BLACK_BOXES
from retwin.update.corrected import CorrectedTwin, generate
from retwin.update.corrections import Correction
from retwin.update.dynamics import DynamicsTwin
from retwin.update.identification import PosteriorTwin
from retwin.update.loading import load_twin
from retwin.update.residual import Residual, load_residual
from retwin.update.surrogate import Surrogate

SEES = {
    "none": (),
    "timing": ("timing",),
    "healthy": ("timing", "healthy"),
    "unlabelled": ("timing", "unlabelled"),
    "transductive": ("timing", "test outputs"),
    "labelled": ("timing", "healthy", "labelled"),
}
"""The real data to which each value of a source's `real_data` gives access."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One run and fold of a study, as the source of a job may see it.

    Real data that `sees` does not name cannot be accessed here, so a source cannot use more than
    it declares.

    Attributes
    ----------
    files : Files
        Paths of intermediate results.
    case : Case
        The system.
    plan : StudyPlan
        What is compared.
    fold : (tuple of int, tuple of int)
        Indices of the calibration and of the test trajectories.
    job : Job
        Run, fold, and the number of healthy calibration trajectories.
    sees : str
        A key of `SEES`.
    progress : Progress or None
        Called with the share that is done.

    """

    files: Files
    case: Case
    plan: StudyPlan
    fold: tuple[tuple[int, ...], tuple[int, ...]]
    job: Job
    sees: str
    progress: Progress | None = None

    def seed(self, stage: str) -> int:
        """The seed of one stage of this run and fold."""
        return self.plan.seed_of(stage, self.job.run, self.job.fold)

    # Results of other jobs.

    def surrogate(self, name: str = "") -> Surrogate:
        """The IBG of the twin as it is, or after the update of that name."""
        return Surrogate.load(self._made("surrogate", name))

    def residual(self, name: str) -> Residual:
        """The RG with the correction of that name, see `correction`."""
        return load_residual(self._made("residual", name))

    def diagnoser(self, source: str) -> NetworkDiagnoser:
        """The network that was trained for another source."""
        return NetworkDiagnoser.load(self.files.diagnoser(self.job.before("diagnosis", source)))

    def updated(self, method: str) -> Twin:
        """The twin that was updated: its parameters, their posterior, or its state equations.

        A black-box model takes its place: an LSTM, or one of state equations.
        """
        folder = self._made("update", method)
        if method == "fit":
            return load_twin(folder, self.case.parametric or self.case.twin)
        if method == "lstm":
            return CorrectedTwin.load(folder)
        if method == "dynamics" or method in BLACK_BOXES:
            return DynamicsTwin.load(folder)
        if method == "pi_bayes":
            return PosteriorTwin.load(folder, self.parametric)
        return self.parametric.with_values(read_about(folder, "parameters")["values"])

    def _made(self, kind: str, name: str) -> Path:
        return self.files.path(self.job.before(kind, name))

    # Properties of the case.

    @property
    def parametric(self) -> ParametricTwin:
        """The twin with its free parameters."""
        assert self.case.parametric is not None, "checked before the study begins"
        return self.case.parametric

    def correction(self, name: str) -> Correction:
        """The case's own correction for "command", else the one at the outputs (the paper's)."""
        return self.case.correction if name == "command" else self.case.output_correction

    # Data.

    @property
    def twin_data(self) -> Trajectories:
        """The labelled trajectories of the twin; they are no real data."""
        seed = self.seed("encoder noise in training")
        return self._noisy(self.files.twin_data(), seed)

    @property
    def onsets(self) -> NDArray | None:
        """Onsets (k, M) of segments in the calibration set, in s; NaN for none."""
        if "timing" not in SEES[self.sees]:
            return None
        seen = self.files.real_data()[list(self.fold[0])]
        segments = Segments.from_commands(seen.commands).until(seen.lengths)
        return np.where(segments.valid, segments.start / seen.rate, np.nan)

    @property
    def healthy(self) -> Trajectories:
        """The healthy calibration trajectories."""
        return self._calibration("healthy").with_label(HEALTHY)

    @property
    def unlabelled(self) -> Trajectories:
        """The calibration set without labels."""
        found = self._calibration("unlabelled")
        return found.replace(labels=np.full(len(found), UNLABELLED))

    @property
    def labelled(self) -> Trajectories:
        """The calibration set with labels."""
        return self._calibration("labelled")

    @property
    def test_outputs(self) -> Trajectories:
        """The test set without labels; a source that trains on it is flagged."""
        self._allow("test outputs")
        return self.tested()

    def tested(self) -> Trajectories:
        """The test set without labels, for prediction alone."""
        found = self._real()[list(self.fold[1])]
        return found.replace(labels=np.full(len(found), UNLABELLED))

    def _calibration(self, what: str) -> Trajectories:
        self._allow(what)
        found = self._real()[list(self.fold[0])]
        if self.job.healthy == 0:
            return found
        # Nested: the subsets of a learning curve contain each other.
        order = np.random.default_rng(self.seed("learning curve")).permutation(len(found))
        kept = [
            index
            for label in self.case.classes
            for index in order[found.labels[order] == label][: self.job.healthy]
        ]
        return found[np.sort(kept)]

    def _allow(self, what: str) -> None:
        if what not in SEES[self.sees]:
            raise PermissionError(f"{self.job} declares {self.sees!r} and asks for {what}")

    def _real(self) -> Trajectories:
        # The noise is the same in every run and for every source.
        return self._noisy(self.files.real_data(), self.plan.seed_of("encoder noise in test", 0))

    def _noisy(self, trajectories: Trajectories, seed: int) -> Trajectories:
        if self.plan.encoder_noise == 0 or self.case.encoder_noise is None:
            return trajectories
        return self.case.encoder_noise(trajectories, self.plan.encoder_noise, seed)

    # Steps that sources share.

    def generate(self, twin: Twin) -> Trajectories:
        """A labelled training set, with the same commands and faults for all sources of a run."""
        case, seed, count = self.case, self.seed("generate"), self.plan.generated(self.case)
        made = generate(twin, case, per_class=count, seed=seed, onsets=self.onsets)
        return self._noisy(made, self.seed("encoder noise in training"))

    @property
    def fitting(self) -> dict[str, Any]:
        """Arguments of `fit_diagnoser` that all sources share."""
        return {
            "training": self.plan.training,
            "seed": self.seed("diagnoser"),
            "classes": self.case.classes,
            "rate": self.plan.rate or self.case.sensor_rate,
            "progress": self.progress,
        }

    @property
    def updating(self) -> dict[str, Any]:
        """Arguments of `identify` that all sources share."""
        return {
            "seed": self.seed("update"),
            "rate": self.case.sensor_rate,
            "progress": self.progress,
        }

    def train(self, made: Trajectories) -> FittedDiagnoser:
        """The study's classifier, trained on labelled trajectories."""
        return fit_diagnoser(made, self.plan.classifier_config, **self.fitting)
