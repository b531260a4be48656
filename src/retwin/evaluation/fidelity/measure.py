"""Simulate what was commanded many times, and hold what was measured against the draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.data.segments import Segments
from retwin.data.trajectories import HEALTHY, UNLABELLED, Channels, Trajectories
from retwin.errors import InputError
from retwin.evaluation.fidelity.figures import BINS, LEVELS, Fidelity
from retwin.progress import Progress
from retwin.scores.energy import energy_score
from retwin.twins.twin import Twin
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import DelayOffset
from retwin.update.residual import infer_discrepancy, segment

__all__ = ["measure_fidelity", "measure_widening"]

MOVEMENT = DelayOffset()
"""Tells TDe and TPE of every twin alike, whatever operator its own residual model has."""
INFERRED = 19
"""Draws per trajectory of which z* is inferred: one more lies within their range 9 times in 10."""
REFERENCE = 99
"""Draws per trajectory that in turn stand for the measured one."""
WINDOWS = 20


def measure_fidelity(
    twin: Twin,
    trajectories: Trajectories,
    *,
    draws: int = 200,
    seed: int,
    rate: float | None = None,
    against: Mapping[str, Twin] | None = None,
    widening: float | None = None,
    progress: Progress | None = None,
) -> Fidelity:
    """How well a twin's draws match measured trajectories that it was not fitted to.

    Parameters
    ----------
    twin: usually a `CorrectedTwin`; TDe and TPE are compared for such a one only.
    trajectories: healthy ones, with commands, never those of the calibration.
    draws: simulations per trajectory, 19 at least; one trajectory's are held at a time.
    seed: same seed, same bytes on the same machine.
    rate: samples per second to look at, a whole part of the data's; the sensor's true rate serves
        best. By default the data's.
    against: rivals by name, scored on the same trajectories; by default the mean correction alone
        ("mean_only") of a `CorrectedTwin`.
    widening: factor for bands about their median, see `measure_widening`, as a further figure.

    Raises
    ------
    InputError: no trajectory, one with a fault, one never measured; channels or a rate that are
        not the twin's; a `rate` that does not divide the data's; fewer than 19 draws.

    """
    stride = _checked(twin, trajectories, rate, draws)
    if against is None:
        against = {}
        if isinstance(twin, CorrectedTwin):
            against["mean_only"] = replace(twin, random=False)
    segments = _segments(twin, trajectories)
    seeds = np.random.SeedSequence(seed).generate_state(2 * len(trajectories)).reshape(-1, 2)
    rows: list[dict[str, Any]] = []
    for i, (for_twin, for_ties) in enumerate(seeds.tolist()):
        one = trajectories[[i]]
        made = _simulate(twin, one, draws, for_twin)
        row = _score(one, made, stride, np.random.default_rng(for_ties))
        for name, rival in against.items():
            theirs = _simulate(rival, one, draws, for_twin)
            row[f"rival/{name}"] = _accuracy(one, theirs, stride)
        row["movements"] = _movements(twin, made[: INFERRED + 1], segments[[i]], stride)
        rows.append(row)
        if progress is not None:
            progress((i + 1) / len(trajectories))
    rivals = {
        name: (
            np.stack([row[f"rival/{name}"][0] for row in rows]),
            np.array([row[f"rival/{name}"][1] for row in rows]),
        )
        for name in against
    }
    names = ("nominal", "observed", "seen", "bands", "crps", "energy", "pit", "features")
    return Fidelity(
        outputs=trajectories.outputs,
        movement=_movement_channels(twin),
        rate=trajectories.rate / stride,
        draws=draws,
        ids=trajectories.ids,
        rivals=rivals,
        widening=np.full(len(trajectories), np.nan if widening is None else widening),
        movements=np.stack([row["movements"] for row in rows]),
        **{name: np.stack([row[name] for row in rows]) for name in names},
    )


def measure_widening(
    twin: Twin,
    trajectories: Trajectories,
    *,
    draws: int = 200,
    seed: int,
    rate: float | None = None,
) -> float:
    """By which factor the 90 % bands must be widened about their median to hold 90 % of points.

    Split conformal prediction with trajectories as groups, whose distributions are pooled: the
    factor holds on average over trajectories, the more exactly the more there are. The twin must
    not have seen these trajectories, and they must not be those it is then judged on. Infinite
    when more than a tenth of the points lie off bands of no width.

    Raises InputError like `measure_fidelity`.
    """
    stride = _checked(twin, trajectories, rate, draws)
    seeds = np.random.SeedSequence(seed).generate_state(len(trajectories)).tolist()
    ratios, weights = [], []
    for i, for_twin in enumerate(seeds):
        made = _simulate(twin, trajectories[[i]], draws, for_twin)
        seen = made.mask[0, ::stride].all(axis=1)
        values = made.observed[:, ::stride][:, seen]
        low, middle, high = _quantiles(values[1:], LEVELS[::2])
        off = values[0] - middle
        width = np.where(off >= 0, high - middle, middle - low)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(off == 0, 0.0, np.abs(off) / width)
        ratios.append(ratio.ravel())
        weights.append(np.full(ratio.size, 1 / ratio.size))
    pooled, shares = np.concatenate(ratios), np.concatenate(weights)
    order = np.argsort(pooled, kind="stable")
    reached = np.cumsum(shares[order]) / len(trajectories)
    return float(pooled[order][np.searchsorted(reached, 0.9 - 1e-9)])


def _checked(twin: Twin, trajectories: Trajectories, rate: float | None, draws: int) -> int:
    """Every how many samples to look; InputError for what cannot be compared."""
    healthy = np.isin(trajectories.labels, (HEALTHY, UNLABELLED))
    if len(trajectories) == 0 or not healthy.all():
        raise InputError(
            "trajectories",
            expected="healthy trajectories, one at least",
            got=f"{len(trajectories)}, {int((~healthy).sum())} of them with a fault",
            remedy=f"take trajectories.with_label({HEALTHY!r})",
        )
    if not np.all(np.any(np.all(trajectories.mask, axis=2), axis=1)):
        raise InputError(
            "trajectories",
            expected="some sample with all outputs measured in each",
            got="one that was never measured",
            remedy="leave it out",
        )
    for name in ("inputs", "outputs", "rate"):
        ours, theirs = getattr(twin, name), getattr(trajectories, name)
        if ours != theirs:
            raise InputError(
                f"trajectories.{name}",
                expected=f"what the twin has, {ours}",
                got=f"{theirs}",
                remedy="load the file with its case, or convert it",
            )
    if draws < INFERRED:
        raise InputError(
            "draws", expected=f"at least {INFERRED}", got=repr(draws), remedy="200 serve well"
        )
    stride = 1 if rate is None else round(trajectories.rate / rate) if rate > 0 else 0
    if stride < 1 or (rate is not None and abs(stride * rate - trajectories.rate) > 1e-6):
        raise InputError(
            "rate",
            expected=f"{trajectories.rate:g} Hz, the data's rate, or a whole part of it",
            got=f"{rate}",
            remedy="choose a rate that takes every sample, every second, every third …",
        )
    return stride


def _simulate(twin: Twin, one: Trajectories, draws: int, seed: int) -> Trajectories:
    """The measured trajectory, then `draws` simulations of its commands, all seen where it is."""
    made = twin.simulate(np.repeat(one.commands, draws, axis=0), seed=seed)
    observed = np.concatenate([one.observed, made.observed.astype(one.observed.dtype)])
    return Trajectories(
        commands=np.repeat(one.commands, draws + 1, axis=0),
        nominal=np.repeat(one.nominal, draws + 1, axis=0),
        observed=observed,
        mask=np.repeat(one.mask, draws + 1, axis=0),
        rate=one.rate,
        inputs=one.inputs,
        outputs=one.outputs,
    )


def _score(
    one: Trajectories, made: Trajectories, stride: int, rng: np.random.Generator
) -> dict[str, Any]:
    """What `Fidelity` tells of one trajectory, its movements apart."""
    seen = made.mask[0, ::stride].all(axis=1)
    values = made.observed[:, ::stride]
    residual = made.residual[: INFERRED + 1, : one.lengths[0] : stride]
    crps, energy = _accuracy(one, made, stride)
    return {
        "nominal": one.nominal[0, ::stride],
        "observed": values[0],
        "seen": seen,
        "bands": _quantiles(values[1:], LEVELS),
        "crps": crps,
        "energy": energy,
        "pit": _pit(values[:, seen].astype(np.float64), rng),
        "features": _features(residual),
    }


def _quantiles(draws: NDArray, levels: Sequence[float]) -> NDArray:
    """(levels, P, d), such that one more draw lies below each with just that chance."""
    return np.quantile(draws, levels, axis=0, method="weibull")


def _accuracy(one: Trajectories, made: Trajectories, stride: int) -> tuple[NDArray, float]:
    """CRPS of every output (d,), and the energy score of all samples and outputs as one vector.

    Both without the bias of few draws ("fair"), so a point forecast and an ensemble compare.
    """
    import scoringrules

    seen = made.mask[0, ::stride].all(axis=1)
    values = made.observed[:, ::stride][:, seen].astype(np.float64)
    crps = scoringrules.crps_ensemble(values[0], values[1:], m_axis=0, estimator="pwm")
    # Outputs of different units must be made comparable before they are put into one vector.
    spread = one.nominal[0, ::stride][seen].std(axis=0, dtype=np.float64)
    unit = 1.0 if one.outputs.comparable else np.where(spread > 0, spread, 1.0)
    values /= unit
    return crps.mean(axis=0), float(energy_score(values[1:], values[0]))


def _pit(values: NDArray, rng: np.random.Generator) -> NDArray:
    """Shares (1 + 99, d, 100) of the PIT of each member of (1 + draws, P, d) among all others.

    Members that agree to the last digit are ranked at random, and the PIT is drawn within its step.
    """
    order = np.lexsort((rng.random(values.shape), values), axis=0)
    rank = np.empty_like(order)
    np.put_along_axis(rank, order, np.arange(len(values))[:, None, None], axis=0)
    some = rank[: REFERENCE + 1]
    place = ((some + rng.random(some.shape)) / len(values) * BINS).astype(int).clip(max=BINS - 1)
    members, moments, outputs = place.shape
    row = np.arange(members)[:, None, None] * outputs + np.arange(outputs)
    counts = np.bincount((row * BINS + place).ravel(), minlength=members * outputs * BINS)
    return (counts.reshape(members, outputs, BINS) / moments).astype(np.float32)


def _features(residual: NDArray) -> NDArray:
    """Mean, spread and step of each output's residual (m, P, d) in 20 windows of time, (m, F)."""
    steps = np.abs(np.diff(residual, axis=1, append=residual[:, -1:]))
    edges = np.arange(WINDOWS + 1) * residual.shape[1] // WINDOWS
    # Every window has a sample, however short a trajectory is.
    parts = [slice(a, max(a + 1, b)) for a, b in pairwise(edges)]
    told = [
        value
        for part in parts
        for value in (
            residual[:, part].mean(axis=1),
            residual[:, part].std(axis=1),
            steps[:, part].mean(axis=1),
        )
    ]
    return np.concatenate(told, axis=1).astype(np.float32)


