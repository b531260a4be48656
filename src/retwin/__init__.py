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

from retwin._lazy import names, read_stub
from retwin._version import __version__

# The stub beside this file lists the public names. The module of a name is imported when the name
# is first used: `import retwin` loads no torch.
_LISTED = read_stub(__loader__.get_data(f"{__file__}i").decode())
_HOME = {n: m.removeprefix("retwin.") for n, m in sorted(_LISTED.items()) if m.count(".")}
_ROOMS = tuple(sorted(_LISTED.keys() - _HOME.keys()))

__all__ = ["__version__", *_ROOMS, *_HOME]
__getattr__, __dir__, _ = names("retwin", _HOME)
