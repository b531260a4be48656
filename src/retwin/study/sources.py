"""Functions of a `Trial` that make the twin or the diagnoser of each source of the catalog.

A source is a row of the table in docs/theory.md, "How a study scores". `retwin.catalog.SOURCES`
declares which real data it may use, and which jobs it needs. Its answers are diagnoses where the
case has classes, else simulations of the test records.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

from retwin.cases.case import Case
from retwin.catalog import EXTRAS, SOURCES, SourceEntry
from retwin.data.trajectories import Trajectories
from retwin.diagnosis import DANN, FineTune, FittedDiagnoser, Rocket, fit_diagnoser, fit_inversion
from retwin.study.plan import StudyPlan
from retwin.study.trial import Trial
from retwin.twins.twin import Twin
from retwin.twins.wrappers.noisy import NoisyTwin, residual_scale
from retwin.twins.wrappers.randomised import RandomisedTwin
from retwin.update.corrected import CorrectedTwin
from retwin.update.dynamics import DynamicsTwin, state_names
from retwin.update.residual import ResidualModel, SequenceMixture


def recorded_twin(trial: Trial) -> FittedDiagnoser:
    """The classifier, trained on the recorded trajectories of the twin."""
    return trial.train(trial.twin_data)


def plain_twin(trial: Trial) -> Twin:
    """The twin itself."""
    return trial.case.twin


def randomised_twin(trial: Trial) -> Twin:
    """The twin with parameters drawn from the whole of their ranges."""
    return RandomisedTwin(trial.parametric)


def surrogate_alone(trial: Trial) -> Twin:
    """The IBG without a correction."""
    return trial.surrogate()


def noisy_surrogate(trial: Trial) -> Twin:
    """The IBG with white output noise of the residual's standard deviation."""
    healthy = trial.healthy
    scale = residual_scale(healthy)
    rate = trial.case.sensor_rate
    return NoisyTwin(trial.surrogate(), scale, sensor_rate=rate, emulated=healthy.emulated)


def updated(trial: Trial) -> Twin:
    """The twin, or the model without it, that the update of this source has made."""
    ((_, method),) = SOURCES[trial.job.name].needs
    return trial.updated(method)


def adversarial(trial: Trial) -> FittedDiagnoser:
    """A domain-adversarial network on the unlabelled calibration set."""
    return _adversarial(trial, trial.unlabelled)


def adversarial_transductive(trial: Trial) -> FittedDiagnoser:
    """A domain-adversarial network on the unlabelled test set."""
    return _adversarial(trial, trial.test_outputs)


def _adversarial(trial: Trial, target: Trajectories) -> FittedDiagnoser:
    classifier = trial.plan.classifier_config
    assert not isinstance(classifier, Rocket), "checked before the study begins"
    return fit_diagnoser(trial.twin_data, DANN(classifier), target=target, **trial.fitting)


def mean_corrected(trial: Trial) -> Twin:
    """The corrected twin with the mean of the RG instead of samples (Eq. 8)."""
    return replace(output_corrected(trial), random=False)


def output_corrected(trial: Trial) -> CorrectedTwin:
    """The corrected twin of the paper: delay and offset of the outputs."""
    return CorrectedTwin(trial.surrogate(), trial.residual("output"))


def command_corrected(trial: Trial) -> Twin:
    """The corrected twin in command space."""
    return CorrectedTwin(trial.surrogate(), trial.residual("command"))


def identified_corrected(trial: Trial) -> Twin:
    """The corrected twin on a surrogate of the identified twin."""
    return CorrectedTwin(trial.surrogate("pi_ls"), trial.residual("pi_ls"))


def fine_tuned(trial: Trial) -> FittedDiagnoser:
    """The network of `ibg_rg_command`, fine-tuned on labelled calibration trajectories."""
    base = trial.diagnoser("ibg_rg_command")
    made = trial.generate(command_corrected(trial))
    seed = trial.seed("fine-tuning")
    return fit_diagnoser(made, FineTune(base), target=trial.labelled, seed=seed)


def inversion(trial: Trial) -> FittedDiagnoser:
    """The Bayesian inversion of faults, without training of a classifier."""
    residual = trial.residual("command")
    assert isinstance(residual, ResidualModel), "checked before the study begins"
    case = trial.case
    return fit_inversion(trial.surrogate(), residual, trial.healthy, case.faults, twin=case.twin)


def inversion_dynamics(trial: Trial) -> FittedDiagnoser:
    """The inversion of faults by the filter of the corrected dynamics."""
    twin = trial.updated("dynamics")
    assert isinstance(twin, DynamicsTwin), "that is what the update makes"
    return fit_inversion(twin, None, None, trial.case.faults)


def lacking(name: str, case: Case, plan: StudyPlan) -> str:
    """What a study lacks for a source.

    Parameters
    ----------
    name : str
        A key of `retwin.catalog.SOURCES`.
    case : Case
        The system.
    plan : StudyPlan
        Its classifier must suit the source.

    Returns
    -------
    str
        The missing requirement; "" if there is none.

    """
    source: SourceEntry = SOURCES[name]
    if case.diagnosed and source.simulates:
        return "a case without classes, where twins simulate"
    if not case.diagnosed and not source.twin:
        return f"a case with classes; {case.name!r} has none"
    if ("residual", "command") in source.needs and case.correction == case.output_correction:
        return f"a case with a correction besides the one at its outputs; {case.name!r} has none"
    if name == "inversion" and isinstance(case.density, SequenceMixture):
        return "a correction per segment"
    learned = ("update", "dynamics") in source.needs
    if learned and case.diagnosed and not state_names(case.twin):
        return (
            f"a case without classes, or a twin that is a StateTwin; that of {case.name!r} is none"
        )
    if source.parametric and case.parametric is None:
        return f"a case that declares the free parameters of its twin; {case.name!r} does not"
    if source.network and isinstance(plan.classifier_config, Rocket):
        return "a classifier that is a network"
    return not_installed(source.extra)


def not_installed(extra: str) -> str:
    """The package that an extra lacks, with the command that installs it; "" if none."""
    package = EXTRAS[extra].module if extra else ""
    if package and find_spec(package) is None:
        return f"the package {package}; install it: pip install 'retwin[{extra}]'"
    return ""
