"""What a study compares: updated twins and their rivals, each a source of answers.

A source is a row of PROTOCOL's table (docs/theory.md, How a study scores). It says which real data
it may see, and how its twin or its diagnoser is made from what a `Trial` holds out to it. Where
there are classes its answers are diagnoses, else simulations of the test records.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from retwin.case import Case
from retwin.corrected import CorrectedTwin
from retwin.diagnosis import Diagnoser, fine_tune, fit_dann, fit_inversion
from retwin.residual import ResidualModel, SequenceMixture
from retwin.twins.noisy import NoisyTwin, residual_scale
from retwin.twins.protocol import Twin
from retwin.twins.randomised import RandomisedTwin

if TYPE_CHECKING:
    from retwin.study.plan import StudyPlan
    from retwin.study.trial import Trial

__all__ = ["NEEDS", "ROCKET", "SOURCES", "Need", "Source", "Trained", "lacking"]

ROCKET = "rocket"
"""The classifier that is no network."""

Need = tuple[str, str]
"""A result that must be there first: kind of job, and name."""

SURROGATE: Need = ("surrogate", "")
OUTPUT: Need = ("residual", "output")
COMMAND: Need = ("residual", "command")
LEAST_SQUARES: Need = ("update", "pi_ls")
IDENTIFIED: Need = ("surrogate", "pi_ls")
IDENTIFIED_OUTPUT: Need = ("residual", "pi_ls")

NEEDS: Mapping[Need, tuple[Need, ...]] = {
    OUTPUT: (SURROGATE,),
    COMMAND: (SURROGATE,),
    IDENTIFIED: (LEAST_SQUARES,),
    IDENTIFIED_OUTPUT: (IDENTIFIED,),
}
"""What must be there before the parts that sources need."""


class Trained(Diagnoser, Protocol):
    """A diagnoser that can be kept."""

    def save(self, folder: str | Path) -> None:
        """Write one folder."""
        ...


@dataclass(frozen=True)
class Source:
    """Where answers come from: one of `twin`, `diagnoser` and `pool` says how they are made.

    Attributes
    ----------
    title: for people.
    real_data: what it may see: "none", "timing" (of commands), "healthy", "unlabelled",
        "transductive" (outputs of the test set), "labelled".
    needs: what must be made first.
    twin: the twin that simulates, or whose trajectories the study's classifier is trained on.
    diagnoser: makes the diagnoser itself.
    pool: sources whose probabilities are pooled.
    network: whether the study's classifier must be a network for it.
    package: that must be installed.
    simulates: whether it only simulates, and has no place in a study of diagnoses.

    """

    title: str
    real_data: str
    needs: tuple[Need, ...] = ()
    twin: Callable[[Trial], Twin] | None = None
    diagnoser: Callable[[Trial], Trained] | None = None
    pool: tuple[str, ...] = ()
    network: bool = False
    package: str = ""
    simulates: bool = False

    @property
    def per_fold(self) -> bool:
        """Whether it depends on the calibration set; one that does not is trained once."""
        return self.real_data != "none"

    @property
    def parametric(self) -> bool:
        """Whether the case must say what is not known of its twin."""
        updated = {LEAST_SQUARES, ("update", "pi_bayes"), IDENTIFIED}
        return bool(updated & set(self.needs)) or self.twin is _randomised

    @property
    def judged(self) -> bool:
        """Whether it is told how real its trajectories are."""
        return self.twin is not None and self.real_data == "healthy"


def _on_twin_data(trial: Trial) -> Trained:
    return trial.train(trial.twin_data)


def _randomised(trial: Trial) -> Twin:
    return RandomisedTwin(trial.parametric)


def _noisy(trial: Trial) -> Twin:
    healthy = trial.healthy
    scale = residual_scale(healthy)
    return NoisyTwin(trial.surrogate(), scale, stride=trial.stride, emulated=healthy.emulated)


def _mean_corrected(trial: Trial) -> Twin:
    return CorrectedTwin(trial.surrogate(), trial.residual("output"), random=False)


def _adversarial(trial: Trial) -> Trained:
    return fit_dann(trial.twin_data, trial.unlabelled, trial.network, **trial.fitting)


def _adversarial_on_test(trial: Trial) -> Trained:
    return fit_dann(trial.twin_data, trial.test_outputs, trial.network, **trial.fitting)


def _fine_tuned(trial: Trial) -> Trained:
    base = trial.diagnoser("ibg_rg_command")
    made = trial.generate(_command(trial))
    return fine_tune(base, made, trial.labelled, seed=trial.seed("fine-tuning"))


def _inversion(trial: Trial) -> Trained:
    residual = trial.residual("command")
    assert isinstance(residual, ResidualModel), "checked before the study begins"
    return fit_inversion(trial.surrogate(), residual, trial.healthy, trial.case.faults)


def _output(trial: Trial) -> Twin:
    return CorrectedTwin(trial.surrogate(), trial.residual("output"))


def _command(trial: Trial) -> Twin:
    return CorrectedTwin(trial.surrogate(), trial.residual("command"))


def _identified(trial: Trial) -> Twin:
    return CorrectedTwin(trial.surrogate("pi_ls"), trial.residual("pi_ls"))


SOURCES: Mapping[str, Source] = {
    "dt": Source("Digital twin", "none", diagnoser=_on_twin_data),
    "twin": Source("Digital twin", "none", twin=lambda trial: trial.case.twin, simulates=True),
    "randomised": Source("Randomised twin", "none", twin=_randomised),
    "ibg": Source("IBG alone", "timing", (SURROGATE,), twin=lambda trial: trial.surrogate()),
    "dt_noise": Source("IBG + output noise", "healthy", (SURROGATE,), twin=_noisy),
    "pi_ls": Source(
        "Least squares (Eq. 2)",
        "healthy",
        (LEAST_SQUARES,),
        twin=lambda trial: trial.updated("pi_ls"),
    ),
    "pi_bayes": Source(
        "Bayesian updating (Eq. 3)",
        "healthy",
        (("update", "pi_bayes"),),
        twin=lambda trial: trial.updated("pi_bayes"),
        package="sbi",
    ),
    "dann": Source("Domain-adversarial", "unlabelled", diagnoser=_adversarial, network=True),
    "dann_transductive": Source(
        "Domain-adversarial, transductive",
        "transductive",
        diagnoser=_adversarial_on_test,
        network=True,
    ),
    "mean_corrected": Source("IBG + RG mean", "healthy", (SURROGATE, OUTPUT), twin=_mean_corrected),
    "ibg_rg": Source("IBG + RG", "healthy", (SURROGATE, OUTPUT), twin=_output),
    "pi_ls_rg": Source(
        "Least squares, then IBG + RG",
        "healthy",
        (IDENTIFIED, IDENTIFIED_OUTPUT),
        twin=_identified,
        simulates=True,
    ),
    "ibg_rg_command": Source(
        "IBG + RG, command space", "healthy", (SURROGATE, COMMAND), twin=_command
    ),
    "fine_tuned": Source(
        "Fine-tuned on labels",
        "labelled",
        (SURROGATE, COMMAND, ("diagnosis", "ibg_rg_command")),
        diagnoser=_fine_tuned,
        network=True,
    ),
    "inversion": Source("Fault inversion", "healthy", (SURROGATE, COMMAND), diagnoser=_inversion),
    "inversion_cnn": Source(
        "Inversion with classifier", "healthy", pool=("inversion", "ibg_rg_command")
    ),
}
"""In the order in which they are reported."""


def lacking(source: Source, case: Case, plan: StudyPlan) -> str:
    """What keeps a study from having that source; empty where nothing does."""
    if case.diagnosed and source.simulates:
        return "a case without classes, where twins simulate"
    if not case.diagnosed and source.twin is None:
        return f"a case with classes to tell apart; {case.name!r} has none"
    if COMMAND in source.needs and case.correction == case.output_correction:
        return f"a case with a correction besides the one at its outputs; {case.name!r} has none"
    if source.diagnoser is _inversion and isinstance(case.density, SequenceMixture):
        return "a correction per movement"
    if source.parametric and case.parametric is None:
        return f"a case that says what is free in its twin; {case.name!r} does not"
    if source.network and plan.classifier_name == ROCKET:
        return "a classifier that is a network"
    if source.package and find_spec(source.package) is None:
        return f"the package {source.package}; install it: pip install 'retwin[bayes]'"
    return ""
