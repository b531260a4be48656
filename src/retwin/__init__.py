"""retwin updates digital twins so that they behave like the real machine.

Only the real machine's outputs need to be measured. Five nouns, each with its verbs:

| noun | is | verb |
|---|---|---|
| `Trajectories` | commands and outputs of many runs | `load`, `save`, `fetch` |
| `Twin` (a protocol) | a simulator | `simulate`, `generate`, `identify` |
| `Surrogate` | a neural network that replaces a twin | `fit_surrogate` |
| `ResidualModel` with its `Correction` | the distribution of the discrepancy | `fit_residual` |
| `Diagnoser` (a protocol) | class probabilities of trajectories | `fit_diagnoser`, `evaluate` |

`CorrectedTwin` is a surrogate with its residual model, and a `Twin` again:

    import retwin as rt

    case = rt.cases.armpi()
    simulated = rt.generate(case.twin, case, per_class=12, seed=0)
    real = rt.generate(case.emulator, case, per_class=10, seed=1)  # or rt.load("real.npz")
    calibration, test = real.split(0.6, seed=0)
    surrogate = rt.fit_surrogate(simulated, rt.MLP(), seed=0)
    residual = rt.fit_residual(surrogate, calibration, rt.DelayOffset(), rt.Mixture(), seed=0)
    twin = rt.CorrectedTwin(surrogate, residual, case=case.name)
    diagnoser = rt.fit_diagnoser(rt.generate(twin, case, per_class=40, seed=1), rt.CNN(), seed=0)
    print(rt.evaluate(diagnoser, test))

A verb takes its method as a config object: `fit_surrogate` a network (`MLP`, `LSTM`, `TCN`,
`StateSpace`), `fit_residual` a correction (`Additive`, `Chain`, `CommandSpace`, `DelayOffset`,
`SampledSensor`) and a density (`Flow`, `Mixture`, `SequenceMixture`), `fit_diagnoser` a classifier
(`CNN`, `LSTMClassifier`, `Rocket`, `DANN`, `FineTune`), `identify` a method of `rt.update`
(`LeastSquares`, `Evolution`, `MCMC`, `NPE`). `Training` has the epochs, the batch size and the
learning rate.

What fewer users need is in its room, a package of its own that `rt.<room>` imports on first use,
as in `rt.twins.HoldSampler` or `from retwin.deploy import Bundle`:

| room | holds |
|---|---|
| `rt.data` | trajectories, segments, file formats, downloads |
| `rt.scores` | pure functions of arrays that score predictions and simulations |
| `rt.twins` | the kinds of twins, faults, command samplers, limits |
| `rt.nets` | networks, their training, mixtures and flows |
| `rt.update` | surrogate, corrections, residual models, corrected twin, identification |
| `rt.diagnosis` | the kinds of diagnosers |
| `rt.evaluation` | scores of diagnosers, fidelity of twins |
| `rt.cases` | the built-in systems, and case.toml |
| `rt.study` | comparison of sources over runs |
| `rt.report` | the report of a study |
| `rt.deploy` | bundles, ONNX, large simulations |
| `rt.monitor` | alarms beside the running machine, with a promised rate of false ones |
| `rt.testing` | contract suites for twins, corrections and diagnosers of your own |
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from retwin._lazy import homes, names
from retwin._version import __version__

# Name to module, which is imported when the name is first used: `import retwin` loads no torch.
_HOME = homes(
    {
        "cases.case": "Case",
        "data.download": "fetch",
        "data.io": "load save",
        "data.segments": "Segments",
        "data.trajectories": "Channels Trajectories",
        "deploy.actuator.export": "export_actuator",
        "diagnosis": "DANN Diagnoser FineTune NetworkDiagnoser Rocket fit_diagnoser fit_inversion "
        "load_diagnoser",
        "errors": "InputError",
        "evaluation": "Choice fit score_model",
        "evaluation.diagnosers": "evaluate",
        "evaluation.experiments.propose": "next_experiments",
        "evaluation.fidelity.measure": "measure_fidelity",
        "nets.networks": "CNN LSTM LSTMClassifier MLP StateSpace TCN",
        "nets.training": "Training",
        "report": "write_report",
        "study": "StudyData StudyPlan run_study",
        "twins.collected": "SimulationError",
        "twins.faults.actuator_faults": "ActuatorBias Fault Stuck",
        "twins.fmu.twin": "FMUTwin",
        "twins.function": "FunctionTwin",
        "twins.limits": "Limits",
        "twins.mujoco.twin": "MuJoCoTwin",
        "twins.wrappers.parametric": "Parameter ParametricTwin",
        "twins.twin": "Twin",
        "update.corrected": "CorrectedTwin generate",
        "update.corrections": "Additive Chain CommandSpace Context Correction DelayOffset "
        "Discrepancy SampledSensor",
        "update.identification": "identify",
        "update.loading": "load_twin",
        "update.residual": "Flow Mixture Refinement ResidualModel SequenceMixture fit_residual "
        "infer_discrepancy",
        "update.surrogate": "Surrogate fit_surrogate",
    }
)

# The rooms that users reach as `rt.<room>`.
_ROOMS = tuple(
    homes(
        {
            "": "cases data deploy diagnosis evaluation monitor nets report scores study testing "
            "twins update"
        }
    )
)

__all__ = ["__version__", *_ROOMS, *_HOME]
__getattr__, __dir__, _ = names("retwin", _HOME)

if TYPE_CHECKING:
    from retwin import (
        cases,
        data,
        deploy,
        diagnosis,
        evaluation,
        monitor,
        nets,
        report,
        scores,
        study,
        testing,
        twins,
        update,
    )
    from retwin.cases.case import Case
    from retwin.data.download import fetch
    from retwin.data.io import load, save
    from retwin.data.segments import Segments
    from retwin.data.trajectories import Channels, Trajectories
    from retwin.deploy.actuator.export import export_actuator
    from retwin.diagnosis import (
        DANN,
        Diagnoser,
        FineTune,
        NetworkDiagnoser,
        Rocket,
        fit_diagnoser,
        fit_inversion,
        load_diagnoser,
    )
    from retwin.errors import InputError
    from retwin.evaluation import Choice, fit, score_model
    from retwin.evaluation.diagnosers import evaluate
    from retwin.evaluation.experiments.propose import next_experiments
    from retwin.evaluation.fidelity.measure import measure_fidelity
    from retwin.nets.networks import CNN, LSTM, MLP, TCN, LSTMClassifier, StateSpace
    from retwin.nets.training import Training
    from retwin.report import write_report
    from retwin.study import StudyData, StudyPlan, run_study
    from retwin.twins.collected import SimulationError
    from retwin.twins.faults.actuator_faults import ActuatorBias, Fault, Stuck
    from retwin.twins.fmu.twin import FMUTwin
    from retwin.twins.function import FunctionTwin
    from retwin.twins.limits import Limits
    from retwin.twins.mujoco.twin import MuJoCoTwin
    from retwin.twins.twin import Twin
    from retwin.twins.wrappers.parametric import Parameter, ParametricTwin
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
    from retwin.update.identification import (
        identify,
    )
    from retwin.update.loading import load_twin
    from retwin.update.residual import (
        Flow,
        Mixture,
        Refinement,
        ResidualModel,
        SequenceMixture,
        fit_residual,
        infer_discrepancy,
    )
    from retwin.update.surrogate import Surrogate, fit_surrogate
