"""retwin updates digital twins so that they behave like the real machine.

Only the real machine's outputs need to be measured. Five nouns, a verb each: `Trajectories`
(`load`, `save`), `Twin` (`simulate`), `Surrogate` (`fit_surrogate`), `ResidualModel` with its
`Correction` (`fit_residual`), `Diagnoser` (`fit_diagnoser`).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from retwin._version import __version__

# Name to module, loaded when first asked for: `import retwin` must not wait for torch.
_HOME = {
    "Additive": "update.corrections",
    "ArmPiTwin": "cases.armpi_fpv.twin",
    "CNN": "nets.networks",
    "Case": "cases.case",
    "Chain": "update.corrections",
    "Channels": "data.trajectories",
    "CommandSpace": "update.corrections",
    "Context": "update.corrections",
    "CorrectedTwin": "update.corrected",
    "Correction": "update.corrections",
    "DANN": "diagnosis",
    "DelayOffset": "update.corrections",
    "Diagnoser": "diagnosis",
    "Discrepancy": "update.corrections",
    "FMUTwin": "twins.fmu",
    "Fault": "twins.faults",
    "Fidelity": "evaluation.fidelity",
    "FineTune": "diagnosis",
    "Flow": "update.residual",
    "FunctionTwin": "twins.function",
    "InputError": "errors",
    "InversionDiagnoser": "diagnosis",
    "KinematicTwin": "cases.armpi_fpv.closed_form",
    "LSTM": "nets.networks",
    "LSTMClassifier": "nets.networks",
    "Limits": "twins.twin",
    "MLP": "nets.networks",
    "Mixture": "update.residual",
    "MuJoCoTwin": "twins.mujoco",
    "NetworkDiagnoser": "diagnosis",
    "NoisyTwin": "twins.noisy",
    "Parameter": "twins.parametric",
    "ParametricTwin": "twins.parametric",
    "PooledDiagnoser": "diagnosis",
    "RandomisedTwin": "twins.randomised",
    "Refinement": "update.residual",
    "ResidualModel": "update.residual",
    "Rocket": "diagnosis",
    "SampledSensor": "update.corrections",
    "Scores": "scores.classification",
    "Segments": "data.segments",
    "SequenceMixture": "update.residual",
    "SequenceResidual": "update.residual",
    "SimulationError": "twins.twin",
    "SimulationPlan": "deploy.simulations",
    "StateSpace": "nets.networks",
    "ActuatorBias": "twins.faults",
    "Stuck": "twins.faults",
    "StudyData": "study",
    "StudyPlan": "study",
    "Surrogate": "update.surrogate",
    "TCN": "nets.networks",
    "Training": "nets.training",
    "Trajectories": "data.trajectories",
    "Twin": "twins.twin",
    "animate": "cases.animation",
    "evaluate": "evaluation.evaluate",
    "fetch": "data.download",
    "fit_diagnoser": "diagnosis",
    "fit_inversion": "diagnosis",
    "fit_residual": "update.residual",
    "fit_surrogate": "update.surrogate",
    "generate": "update.corrected",
    "identify": "update.identification",
    "infer_discrepancy": "update.residual",
    "load": "data.io",
    "load_diagnoser": "diagnosis",
    "measure_fidelity": "evaluation.fidelity",
    "measure_widening": "evaluation.fidelity",
    "run_study": "study",
    "save": "data.io",
    "simulate_to": "deploy.simulations",
    "write_report": "report",
}

# Modules of which users take several things.
_MODULES = ("cases", "testing", "twins")

__all__ = ["__version__", *_MODULES, *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"retwin.{name}")
    if name in _HOME:
        return getattr(importlib.import_module(f"retwin.{_HOME[name]}"), name)
    raise AttributeError(f"module 'retwin' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if TYPE_CHECKING:
    from retwin import cases, testing, twins
    from retwin.cases.animation import animate
    from retwin.cases.armpi_fpv.closed_form import KinematicTwin
    from retwin.cases.armpi_fpv.twin import ArmPiTwin
    from retwin.cases.case import Case
    from retwin.data.download import fetch
    from retwin.data.io import load, save
    from retwin.data.segments import Segments
    from retwin.data.trajectories import Channels, Trajectories
    from retwin.deploy.simulations import SimulationPlan, simulate_to
    from retwin.diagnosis import (
        DANN,
        Diagnoser,
        FineTune,
        InversionDiagnoser,
        NetworkDiagnoser,
        PooledDiagnoser,
        Rocket,
        fit_diagnoser,
        fit_inversion,
        load_diagnoser,
    )
    from retwin.errors import InputError
    from retwin.evaluation.evaluate import evaluate
    from retwin.evaluation.fidelity import Fidelity, measure_fidelity, measure_widening
    from retwin.nets.networks import CNN, LSTM, MLP, TCN, LSTMClassifier, StateSpace
    from retwin.nets.training import Training
    from retwin.report import write_report
    from retwin.scores.classification import Scores
    from retwin.study import StudyData, StudyPlan, run_study
    from retwin.twins.faults import ActuatorBias, Fault, Stuck
    from retwin.twins.fmu import FMUTwin
    from retwin.twins.function import FunctionTwin
    from retwin.twins.limits import Limits
    from retwin.twins.mujoco import MuJoCoTwin
    from retwin.twins.noisy import NoisyTwin
    from retwin.twins.parametric import Parameter, ParametricTwin
    from retwin.twins.randomised import RandomisedTwin
    from retwin.twins.twin import SimulationError, Twin
    from retwin.update.corrected import CorrectedTwin, generate
    from retwin.update.corrections import (
        Additive,
        Chain,
        CommandSpace,
        Context,
        Correction,
        DelayOffset,
        Discrepancy,
        SampledSensor,
    )
    from retwin.update.identification import identify
    from retwin.update.residual import (
        Flow,
        Mixture,
        Refinement,
        ResidualModel,
        SequenceMixture,
        SequenceResidual,
        fit_residual,
        infer_discrepancy,
    )
    from retwin.update.surrogate import Surrogate, fit_surrogate
