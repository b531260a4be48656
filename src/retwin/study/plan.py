"""What a study compares, and the seeds of every stage."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from retwin.cases.case import Case
from retwin.catalog import CALIBRATE_ON, CLASSIFIERS, PRESETS, SOURCES, make, resolve
from retwin.checks import one_of
from retwin.diagnosis import Rocket
from retwin.errors import InputError
from retwin.nets.networks import Network
from retwin.nets.training import Training

__all__ = ["Preset", "StudyPlan"]


@dataclass(frozen=True)
class Preset:
    """Classifier and training of a preset."""

    classifier: str
    runs: int
    training: Training


QUICK = Preset(
    "cnn", 5, Training(max_epochs=25, batch_size=64, learning_rate=3e-3, weight_decay=1e-2)
)
PAPER = Preset("lstm", 10, Training(max_epochs=30, batch_size=32, learning_rate=1e-3, decay="step"))


@dataclass(frozen=True)
class StudyPlan:
    """Everything that decides the result of a study, data apart.

    Parameters
    ----------
    sources: names from SOURCES, in the order they are reported.
    preset: "quick" or "paper": classifier, its training and the number of runs.
    classifier: "cnn", "lstm" or "rocket"; None takes the preset's.
    runs: None takes the preset's.
    seed: of everything.
    folds: of the real set, when there is one set only.
    rate: samples per second the classifier looks at; None takes the case's true sensor rate.
    per_class: generated trajectories per class; None takes the case's.
    calibrate_on: "healthy" or "all".
    encoder_noise: command units of reading noise put on frozen joints, in training and test sets
        alike. Real stuck joints are frozen in software; their exact stillness is an artefact that
        a diagnoser could live on. 0 leaves the data as they are.
    learning_curve: whether sources that are calibrated on healthy trajectories are tried with
        fewer of them too.

    Raises InputError for a name that is not known or a number below one.

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

    def __post_init__(self) -> None:
        one_of("preset", self.preset, PRESETS)
        one_of("classifier", self.classifier_name, CLASSIFIERS)
        one_of("calibrate_on", self.calibrate_on, CALIBRATE_ON)
        for source in self.sources:
            one_of("sources", source, SOURCES)
        for name, number in (("runs", self.number_of_runs), ("per_class", self.per_class)):
            if number is not None and number < 1:
                raise InputError(
                    name, expected="at least 1", got=repr(number), remedy="give a positive number"
                )
        if self.encoder_noise < 0 or (self.rate is not None and self.rate <= 0):
            raise InputError(
                "encoder_noise and rate",
                expected="encoder_noise of at least 0 and a positive rate",
                got=f"{self.encoder_noise} and {self.rate}",
                remedy="leave them out for the defaults",
            )
        if not self.sources or len(set(self.sources)) != len(self.sources):
            raise InputError(
                "sources",
                expected="at least one source, none twice",
                got=repr(self.sources),
                remedy=f"choose from {', '.join(SOURCES)}",
            )

    def generated(self, case: Case) -> int:
        """Trajectories per class, the case's unless given."""
        return case.per_class if self.per_class is None else self.per_class

    @property
    def _preset(self) -> Preset:
        preset: Preset = resolve(PRESETS[self.preset].target)
        return preset

    @property
    def number_of_runs(self) -> int:
        """Runs, the preset's unless given."""
        return self._preset.runs if self.runs is None else self.runs

    @property
    def classifier_name(self) -> str:
        """Classifier, the preset's unless given."""
        return self.classifier or self._preset.classifier

    @property
    def classifier_config(self) -> Network | Rocket:
        """The config of the classifier."""
        config: Network | Rocket = make(CLASSIFIERS, self.classifier_name, "classifier")
        return config

    @property
    def training(self) -> Training | None:
        """The preset's training; None for a classifier whose weights have a closed form."""
        return None if isinstance(self.classifier_config, Rocket) else self._preset.training

    def seed_of(self, stage: str, run: int, fold: int = 0) -> int:
        """The seed of one stage of one run, all from one SeedSequence.

        The stage's name is hashed, so that adding a source changes no other's seed.
        """
        key = (run, fold, zlib.crc32(stage.encode()))
        sequence = np.random.SeedSequence(self.seed, spawn_key=key)
        return int(sequence.generate_state(1, dtype=np.uint32)[0])
