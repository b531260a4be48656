"""retwin updates digital twins so that they behave like the real machine.

Only the real machine's outputs need to be measured. Five nouns, a verb each: `Trajectories`
(`load`, `save`), `Twin` (`simulate`), `Surrogate` (`fit_surrogate`), `ResidualModel` with its
`Correction` (`fit_residual`), `Diagnoser` (`fit_diagnoser`).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Name to module, loaded when first asked for: `import retwin` must not wait for torch.
_HOME = {
    "Additive": "corrections",
    "ArmPiTwin": "twins.armpi",
    "CNN": "networks",
    "Case": "case",
    "Chain": "corrections",
    "Channels": "trajectories",
    "CommandSpace": "corrections",
    "Context": "corrections",
    "CorrectedTwin": "corrected",
    "Correction": "corrections",
    "DelayOffset": "corrections",
    "Diagnoser": "diagnosis",
    "Discrepancy": "corrections",
    "FMUTwin": "twins.fmu",
    "Fault": "faults",
    "Fidelity": "fidelity",
    "Flow": "residual",
    "FunctionTwin": "twins.function",
    "InputError": "errors",
    "InversionDiagnoser": "diagnosis",
    "KinematicTwin": "twins.kinematic",
    "LSTM": "networks",
    "LSTMClassifier": "networks",
    "Limits": "twins.protocol",
    "MLP": "networks",
    "Mixture": "residual",
    "MuJoCoTwin": "twins.mujoco",
    "NetworkDiagnoser": "diagnosis",
    "NoisyTwin": "twins.noisy",
    "Parameter": "twins.parametric",
    "ParametricTwin": "twins.parametric",
    "PooledDiagnoser": "diagnosis",
    "RandomisedTwin": "twins.randomised",
    "Refinement": "residual",
    "ResidualModel": "residual",
    "SampledSensor": "corrections",
    "Scores": "statistics",
    "Segments": "segments",
    "SequenceMixture": "residual",
    "SequenceResidual": "residual",
    "SimulationError": "twins.protocol",
    "SimulationPlan": "scale",
    "StateSpace": "networks",
    "SteadyStateError": "faults",
    "Stuck": "faults",
    "StudyData": "study",
    "StudyPlan": "study",
    "Surrogate": "surrogate",
    "TCN": "networks",
    "Training": "training",
    "Trajectories": "trajectories",
    "Twin": "twins.protocol",
    "animate": "animation",
    "evaluate": "statistics",
    "fetch": "download",
    "fine_tune": "diagnosis",
    "fit_dann": "diagnosis",
    "fit_diagnoser": "diagnosis",
    "fit_inversion": "diagnosis",
    "fit_residual": "residual",
    "fit_rocket": "diagnosis",
    "fit_surrogate": "surrogate",
    "generate": "corrected",
    "identify": "updating",
    "identify_bayes": "updating",
    "infer_discrepancy": "residual",
    "load": "storage",
    "load_diagnoser": "diagnosis",
    "measure_fidelity": "fidelity",
    "measure_widening": "fidelity",
    "run_study": "study",
    "save": "storage",
    "simulate_to": "scale",
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
    from retwin.animation import animate
    from retwin.case import Case
    from retwin.corrected import CorrectedTwin, generate
    from retwin.corrections import (
        Additive,
        Chain,
        CommandSpace,
        Context,
        Correction,
        DelayOffset,
        Discrepancy,
        SampledSensor,
    )
    from retwin.diagnosis import (
        Diagnoser,
        InversionDiagnoser,
        NetworkDiagnoser,
        PooledDiagnoser,
        fine_tune,
        fit_dann,
        fit_diagnoser,
        fit_inversion,
        fit_rocket,
        load_diagnoser,
    )
    from retwin.download import fetch
    from retwin.errors import InputError
    from retwin.faults import Fault, SteadyStateError, Stuck
    from retwin.fidelity import Fidelity, measure_fidelity, measure_widening
    from retwin.networks import CNN, LSTM, MLP, TCN, LSTMClassifier, StateSpace
    from retwin.report import write_report
    from retwin.residual import (
        Flow,
        Mixture,
        Refinement,
        ResidualModel,
        SequenceMixture,
        SequenceResidual,
        fit_residual,
        infer_discrepancy,
    )
    from retwin.scale import SimulationPlan, simulate_to
    from retwin.segments import Segments
    from retwin.statistics import Scores, evaluate
    from retwin.storage import load, save
    from retwin.study import StudyData, StudyPlan, run_study
    from retwin.surrogate import Surrogate, fit_surrogate
    from retwin.training import Training
    from retwin.trajectories import Channels, Trajectories
    from retwin.twins.armpi import ArmPiTwin
    from retwin.twins.fmu import FMUTwin
    from retwin.twins.function import FunctionTwin
    from retwin.twins.kinematic import KinematicTwin
    from retwin.twins.mujoco import MuJoCoTwin
    from retwin.twins.noisy import NoisyTwin
    from retwin.twins.parametric import Parameter, ParametricTwin
    from retwin.twins.protocol import Limits, SimulationError, Twin
    from retwin.twins.randomised import RandomisedTwin
    from retwin.updating import identify, identify_bayes
