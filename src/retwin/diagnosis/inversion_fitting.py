"""`fit_inversion`: what a diagnosis by physics learns from healthy trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import compress
from typing import overload

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import t as student
from torch import Tensor

from retwin.checks import finite, instance, require
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.diagnosis.estimate import Calibration
from retwin.diagnosis.hypotheses import Hypotheses, checked
from retwin.diagnosis.inversion import InversionDiagnoser, invert
from retwin.diagnosis.latent_prior import command_problem, healthy_prior
from retwin.diagnosis.missed_segments import fitted_noise
from retwin.diagnosis.samples import DiagnosisInputs
from retwin.diagnosis.state_inversion import StateInversionDiagnoser
from retwin.errors import InputError
from retwin.inference.noise import Noise
from retwin.twins.faults import Fault
from retwin.twins.twin import Twin
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Context
from retwin.update.corrections.command_problem import CommandProblem
from retwin.update.dynamics import DynamicsTwin, state_names
from retwin.update.exact import exact_surrogate
from retwin.update.residual import Residual, ResidualModel
from retwin.update.surrogate import Surrogate
from retwin.update.surrogate_error import surrogate_variance

ERRORS = (3.0, 4.0)
"""Errors of the outputs, over those in calibration, up to which no trajectory is called unknown,
since calibration trajectories are explained better than others; and from which on each is."""
ROUNDS = 5
"""Rounds of expectation-maximisation of the noise."""


@overload
def fit_inversion(
    surrogate: DynamicsTwin,
    residual: None,
    calibration: Trajectories | None,
    faults: Mapping[str, Fault | None],
) -> StateInversionDiagnoser: ...


@overload
def fit_inversion(
    surrogate: Surrogate | Twin,
    residual: Residual,
    calibration: Trajectories,
    faults: Mapping[str, Fault | None],
    *,
    twin: Twin | None = None,
    false_rate: float = 0.01,
) -> InversionDiagnoser: ...


@torch.no_grad()
def fit_inversion(
    surrogate: Surrogate | Twin,
    residual: Residual | None,
    calibration: Trajectories | None,
    faults: Mapping[str, Fault | None],
    *,
    twin: Twin | None = None,
    false_rate: float = 0.01,
) -> InversionDiagnoser | StateInversionDiagnoser:
    """A diagnoser by physics: at most its noise is learned, from healthy trajectories.

    Parameters
    ----------
    surrogate : Surrogate or Twin
        Of the updated twin, or a twin in its place (see `ExactSurrogate`), with which the diagnoser
        cannot be saved. A `DynamicsTwin` is everything that its inversion needs.
    residual : Residual or None
        Of the updated twin, a `ResidualModel` with `CommandSpace`; None with a `DynamicsTwin`.
    calibration : Trajectories or None
        Those that the residual model was fitted to; the healthy ones are used. None with a
        `DynamicsTwin`, which has learned its noise.
    faults : mapping of str to Fault or None
        Class name to fault, as a case has them: of actuators, or, with a `DynamicsTwin`, of
        parameters, sensors and actuators (`retwin.twins.ParameterShift` and others).
    twin : Twin, optional
        The twin that the surrogate was trained on. It simulates the commands, and what the
        surrogate errs there makes diagnoses less certain; without it, what the surrogate erred on
        held-out simulations.
    false_rate : float, default 0.01
        The largest share of healthy trajectories that is to be called unknown, from 0.001 to 0.5.
        It holds for trajectories that the corrected twin simulates, and for those of the machine as
        far as the calibration trajectories show it: fewer than 1/false_rate - 1 cannot.

    Raises
    ------
    InputError
        There is no healthy trajectory, and whatever `InversionDiagnoser` or
        `StateInversionDiagnoser` refuses.

    """
    finite("false_rate", false_rate, least=0.001, most=0.5)
    if isinstance(surrogate, DynamicsTwin):
        require(
            residual is None,
            "residual",
            expected="None, since corrected dynamics have a distribution",
            got=type(residual).__name__,
            remedy="leave it out",
        )
        return StateInversionDiagnoser(surrogate, faults)
    if not isinstance(residual, ResidualModel):
        raise InputError(
            "residual",
            expected="a residual model with one z per segment",
            got=type(residual).__name__,
            remedy="give fit_dynamics(twin, calibration).twin as the surrogate, which needs none"
            if state_names(surrogate)
            else "fit it with CommandSpace",
        )
    faults = checked(faults)  # before the noise is fitted, which takes a minute
    remedy = "give those that the residual model was fitted to"
    calibration = instance("calibration", calibration, Trajectories, remedy=remedy)
    healthy = calibration.with_label(HEALTHY)
    require(
        len(healthy),
        "calibration",
        expected=f"at least one trajectory labelled {HEALTHY!r}",
        got=f"labels {sorted(calibration.known_labels) or 'none'}",
        remedy="label healthy trajectories",
    )
    surrogate = exact_surrogate(surrogate)
    given = DiagnosisInputs.of(surrogate, residual, healthy)
    segments = given.context.segments
    found = surrogate_variance(surrogate, twin, healthy.commands, segments)
    variance = (
        torch.zeros(len(residual.outputs)) if found is None else found[segments.valid].mean(0)
    )
    context, observed, mask = given.with_error(variance)[:]
    problem = command_problem(residual, context, observed, mask)
    noise = fitted_noise(problem, healthy_prior(residual, context), rounds=ROUNDS)
    seen = healthy.mask.any(axis=0).any(axis=0).tolist()
    outputs = tuple(compress(healthy.outputs.names, seen))
    each, worse = _explained(residual, noise, context, observed, mask)
    made = CorrectedTwin(surrogate, residual).simulate(
        np.resize(healthy.commands, (round(1 / false_rate) - 1, *healthy.commands.shape[1:])),
        seed=0,
    )
    simulated = DiagnosisInputs.of(surrogate, residual, made).with_error(variance)
    return InversionDiagnoser(
        surrogate,
        residual,
        faults,
        noise=noise,
        surrogate_variance=variance,
        bound=min(
            float(_explained(residual, noise, *simulated[:])[0].min()),
            max(lower_bound(each, false_rate), float(worse[1].mean())),
            float(worse[0].mean()),
        ),
        calibration=Calibration(len(healthy), false_rate, outputs),
    )


def _explained(
    residual: ResidualModel, noise: Noise, context: Context, observed: Tensor, mask: Tensor
) -> tuple[NDArray, list[NDArray]]:
    """Evidence per sample (n,) of healthy trajectories; and if errors were `ERRORS` times as large.

    Both state how well the healthy class explains the outputs, the second whatever their number.
    """
    rows = Hypotheses.of((None,), residual, context, observed, mask)
    known = invert(rows, noise)
    problem = rows.problem.with_missed(known.fit.missed)
    errors = problem.residual(known.fit.x)
    each = [known.evidence - _loss(noise, problem, factor * errors) for factor in (1.0, *ERRORS)]
    samples = mask.any(dim=2).sum(dim=1).clamp_min(1)
    lost = [(own - each[0] + known.evidence) / samples for own in each]
    return lost[0].numpy(), [own.numpy() for own in lost[1:]]


def _loss(noise: Noise, problem: CommandProblem, errors: Tensor) -> Tensor:
    return noise.misfit(problem, errors).sum(dim=1)


def lower_bound(values: NDArray, false_rate: float = 0.01) -> float:
    """What a further value is below with a probability of `false_rate`, from n normal ones.

    Minus infinity for a single one, which has no spread.
    """
    count = len(values)
    if count < 2:
        return -np.inf
    spread = np.std(values, ddof=1) * np.sqrt(1 + 1 / count)
    return float(np.mean(values) - student.ppf(1 - false_rate, count - 1) * spread)
