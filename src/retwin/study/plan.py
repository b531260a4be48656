"""`StudyPlan`: what a study compares, and the seeds of its stages."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from retwin.cases.case import Case
from retwin.catalog import CALIBRATE_ON, CLASSIFIERS, PRESETS, SOURCES, make, resolve
from retwin.checks import finite, one_of, require, whole
from retwin.diagnosis import Rocket
from retwin.nets.networks import Network
from retwin.nets.training import Training
from retwin.times import sample_rate
from retwin.update.corrected import MAX_PER_CLASS


@dataclass(frozen=True)
class Preset:
    """The classifier, the number of runs and the training of a preset.

    Attributes
    ----------
    classifier : str
        A key of `retwin.catalog.CLASSIFIERS`.
    runs : int
        Number of runs.
    training : Training
        The training of the classifier.

    """

    classifier: str
    runs: int
    training: Training


QUICK = Preset(
    "cnn", 5, Training(max_epochs=25, batch_size=64, learning_rate=3e-3, weight_decay=1e-2)
)
"""A convolutional network, which is trained in seconds."""
PAPER = Preset("lstm", 10, Training(max_epochs=30, batch_size=32, learning_rate=1e-3, decay="step"))
"""The classifier, its training and the number of runs of the paper (sections 4.3.2 and 5)."""


@dataclass(frozen=True)
class StudyPlan:
    """All settings that determine the result of a study, apart from its data.

    Parameters
    ----------
    sources : tuple of str
        Keys of `retwin.catalog.SOURCES`, in the order in which they are reported.
    preset : str
        "quick" or "paper": the classifier, its training and the number of runs.
    classifier : str, optional
        "cnn", "lstm" or "rocket"; by default the preset's.
    runs : int, optional
        Number of runs, from 1 to 1000; by default the preset's.
    seed : int
        Root of all seeds, at least 0.
    folds : int
        Folds of the real set if there is one set only, at least 2.
    rate : float, optional
        Sample rate of the classifier's features in Hz; by default the case's true sensor rate.
    per_class : int, optional
        Generated trajectories per class, from 1 to 1e7; by default the case's.
    calibrate_on : str
        "healthy" or "all": the real trajectories from which residual models learn.
    encoder_noise : float
        Amplitude of encoder noise added to the joints of all trajectories, in training and test
        sets, in command units; 0 leaves the data as they are. Real stuck joints are frozen in
        software, and a diagnoser could exploit that they do not move at all.
    learning_curve : bool
        Whether sources that are calibrated on healthy trajectories are also calibrated on fewer.
    emulated_healthy : int
        Healthy trajectories of the emulated set that stands in for a real one, at least 1.
    calibrated : int, optional
        Trajectories of each class in the calibration part of a fold, at least 1; by default all
        that the fold does not test.
    simulated : int, optional
        Healthy test trajectories per fold that are simulated for the fidelity and for the
        predictive overlay, at least 1; by default all. Diagnoses are of all in any case.
    overlaid : int, optional
        The same for faulty ones, per class and fold, which only the predictive overlay shows.
    ablations : bool
        Whether the fidelity of a residual model is compared with that of simpler ones, and whether
        its bands are widened by held-out trajectories: two further fits in each fold.

    Raises
    ------
    InputError
        If a name is unknown or a number is out of its range or not finite.

    """

    sources: tuple[str, ...] = ("dt", "ibg", "ibg_rg")
    preset: str = "quick"
    classifier: str | None = None
    runs: int | None = None
    seed: int = 0
    folds: int = 3
    rate: float | None = None
    per_class: int | None = None
    calibrate_on: str = "healthy"
    encoder_noise: float = 0.0
    learning_curve: bool = False
    emulated_healthy: int = 10
    calibrated: int | None = None
    simulated: int | None = None
    overlaid: int | None = None
    ablations: bool = True

    def __post_init__(self) -> None:
        one_of("preset", self.preset, PRESETS)
        one_of("classifier", self.classifier_name, CLASSIFIERS)
        one_of("calibrate_on", self.calibrate_on, CALIBRATE_ON)
        for source in self.sources:
            one_of("sources", source, SOURCES)
        fits = 0 < len(self.sources) == len(set(self.sources))
        expected = "at least one source, none twice"
        remedy = f"choose from {', '.join(SOURCES)}"
        require(fits, "sources", expected=expected, got=self.sources, remedy=remedy)
        # Runs beyond this number change no mean by more than 3 % of the spread between runs.
        whole("runs", self.number_of_runs, at_least=1, at_most=1000)
        whole("seed", self.seed)
        whole("folds", self.folds, at_least=2)
        if self.per_class is not None:
            whole("per_class", self.per_class, at_least=1, at_most=MAX_PER_CLASS)
        if self.rate is not None:
            sample_rate("rate", self.rate)
        whole("emulated_healthy", self.emulated_healthy, at_least=1, at_most=MAX_PER_CLASS)
        for name in ("calibrated", "simulated", "overlaid"):
            if (count := getattr(self, name)) is not None:
                whole(name, count, at_least=1)
        finite("encoder_noise", self.encoder_noise, at_least=0.0, unit="command units")

    def generated(self, case: Case) -> int:
        """Generated trajectories per class; the case's by default."""
        return case.per_class if self.per_class is None else self.per_class

    @property
    def _preset(self) -> Preset:
        return resolve(PRESETS[self.preset].target)

    @property
    def number_of_runs(self) -> int:
        """Number of runs; the preset's by default."""
        return self._preset.runs if self.runs is None else self.runs

    @property
    def classifier_name(self) -> str:
        """Key of the classifier in the catalog; the preset's by default."""
        return self.classifier or self._preset.classifier

    @property
    def classifier_config(self) -> Network | Rocket:
        """The config of the classifier."""
        return make(CLASSIFIERS, self.classifier_name, "classifier")

    @property
    def training(self) -> Training | None:
        """The preset's training; None for a classifier whose weights have a closed form."""
        return None if isinstance(self.classifier_config, Rocket) else self._preset.training

    def seed_of(self, stage: str, run: int, fold: int = 0) -> int:
        """The seed of one stage of one run, all spawned from one SeedSequence.

        The key of a stage is the CRC-32 of its name, so a new stage changes no other's seed.

        Parameters
        ----------
        stage : str
            Any name, such as "generate".
        run, fold : int
            Counted from 0.

        """
        key = (run, fold, zlib.crc32(stage.encode()))
        sequence = np.random.SeedSequence(self.seed, spawn_key=key)
        return int(sequence.generate_state(1, dtype=np.uint32)[0])