def _segments(twin: Twin, trajectories: Trajectories) -> Segments:
    """Movements, by the rule that the twin itself goes by."""
    commands = trajectories.commands
    if isinstance(twin, CorrectedTwin) and twin.residual.segmentation == "path":
        found = segment(commands, twin.surrogate.predict(commands), "path")
    else:
        found = Segments.from_commands(commands)
    return found.until(trajectories.lengths)


def _movement_channels(twin: Twin) -> Channels:
    noise = tuple(f"noise_{name}" for name in twin.outputs.names)
    if not isinstance(twin, CorrectedTwin):
        return Channels(noise, twin.outputs.units)
    latent = MOVEMENT.latent(twin.inputs, twin.outputs)
    return Channels(latent.names + noise, latent.units + twin.outputs.units)


def _movements(twin: Twin, made: Trajectories, segments: Segments, stride: int) -> NDArray:
    """TDe, TPE and plateau noise (m, M, k), measured and drawn alike; NaN where not told."""
    noise = _plateau_noise(made, segments, stride)
    if not isinstance(twin, CorrectedTwin):
        return noise
    every = segments[np.zeros(len(made), dtype=int)]
    _, found = infer_discrepancy(twin.surrogate, made, MOVEMENT, segments=every)
    z = torch.where(found.identified, found.z, torch.nan).numpy()
    return np.concatenate([z, noise], axis=2)


def _plateau_noise(made: Trajectories, segments: Segments, stride: int) -> NDArray:
    """Standard deviation (m, M, d) in the second half of each steady part, when all is at rest."""
    noise = np.full((len(made), segments.max_count, len(made.outputs)), np.nan)
    time = np.arange(0, made.steps, stride)
    seen = made.mask[0, ::stride].all(axis=1)
    for m in np.flatnonzero(segments.valid[0]):
        settle, stop = segments.settle[0, m], segments.stop[0, m]
        inside = seen & (time >= (settle + stop) / 2) & (time < stop)
        if inside.sum() >= 3:
            noise[:, m] = made.observed[:, ::stride][:, inside].std(axis=1)
    return noise
