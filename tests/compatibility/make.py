"""Make the artefacts of `v0_1_development` with the development version before the renaming.

They were made with commit 2b97c6e, whose modules and names this script uses; it does not run with
the present version. From the root of the repository:

    git worktree add --detach OLD 2b97c6e
    PYTHONPATH=OLD/src python tests/compatibility/make.py

The data come from `plant_of_case.py` with a delay, an offset and noise. `outputs.npz` holds what
the models answered then.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from retwin.bundle.bundle import Bundle
from retwin.bundle.guard import fit_guard
from retwin.corrections import Additive
from retwin.networks import LSTM, TCN, LSTMClassifier, StateSpace
from retwin.residual import Flow, Refinement, SequenceMixture
from retwin.scale import SimulationPlan, simulate_to
from retwin.training import Training
from retwin.updating import MCMC, identify_bayes

import retwin as rt

HERE = Path(__file__).parent / "v0_1_development"
BRIEF = Training(epochs=20, batch=32, rate=1e-2)
PLAN = rt.StudyPlan(sources=("dt", "ibg_rg"), runs=1, per_class=6, folds=2, seed=3)


def measured(case: rt.Case, per_class: int, seed: int) -> rt.Trajectories:
    """Outputs of the plant 2 samples late, with an offset, read every 5 samples with noise."""
    made = rt.generate(case.twin, case, per_class=per_class, seed=seed)
    rng = np.random.default_rng(seed)
    late = np.roll(made.observed, 2, axis=1)
    late[:, :2] = late[:, 2:3]
    offset = 0.05 + 0.02 * rng.normal(size=(len(made), 1, 3))
    grid = np.arange(0, made.observed.shape[1], 5)
    read = (late + offset)[:, grid] + 0.01 * rng.normal(size=(len(made), len(grid), 3))
    time = np.arange(made.observed.shape[1])
    joined = [[np.interp(time, grid, row[:, k]) for k in range(3)] for row in read]
    return made.replace(observed=np.array(joined, np.float32).transpose(0, 2, 1))


def models(case: rt.Case) -> None:
    """Fit, save and run every kind of model."""
    real = measured(case, 6, 1)
    rt.save(real, HERE / "set.npz")
    rt.save(real[:2], HERE / "set.zarr")
    commands = real.commands[:3]
    training = rt.generate(case.twin, case, per_class=40, seed=0)
    surrogate = rt.fit_surrogate(training, case.network, seed=0, training=case.training)
    surrogate.save(HERE / "surrogate")
    answers = {"commands": commands, "surrogate": surrogate.predict(commands)}

    for network in (LSTM(4), TCN(4, levels=2), StateSpace(states=2, hidden=4)):
        name = type(network).__name__.lower()
        few = training[::8]
        made = rt.fit_surrogate(few, network, seed=0, training=Training(1, 32, 1e-2))
        made.save(HERE / name)
        answers[name] = made.predict(commands)

    refinement = Refinement(draws=4, training=Training(epochs=2, batch=8))
    flow = Flow(transforms=1, bins=4, hidden=(8,), training=BRIEF, refinement=refinement)
    residuals = {
        "delay_offset": (case.output_correction, case.density),
        "command_space": (case.correction, case.density),
        "flow": (case.output_correction, flow),
        "sequence": (Additive(), SequenceMixture(
            network=LSTM(8), features=4, components=1, members=2, window=60, burn_in=10,
            training=Training(epochs=3, batch=6, rate=5e-3),
        )),
    }  # fmt: skip
    fitted = {}
    for name, (correction, density) in residuals.items():
        fitted[name] = rt.fit_residual(surrogate, real, correction, density, seed=0)
        for random in (True, False):
            twin = rt.CorrectedTwin(surrogate, fitted[name], case=case.name, random=random)
            kind = "random" if random else "mean"
            answers[f"{name}/{kind}"] = twin.simulate(commands, seed=5).observed
        rt.CorrectedTwin(surrogate, fitted[name], case=case.name).save(HERE / name)

    twin = rt.CorrectedTwin(surrogate, fitted["command_space"], case=case.name)
    made = rt.generate(twin, case, per_class=20, seed=2)
    diagnosers = {
        "cnn": rt.fit_diagnoser(
            made, rt.CNN(channels=(8, 8)), seed=0, classes=case.classes, rate=10, training=BRIEF
        ),
        "lstm_classifier": rt.fit_diagnoser(
            made, LSTMClassifier(4, 1), seed=0, classes=case.classes, rate=10, training=BRIEF
        ),
        "inversion": rt.fit_inversion(surrogate, fitted["command_space"], real, case.faults),
        "rocket": rt.fit_rocket(made, seed=0, classes=case.classes, rate=10, kernels=84),
    }
    for name, diagnoser in diagnosers.items():
        diagnoser.save(HERE / name)
        answers[name] = diagnoser.predict_proba(real)
        answers[f"{name}/classes"] = np.array(diagnoser.classes)

    guard = fit_guard(twin, case, real, seed=0, count=90, training=BRIEF)
    bundle = Bundle.of(case, twin, guard, diagnosers["cnn"], data=[real], notes={"seed": 0})
    bundle.save(HERE / "bundle")
    prediction = bundle.predict(real)
    answers["bundle"] = prediction.probabilities
    answers["bundle/generated"] = bundle.generate(per_class=1, seed=3).observed

    healthy = real.with_label("Healthy")
    posterior = identify_bayes(case.parametric, healthy, seed=0, method=MCMC(12, 40, 20, 1))
    posterior.twin.save(HERE / "posterior")
    answers["posterior"] = posterior.twin.simulate(commands, seed=5).observed
    np.savez_compressed(HERE / "outputs.npz", **answers)


def finished(case: rt.Case) -> None:
    """A study, without its working folder, and a simulation."""
    rt.run_study(case, PLAN, rt.StudyData(real=HERE / "set.npz"), HERE / "study", processes=1)
    shutil.rmtree(HERE / "study" / "work")
    file = HERE / "study" / "results.json"
    results = json.loads(file.read_text("utf-8"))
    results["provenance"]["machine"] = "Linux"
    file.write_text(json.dumps(results, indent=1), encoding="utf-8")
    plan = SimulationPlan(case.twin, case.sampler, seed=5, n=4, faults=case.faults, chunk=4)
    simulate_to(HERE / "simulated.zarr", plan, workers=1)


if __name__ == "__main__":
    for item in HERE.iterdir():
        if item.name not in ("plant_of_case.py", "case.toml"):
            shutil.rmtree(item) if item.is_dir() else item.unlink()
    toy = rt.cases.get(str(HERE / "case.toml"))
    models(toy)
    finished(toy)
