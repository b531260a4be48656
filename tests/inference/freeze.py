"""Writes `frozen.npz`: what the solvers of before the engine give on a small fixed set."""

from __future__ import annotations

import sys

import numpy as np
import torch
from arm_problems import FAULTS, FROZEN, HEALTHY, KNOWN, KnownResidual, context_of, polled

import retwin as rt
from retwin.diagnosis import evidence
from retwin.diagnosis.hypotheses import Hypotheses, healthy_belief, posed
from retwin.update.corrections import command_inference as old
from retwin.update.corrections import delay_offset
from retwin.update.corrections.command_problem import Problem

sys.path.insert(0, str(FROZEN.parents[1]))
from conftest import ExactArm  # noqa: E402


def diagonal(covariance: torch.Tensor) -> np.ndarray:
    return covariance.diagonal(dim1=-2, dim2=-1).numpy()


def command_space(arm, commands, observed) -> dict[str, np.ndarray]:
    context, mask = context_of(arm, commands, KNOWN), polled(len(commands))
    operator = rt.CommandSpace()
    found = operator.infer(context, observed, mask)
    problem = Problem(operator, context, observed, mask)
    x, missed = problem.nothing()
    x[..., 0] = problem.first_delays()
    start = x
    prior = old._Prior.first(problem, x)
    chance = missed
    for _ in range(old.ROUNDS):
        fit = old._solve(problem, x, missed, prior, old.STEPS)
        fit, missed, chance = old._find_missed(problem, fit, missed, prior)
        x = fit.x
        prior = prior.learned(problem, fit, missed)
    fit = old._solve(problem, start, missed, prior, old.STEPS)
    made = {f"prior_{name}": value.numpy() for name, value in vars(prior).items()}
    return {
        **{f"command_space_{name}": value for name, value in made.items()},
        "command_space_start": start.numpy(),
        "command_space_missed": missed.numpy(),
        "command_space_x": fit.x.numpy(),
        "command_space_objective": fit.energy.numpy(),
        "command_space_variance": diagonal(fit.covariance()),
        "command_space_evidence": fit.evidence().numpy(),
        "command_space_z": found.z.numpy(),
        "command_space_z_variance": diagonal(found.covariance),
        "command_space_severity": found.severity.numpy(),
        "command_space_identified": found.identified.numpy(),
    }


def delays_and_offsets(arm, commands, observed) -> dict[str, np.ndarray]:
    context = context_of(arm, commands, KNOWN)
    mask = torch.ones(observed.shape, dtype=torch.bool)
    operator = rt.DelayOffset()
    found = operator.infer(context, observed, mask)
    unit = context.unit.double()
    model = delay_offset._Model(context.segments, context.path / unit, observed / unit, mask)
    z = torch.zeros_like(found.z)
    z[..., 1:] = model.settled_offset(operator.delay_range[1])
    z[..., 0] = operator._best_delay(model, z)
    moving = delay_offset._moving(context.segments, z[..., 0])
    noise = model.scale(model.residual(found.z), moving)
    nats = delay_offset.TUKEY**2 / 6
    return {
        "delay_offset_z": found.z.numpy(),
        "delay_offset_variance": diagonal(found.covariance),
        "delay_offset_identified": found.identified.numpy(),
        "delay_offset_noise": found.noise.numpy(),
        "delay_offset_first_delay": z[..., 0].numpy(),
        "delay_offset_scale": torch.stack(
            [torch.where(moving == m, noise, 0.0).amax(dim=1) for m in (False, True)], dim=1
        ).numpy(),
        "delay_offset_objective": (nats * model.cost(found.z, noise)).numpy(),
    }


def inversion(arm, case, commands, observed) -> dict[str, np.ndarray]:
    residual, mask = KnownResidual(), polled(len(commands))
    context = context_of(arm, commands)
    healthy = slice(0, HEALTHY)
    problem = posed(residual, context[healthy], observed[healthy], mask[healthy])
    belief = healthy_belief(residual, context[healthy])
    x = belief.mean.unflatten(1, (context.segments.most, -1))
    noise = evidence.Noise.first(problem.residual(x, torch.zeros_like(x[..., 1:])), problem)
    each = torch.arange(HEALTHY)
    for _ in range(5):
        fit, _ = evidence.best_pattern(problem, x, belief, noise, each)
        x, noise = fit.x, noise.learned(problem, fit)
    made = {"inversion_scale": noise.scale.numpy(), "inversion_thinning": noise.thinning.numpy()}
    for name, faults in (("known", case.faults), ("open", case.with_random_onset().faults)):
        rows = Hypotheses.of(tuple(faults.values()), residual, context, observed, mask)
        start, nothing = rows.start(), torch.zeros_like(rows.start()[..., 1:])
        if name == "known":
            fit = evidence.solve(rows.problem, start, nothing, rows.belief, noise)
            energy = evidence._energy(rows.problem, fit.x, nothing, rows.belief, noise)
            made |= {
                "inversion_x": fit.x.numpy(),
                "inversion_objective": energy.numpy(),
                "inversion_variance": diagonal(fit.covariance),
                "inversion_plain_evidence": fit.evidence.numpy(),
            }
        found = rows.inverted(noise)
        made |= {
            f"inversion_{name}_evidence": found.evidence.numpy(),
            f"inversion_{name}_level": found.level.numpy(),
            f"inversion_{name}_level_deviation": found.doubt.numpy(),
            f"inversion_{name}_bias": found.bias.numpy(),
            f"inversion_{name}_onset": found.onsets.best.numpy(),
        }
    return made


def main() -> None:
    case, arm = rt.cases.armpi(), ExactArm()
    commands = case.sampler.sample(len(FAULTS), rng=np.random.default_rng(17))
    recorded = case.emulator.simulate(commands, faults=FAULTS, seed=5)
    observed = torch.as_tensor(recorded.observed.copy())
    made = {"commands": commands.astype(np.float32), "observed": recorded.observed}
    with torch.no_grad():
        made |= command_space(arm, commands, observed)
        made |= delays_and_offsets(arm, commands, observed)
        made |= inversion(arm, case, commands, observed)
    np.savez_compressed(FROZEN, **made)


if __name__ == "__main__":
    main()
