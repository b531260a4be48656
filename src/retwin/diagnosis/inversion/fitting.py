"""`fit_inversion`: what a diagnosis by physics learns from healthy trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from retwin.diagnosis.inversion.hypotheses import Hypotheses, checked
from retwin.diagnosis.inversion.latent_prior import command_problem, healthy_prior
from retwin.diagnosis.inversion.missed_segments import fitted_noise
from retwin.diagnosis.inversion.samples import DiagnosisInputs
from retwin.diagnosis.inversion.states import StateInversionDiagnoser
from retwin.diagnosis.inversion.trajectories import InversionDiagnoser, invert
from retwin.errors import InputError
from retwin.inference.noise import Noise
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Twin
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Context
from retwin.update.dynamics import DynamicsTwin, state_names
from retwin.update.exact import exact_surrogate
from retwin.update.residual import Residual, ResidualModel
from retwin.update.surrogate import Surrogate
from retwin.update.surrogate_error import surrogate_variance
from retwin.update.training_range import training_checked


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
        Fewer than 1/false_rate - 1 calibration trajectories cannot show it: as many are simulated
        by the corrected twin, and `InversionDiagnoser.calibration` has the number of them that is
        called unknown.

    Raises
    ------
    InputError
        There is no healthy trajectory, and whatever `InversionDiagnoser` or
        `StateInversionDiagnoser` refuses.

    """
    finite("false_rate", false_rate, at_least=0.001, at_most=0.5)
    if isinstance(surrogate, DynamicsTwin):
        expected = "None, since corrected dynamics have a distribution"
        got = type(residual).__name__
        require(residual is None, "residual", expected=expected, got=got, remedy="leave it out")
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
    expected = f"at least one trajectory labelled {HEALTHY!r}"
    got = f"labels {sorted(calibration.known_labels) or 'none'}"
    remedy = "label healthy trajectories"
    require(len(healthy), "calibration", expected=expected, got=got, remedy=remedy)
    surrogate = exact_surrogate(surrogate)
    with training_checked(surrogate, healthy.commands):
        return _fit(surrogate, residual, healthy, faults, twin, false_rate)


def _fit(
    surrogate: Surrogate,
    residual: ResidualModel,
    healthy: Trajectories,
    faults: Mapping[str, Fault | None],
    twin: Twin | None,
    false_rate: float,
    *,
    errors: float = 4.0,
    rounds: int = 5,
) -> InversionDiagnoser:
    """The diagnoser, its noise and the bound of its answer "unknown" from healthy trajectories.

    Parameters
    ----------
    errors : float, default 4.0
        Errors of the outputs, over those in calibration, from which on a trajectory is unknown:
        from few calibration trajectories, the quantile of a normal value is far away. None is
        unknown up to errors of 1 + ERRORS/n, if they are fewer, since the n of calibration are
        explained better than others.
    rounds : int, default 5
        Rounds of expectation-maximisation of the noise.

    """
    given = DiagnosisInputs.of(surrogate, residual, healthy)
    segments = given.context.segments
    found = surrogate_variance(surrogate, twin, healthy.commands, segments)
    variance = torch.zeros(len(residual.outputs))
    if found is not None:
        variance = found[segments.valid].mean(dim=0)
    context, observed, mask = given.with_error(variance)[:]
    problem = command_problem(residual, context, observed, mask)
    noise = fitted_noise(problem, healthy_prior(residual, context), rounds=rounds)
    seen: list[bool] = np.any(healthy.mask, axis=(0, 1)).tolist()
    outputs = tuple(compress(healthy.outputs.names, seen))
    limits = (1.0, min(errors, 1 + errors / len(healthy)), errors)
    each, near, far = _explain(residual, noise, (context, observed, mask), limits)
    simulated = _simulate(surrogate, residual, healthy, noise, round(1 / false_rate) - 1)
    others = DiagnosisInputs.of(surrogate, residual, simulated).with_error(variance)[:]
    bound = min(max(lower_bound(each, false_rate), float(far.mean())), float(near.mean()))
    below = _explain(residual, noise, others)[0] < bound
    return InversionDiagnoser(
        surrogate,
        residual,
        faults,
        noise=noise,
        surrogate_variance=variance,
        bound=bound,
        calibration=Calibration(len(healthy), false_rate, outputs, len(below), int(below.sum())),
    )


def _explain(
    residual: ResidualModel,
    noise: Noise,
    given: tuple[Context, Tensor, Tensor],
    factors: Sequence[float] = (1.0,),
) -> list[NDArray]:
    """Evidence per sample (n,) of healthy trajectories whose errors were so many times as large."""
    rows = Hypotheses.of((None,), residual, *given)
    known = invert(rows, noise)
    problem = rows.problem.with_missed(known.fit.missed)
    errors = problem.residual(known.fit.x)
    lost = [noise.misfit(problem, factor * errors).sum(dim=1) for factor in factors]
    samples = given[2].any(dim=2).sum(dim=1).clamp_min(1)
    return [((known.evidence + lost[0] - each) / samples).numpy() for each in lost]


def _simulate(
    surrogate: Surrogate, residual: ResidualModel, healthy: Trajectories, noise: Noise, count: int
) -> Trajectories:
    """So many healthy trajectories of the corrected twin, with noise, measured as these were."""
    place = np.arange(count) % len(healthy)
    made = CorrectedTwin(surrogate, residual).simulate(healthy.commands[place], seed=0)
    rng = np.random.default_rng(0)
    # Gaussian noise of the same scale: that of Student's t would be larger than what was learned.
    drawn = rng.standard_normal(made.observed.shape)
    observed = made.observed + noise.scale.mean(dim=0).numpy() * drawn
    return made.replace(observed=observed, mask=healthy.mask[place])


def lower_bound(values: NDArray, false_rate: float = 0.01) -> float:
    """What a further value is below with a probability of `false_rate`, from n normal ones.

    Minus infinity for a single one, which has no spread.
    """
    count = len(values)
    if count < 2:
        return -np.inf
    spread = np.std(values, ddof=1) * np.sqrt(1 + 1 / count)
    return float(np.mean(values) - student.ppf(1 - false_rate, count - 1) * spread)
