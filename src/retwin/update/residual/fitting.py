"""`fit_residual`: z* from outputs alone, then the distribution of z (Eq. 7–10)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.checks import agree, instance, require
from retwin.data.measured import check_magnitude, unmeasured
from retwin.data.quality.check import doubtful
from retwin.data.segments import Segments
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError
from retwin.nets.training import isolated
from retwin.progress import Progress
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.applied_faults import draw_faults, faulty_commands, frozen_from
from retwin.twins.twin import Twin
from retwin.update.corrections import Context, Correction, DelayOffset, Discrepancy
from retwin.update.corrections.chain import fit_correction, sample_mask
from retwin.update.corrections.delay_range import bound_note
from retwin.update.exact import exact_surrogate
from retwin.update.residual.bands import coverage_figures
from retwin.update.residual.model import ResidualModel
from retwin.update.residual.priors import Priors, other_machines
from retwin.update.residual.refining import refine
from retwin.update.residual.residual import Residual, segment
from retwin.update.residual.segment_fitting import fit_segments
from retwin.update.residual.sequence import SequenceMixture
from retwin.update.residual.sequence_fitting import fit_sequence
from retwin.update.residual.settings import Density, Mixture
from retwin.update.residual.stationary import StationaryNoise, fit_stationary
from retwin.update.residual.targets import ResidualTask, Targets
from retwin.update.surrogate import Surrogate
from retwin.update.surrogate_error import surrogate_variance, warn_of_error
from retwin.update.training_range import checked_once, training_checked


@checked_once
def infer_discrepancy(
    surrogate: Surrogate | Twin,
    trajectories: Trajectories,
    correction: Correction,
    *,
    segments: Segments | None = None,
    faults: Sequence[Fault | None] | None = None,
    twin: Twin | None = None,
) -> tuple[Context, Discrepancy]:
    """The discrepancies z* with which g explains measured trajectories best (for Eq. 7).

    Parameters
    ----------
    surrogate : Surrogate or Twin
        The IBG, or a twin in its place (see `ExactSurrogate`).
    trajectories : Trajectories
        Commands and measured outputs.
    correction : Correction
        The operator g.
    segments : Segments, optional
        One row per trajectory; by default from command events.
    faults : sequence of Fault or None, optional
        The known fault of each trajectory. An operator with `severities` infers its severity
        together with z* (`Discrepancy.severity`).
    twin : Twin, optional
        The twin that the surrogate was trained on, see `fit_residual`.

    Returns
    -------
    Context, Discrepancy
        What g is applied to, and z* with its uncertainty.

    """
    context = _context(exact_surrogate(surrogate), trajectories, segments, faults, twin)
    return context, correction.infer(context, *_measured(trajectories))


def fit_residual(
    surrogate: Surrogate | Twin,
    calibration: Trajectories,
    correction: Correction = DelayOffset(),  # noqa: B008 - a frozen config
    density: Density | SequenceMixture | StationaryNoise = Mixture(),  # noqa: B008 - frozen
    *,
    seed: int,
    calibrate_on: str | Mapping[str, Fault | None] = "healthy",
    bounds: NDArray | None = None,
    segments: Segments | str = "commands",
    twin: Twin | None = None,
    prior: Priors | None = None,
    progress: Progress | None = None,
) -> Residual[Any]:
    """Fit the residual model to measured trajectories, from outputs alone (Eq. 7–10).

    Parameters
    ----------
    surrogate : Surrogate or Twin
        The IBG, or a twin in its place (see `ExactSurrogate`).
    calibration : Trajectories
        Real trajectories with commands. Six suffice; from few the distribution is widened, and a
        warning is given below three. With one z per sample, unknown starts of a `StateTwin` are
        those that fit each of several.
    correction : Correction
        The operator g, which defines z. The parameters of a sensor in it are fitted too.
    density : Density, SequenceMixture or StationaryNoise
        Family of distributions of z; one of the last two for an operator with one z per sample,
        which can be fitted to a single record.
    seed : int
        The same seed gives the same weights on the same machine.
    calibrate_on : str or mapping
        "healthy" uses healthy trajectories only, since the offset would absorb the faults of
        others. "all" uses all, as if there were no faults. A mapping from label to fault, such as
        `case.faults`, uses the trajectories with these labels; an operator with `severities` then
        separates fault and discrepancy.
    bounds : NDArray, optional
        (d_z,), b of Eq. 9; by default 1.25 times the largest |z*|.
    segments : Segments or str
        "commands", "path" (see `segment`), or the segments, one row per trajectory; the segments
        of generated trajectories are then from command events.
    twin : Twin, optional
        The twin that the surrogate was trained on. It simulates the calibration commands, and what
        the surrogate errs there makes z less certain; without it, what the surrogate erred on
        held-out simulations.
    prior : Residual, CorrectedTwin, folder, or several of them, optional
        Models of other machines of the kind. What they have learned is expected of this one, the
        less the more they differ, and hardly if there is a single one; only of `CommandSpace`.
    progress : callable, optional
        Called with the share of the training that is done.

    Returns
    -------
    Residual
        A `ResidualModel`; for a `SequenceMixture` a `SequenceResidual`, and for `StationaryNoise`
        a `StationaryResidual`.

    Raises
    ------
    InputError
        No trajectory to calibrate on, no segment in any, no measurement from which z is
        identified, an unknown `calibrate_on`, or a prior of other channels or another correction.

    """
    surrogate = exact_surrogate(surrogate)
    others = other_machines(prior, correction, surrogate)
    remedy = "load recorded ones, or simulate a twin"
    instance("calibration", calibration, Trajectories, remedy=remedy)
    remedy = "load the file with its case, or convert it"
    agree("calibration", calibration, surrogate, "that of the surrogate", remedy=remedy)
    by_sample = isinstance(density, SequenceMixture | StationaryNoise)
    stepwise = correction.resolution == "step" or by_sample
    severities = getattr(correction, "severities", False)
    keep, faults = _chosen(calibration, calibrate_on, severities, 1 if stepwise else 3)
    used = calibration[keep]
    missing = "; ".join(filter(None, [unmeasured(used), doubtful(used)]))
    if missing:
        warnings.warn(f"calibration: {missing}", stacklevel=2)
    given = segments if isinstance(segments, str) else segments[keep]
    rule, parts = _segmented(used, given, needed=not stepwise)
    with training_checked(surrogate, used.commands) as outside:
        context = replace(_context(surrogate, used, parts, faults, twin), others=others)
        exact: Any = surrogate
        if stepwise and len(used) > 1 and getattr(exact, "unknown_starts", False):
            # Errors of the mean start are none of the outputs, and differ between records.
            context = replace(context, nominal=torch.as_tensor(exact.fitted_outputs(used)))
        warn_of_error(context, used)
        correction, found = fit_correction(correction, context, *_measured(used))
    expected = "measurements that identify the discrepancy"
    got = f"{int(used.mask.all(axis=2).sum())} samples with all outputs measured"
    remedy = "check the mask; leave an output out that is never measured"
    require(found.identified.any(), "calibration", expected=expected, got=got, remedy=remedy)
    task = ResidualTask(used, correction, context, found, bounds, seed, progress)
    if isinstance(density, StationaryNoise):
        model: Residual[Any] = fit_stationary(task, density)
    elif isinstance(density, SequenceMixture):
        model = fit_sequence(task, density)
    else:
        model = _fit_per_segment(task, density, rule)
        onsets = Segments.from_commands(calibration.commands)
        model.timing = np.where(onsets.valid, onsets.start, np.nan)
    model.emulated, model.learned = used.emulated, found.learned
    assert model.fitted is not None, "it has just been fitted"
    notes = [
        model.fitted.reason,
        f"commands outside the surrogate's training: {outside}" if outside else "",
        missing,
        "" if others is None else others.text,
    ]
    model.fitted = replace(model.fitted, reason="; ".join(filter(None, notes)))
    return model.eval()


def _segmented(
    used: Trajectories, segments: Segments | str, *, needed: bool
) -> tuple[str, Segments]:
    """The rule by which segments are found, and those of the trajectories, given or found."""
    if isinstance(segments, str):
        rule, parts = segments, segment(used.commands, used.nominal, segments)
    else:
        rule, parts = "commands", segments
    moving = parts.valid.any() or not needed
    expected = "trajectories with segments of motion"
    got = "commands that never change"
    remedy = "give segments='path', or the segments themselves"
    require(moving, "calibration", expected=expected, got=got, remedy=remedy)
    return rule, parts


def _fit_per_segment(task: ResidualTask, density: Density, rule: str) -> ResidualModel:
    """The distribution of one z per segment, which that rule finds; refined if it is set so."""
    used, context, found = task.used, task.context, task.found
    with isolated(task.seed):
        model = ResidualModel(
            task.correction, density, inputs=used.inputs, outputs=used.outputs, segmentation=rule
        )
    valid = context.segments.valid
    result, held_out = fit_segments(model, Targets.of(model, context, found, seed=task.seed), task)
    held_out = held_out[held_out < len(used)]  # a run that was predicted has no outputs
    figures = {"trajectories": float(len(used)), "movements": float(valid.sum())}
    if found.at_bound is not None:
        figures["delays_at_bound"] = share = float(found.at_bound.double()[valid].mean())
        result = replace(result, reason="; ".join(filter(None, [result.reason, bound_note(share)])))
    observed, mask = _measured(used)
    sampled = sample_mask(model.correction, observed, mask, used.rate)
    if density.refinement is not None and len(held_out):
        fitted = np.setdiff1d(np.arange(len(used)), held_out)
        figures |= refine(
            model, context, observed, sampled, fitted=torch.as_tensor(fitted), held_out=held_out,
            how=density.refinement, seed=task.seed, progress=task.progress,
        )  # fmt: skip
    healthy = (context.faulty_commands == context.commands).flatten(1).all(dim=1)
    rows = (healthy & (context.frozen >= context.commands.shape[1]).all(dim=1)).nonzero().flatten()
    if len(rows):
        model.eval()
        some = context[rows.numpy()], observed[rows], sampled[rows]
        figures |= coverage_figures(model, *some, seed=task.seed)
    model.fitted = replace(result, figures=figures | result.figures)
    return model


def _context(
    surrogate: Surrogate,
    trajectories: Trajectories,
    segments: Segments | None,
    faults: Sequence[Fault | None] | None,
    twin: Twin | None,
) -> Context:
    """What g is applied to; the severity of a known fault is arbitrary, since it is inferred."""
    commands = trajectories.commands
    parts = Segments.from_commands(commands) if segments is None else segments
    # Padding after the last sample is no steady part.
    parts = parts.until(trajectories.lengths)
    rate = trajectories.rate
    faulty: dict[str, NDArray] = {}
    if faults is not None:
        drawn = draw_faults(faults, parts, seed=0, rate=rate)
        faulty["faulty_commands"] = faulty_commands(commands, drawn, parts, rate=rate)
        faulty["frozen"] = frozen_from(drawn, *commands.shape[1:], rate=rate)
    context = Context.of(surrogate, commands, parts, rate=rate, **faulty)
    variance = surrogate_variance(surrogate, twin, commands, parts)
    return replace(context, surrogate_variance=variance)


def _measured(trajectories: Trajectories) -> tuple[Tensor, Tensor]:
    """Measured outputs and their mask, (n, T, d_y) each.

    Raises InputError for a value that no sensor gives, beside which the others would be lost.
    """
    check_magnitude("calibration", trajectories, ideal=True)
    return torch.tensor(trajectories.observed), torch.tensor(trajectories.mask)


def calibrating(
    calibration: Trajectories, calibrate_on: str | Mapping[str, Fault | None]
) -> NDArray:
    """Which trajectories (n,) bool `fit_residual` uses; InputError if it is none."""
    labels = calibration.labels
    if isinstance(calibrate_on, Mapping):
        keep = np.isin(labels, list(calibrate_on))
    elif calibrate_on in ("healthy", "all"):
        keep = (labels == HEALTHY) | (calibrate_on == "all")
    else:
        expected = "'healthy', 'all', or a mapping from label to fault"
        remedy = "'all' lets the offset absorb faults; use it for comparison only"
        raise InputError("calibrate_on", expected=expected, got=repr(calibrate_on), remedy=remedy)
    wanted = repr(HEALTHY) if isinstance(calibrate_on, str) else ", ".join(calibrate_on)
    require(
        keep.any(),
        "calibration",
        expected=f"at least one trajectory labelled {wanted}",
        got=f"labels {sorted(calibration.known_labels) or 'none'}",
        remedy="label healthy trajectories, or calibrate on 'all'"
        if isinstance(calibrate_on, str)
        else "label the trajectories",
    )
    return keep


def _chosen(
    calibration: Trajectories,
    calibrate_on: str | Mapping[str, Fault | None],
    severities: bool,
    minimum: int,
) -> tuple[NDArray, list[Fault | None] | None]:
    """Indices of the trajectories to use, and their faults if their severities are inferred."""
    keep = calibrating(calibration, calibrate_on)
    faults = None
    if isinstance(calibrate_on, Mapping) and severities:
        faults = [calibrate_on[str(label)] for label in calibration.labels[keep]]
    if keep.sum() < minimum:
        warnings.warn(
            f"calibration: {keep.sum()} trajectories to calibrate on, at least three are needed to "
            "learn how much they differ; the distribution of the discrepancy is widened for it",
            stacklevel=3,
        )
    return np.flatnonzero(keep), faults
