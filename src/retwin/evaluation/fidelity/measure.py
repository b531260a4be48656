"""`measure_fidelity`: simulations of measured commands, compared with the measured outputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.checks import require, whole
from retwin.data.segments import Segments
from retwin.data.trajectories import PER_SAMPLE, Channels, Trajectories
from retwin.evaluation.fidelity.figures import BINS, Fidelity
from retwin.evaluation.fidelity.overlay import shown_latents
from retwin.progress import Progress, tracked
from retwin.scores.distributions import (
    LEVELS,
    crps,
    further_group_quantile,
    pit_histograms,
    quantiles,
)
from retwin.scores.energy import energy_score
from retwin.twins.twin import Twin, checked_stride
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Context, Correction, DelayOffset
from retwin.update.residual import infer_discrepancy, segment
from retwin.update.training_range import checked_once

DISCREPANCY = DelayOffset()
"""The correction by which delays and offsets of every twin are inferred, whatever the correction
of its own residual model: so twins compare."""
INFERRED = 19
"""Draws per trajectory whose z is inferred: a further draw is within their range with probability
18 / 20 = 0.9."""
WINDOWS = 20
"""Windows of time in which the features of the classifier two-sample test are computed."""


@checked_once
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
    """Compare a twin's draws with measured trajectories that it was not calibrated on.

    Parameters
    ----------
    twin : Twin
        Usually a `CorrectedTwin`; delays and offsets are compared for such a one only.
    trajectories : Trajectories
        Healthy ones with commands, never those of the calibration.
    draws : int
        Simulations per trajectory, at least 19; those of one trajectory are in memory at a time.
    seed : int
        The same seed gives the same bytes on the same machine.
    rate : float, optional
        Sample rate of the comparison in Hz, best the true rate of the sensor; the rate of the
        trajectories is a whole multiple of it. By default that rate.
    against : mapping of str to Twin, optional
        Other twins by name, scored on the same trajectories; by default the mean correction
        ("mean_only") of a `CorrectedTwin`.
    widening : float, optional
        Factor of the bands about their median, see `measure_widening`, for one more figure.
    progress : Progress, optional
        Called with the share that is done.

    Returns
    -------
    Fidelity
        Scores of each trajectory, and their figures.

    Raises
    ------
    InputError
        If there is no trajectory, one has a fault or was never measured; if channels or rate are
        not the twin's; if `rate` does not divide that of the trajectories; or if there are fewer
        than 19 draws.

    """
    stride = _check(twin, trajectories, rate, draws)
    if against is None:
        against = {}
        if isinstance(twin, CorrectedTwin):
            against["mean_only"] = replace(twin, random=False)
    segments = _segments(twin, trajectories)
    operator = _operator(twin, trajectories, segments)
    seeds = np.random.SeedSequence(seed).generate_state(2 * len(trajectories)).reshape(-1, 2)
    rows: list[dict[str, Any]] = []
    for i, (twin_seed, tie_seed) in tracked(enumerate(seeds.tolist()), len(seeds), progress):
        one = trajectories[[i]]
        ensemble = _Ensemble.simulated(twin, one, draws, twin_seed, stride)
        row = ensemble.scores(np.random.default_rng(tie_seed))
        for name, rival in against.items():
            other = _Ensemble.simulated(rival, one, draws, twin_seed, stride)
            row[f"rival/{name}"] = other.accuracy()
        members = ensemble.members[: INFERRED + 1]
        row["segment_values"] = _segment_values(twin, members, segments[[i]], stride, operator)
        rows.append(row)
    rivals: dict[str, Any] = {
        name: tuple(map(np.array, zip(*(row[f"rival/{name}"] for row in rows), strict=True)))
        for name in against
    }
    return Fidelity(
        outputs=trajectories.outputs,
        segment_channels=_segment_channels(twin, trajectories.rate),
        rate=trajectories.rate / stride,
        draws=draws,
        ids=trajectories.ids,
        rivals=rivals,
        widening=np.full(len(trajectories), np.nan if widening is None else widening),
        at_bound=np.full(len(trajectories), _at_bound(twin)),
        **{name: np.stack([row[name] for row in rows]) for name in rows[0] if "rival/" not in name},
    )


@checked_once
def measure_widening(
    twin: Twin,
    trajectories: Trajectories,
    *,
    draws: int = 200,
    seed: int,
    rate: float | None = None,
) -> float:
    """Estimate of the factor by which 90 % bands are widened about their median to cover 90 %.

    Split conformal prediction with trajectories as groups, whose distributions are pooled. The
    further trajectory, the (K + 1)-th, is one of the groups: it is taken to be as bad as the worst
    of the K measured ones. A guarantee would take it to be outside altogether, so that fewer than
    nine trajectories gave no finite factor; this is an estimate.

    Parameters
    ----------
    twin : Twin
        The twin whose bands are widened.
    trajectories : Trajectories
        Healthy ones, neither those of the calibration nor those of a later test.
    draws, seed, rate
        See `measure_fidelity`.

    Returns
    -------
    float
        At least 1, since bands are not narrowed. Infinite if more than a tenth of the samples lie
        outside bands without width.

    Raises
    ------
    InputError
        As `measure_fidelity` does.

    References
    ----------
    Dunn, Wasserman and Ramdas, "Distribution-free prediction sets for two-layer hierarchical
    models", JASA 118 (2023): the method that pools the distributions of the groups.

    """
    stride = _check(twin, trajectories, rate, draws)
    seeds = np.random.SeedSequence(seed).generate_state(len(trajectories)).tolist()
    ratios = []
    for i, twin_seed in enumerate(seeds):
        ensemble = _Ensemble.simulated(twin, trajectories[[i]], draws, twin_seed, stride)
        values = ensemble.members.observed[:, ::stride][:, ensemble.seen]
        low, middle, high = quantiles(values[1:], LEVELS[::2])
        error = values[0] - middle
        width = np.where(error >= 0, high - middle, middle - low)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios.append(np.where(error == 0, 0.0, np.abs(error) / width).ravel())
    return max(1.0, further_group_quantile(ratios, 0.9))


def _check(twin: Twin, trajectories: Trajectories, rate: float | None, draws: int) -> int:
    """The stride of the comparison in samples; InputError for what cannot be compared."""
    stride = checked_stride(twin, trajectories, rate, "trajectories")
    seen = np.all(np.any(np.all(trajectories.mask, axis=2), axis=1))
    expected = "some sample with all outputs measured in each"
    got = "one that was never measured"
    require(seen, "trajectories", expected=expected, got=got, remedy="leave it out")
    whole("draws", draws, at_least=INFERRED, remedy="take the default of 200")
    return stride


@dataclass(frozen=True)
class _Ensemble:
    """A measured trajectory, then simulations of its commands.

    `one` is the measured trajectory, `members` (1 + draws) all of them, which share its mask.
    """

    one: Trajectories
    members: Trajectories
    stride: int

    @classmethod
    def simulated(
        cls, twin: Twin, one: Trajectories, draws: int, seed: int, stride: int
    ) -> _Ensemble:
        """With `draws` simulations by the twin."""
        made = twin.simulate(np.repeat(one.commands, draws, axis=0), seed=seed)
        repeated = (np.repeat(getattr(one, name), draws + 1, axis=0) for name in PER_SAMPLE)
        arrays: Any = dict(zip(PER_SAMPLE, repeated, strict=True))
        arrays["observed"][1:] = made.observed
        about: Any = {"rate": one.rate, "inputs": one.inputs, "outputs": one.outputs}
        return cls(one, Trajectories(**arrays, **about), stride)

    @property
    def seen(self) -> NDArray:
        """Whether all outputs of a sample were measured (P,)."""
        return np.asarray(self.one.mask[0, :: self.stride].all(axis=1))

    @property
    def values(self) -> NDArray:
        """Measured samples of all members (1 + draws, P, d), in double precision."""
        seen = self.members.observed[:, :: self.stride][:, self.seen]
        return seen.astype(np.float64)

    def scores(self, rng: np.random.Generator, *, reference: int = 99) -> dict[str, Any]:
        """The fields of `Fidelity` for one trajectory, except those per segment.

        Parameters
        ----------
        reference : int, default 99
            Draws per trajectory whose PIT is computed as that of a perfect generator: p-values of
            0.01.

        """
        every = slice(None, None, self.stride)
        observed = self.members.observed[:, every]
        residual = self.members.residual[: INFERRED + 1, : self.one.lengths[0] : self.stride]
        score, energy = self.accuracy()
        return {
            "nominal": self.one.nominal[0, every],
            "observed": observed[0],
            "seen": self.seen,
            "bands": quantiles(observed[1:]),
            "crps": score,
            "energy": energy,
            "pit": pit_histograms(self.values, members=reference + 1, bins=BINS, rng=rng),
            "features": _features(residual),
        }

    def accuracy(self) -> tuple[NDArray, float]:
        """CRPS of each output (d,), and the energy score of all samples and outputs together."""
        values = self.values
        # Outputs of different units are standardised before they are put into one vector.
        nominal = self.one.nominal[0, :: self.stride][self.seen]
        scale = nominal.std(axis=0, dtype=np.float64)
        unit = 1.0 if self.one.outputs.comparable else np.where(scale > 0, scale, 1.0)
        score = crps(values[0], values[1:]).mean(axis=0)
        values /= unit
        return score, float(energy_score(values[1:], values[0]))


def _features(residual: NDArray) -> NDArray:
    """Mean, deviation and mean step of the residual (m, P, d) in 20 windows of time, (m, F)."""
    steps = np.abs(np.diff(residual, axis=1, append=residual[:, -1:]))
    edges = np.arange(WINDOWS + 1) * residual.shape[1] // WINDOWS
    # Every window has a sample, however short a trajectory is.
    windows = [slice(a, max(a + 1, b)) for a, b in pairwise(edges)]
    values = []
    for window in windows:
        part = residual[:, window]
        values += [part.mean(axis=1), part.std(axis=1), steps[:, window].mean(axis=1)]
    return np.concatenate(values, axis=1).astype(np.float32)


def _segments(twin: Twin, trajectories: Trajectories) -> Segments:
    """Segments by the rule of the twin's residual model, where it has one."""
    commands = trajectories.commands
    if isinstance(twin, CorrectedTwin) and twin.residual.segmentation == "path":
        found = segment(commands, twin.surrogate.predict(commands), "path")
    else:
        found = Segments.from_commands(commands)
    return found.until(trajectories.lengths)


def _operator(twin: Twin, trajectories: Trajectories, segments: Segments) -> Correction:
    """`DISCREPANCY` with one range of delays for all trajectories and draws."""
    if not isinstance(twin, CorrectedTwin):
        return DISCREPANCY
    context = Context.of(twin.surrogate, trajectories.commands, segments, rate=trajectories.rate)
    observed, mask = torch.tensor(trajectories.observed), torch.tensor(trajectories.mask)
    return DISCREPANCY.completed(context, observed, mask)


def _at_bound(twin: Twin) -> float:
    """Share of the delays at a bound of their range when the twin was calibrated; NaN for none."""
    fitted = twin.residual.fitted if isinstance(twin, CorrectedTwin) else None
    return np.nan if fitted is None else fitted.figures.get("delays_at_bound", np.nan)


def _segment_channels(twin: Twin, rate: float) -> Channels:
    """Names and units of `_segment_values`."""
    noise = tuple(f"noise_{name}" for name in twin.outputs.names)
    if not isinstance(twin, CorrectedTwin):
        return Channels(noise, twin.outputs.units)
    latent, _ = shown_latents(DISCREPANCY.latent(twin.inputs, twin.outputs), rate)
    return Channels(latent.names + noise, latent.units + twin.outputs.units)


def _segment_values(
    twin: Twin, members: Trajectories, segments: Segments, stride: int, operator: Correction
) -> NDArray:
    """Delay, offsets and steady-state noise (m, M, k) of all members; NaN if not identified."""
    noise = _steady_noise(members, segments, stride)
    if not isinstance(twin, CorrectedTwin):
        return noise
    repeated = segments[np.zeros(len(members), dtype=int)]
    _, found = infer_discrepancy(twin.surrogate, members, operator, segments=repeated)
    z = torch.where(found.identified, found.z, torch.nan).numpy()
    _, factor = shown_latents(operator.latent(twin.inputs, twin.outputs), members.rate)
    return np.concatenate([factor * z, noise], axis=2)


def _steady_noise(members: Trajectories, segments: Segments, stride: int) -> NDArray:
    """Standard deviation (m, M, d) in the second half of each steady part, after transients."""
    noise = np.full((len(members), segments.max_count, len(members.outputs)), np.nan)
    time = np.arange(0, members.steps, stride)
    seen = members.mask[0, ::stride].all(axis=1)
    for m in np.flatnonzero(segments.valid[0]):
        settle, stop = segments.settle[0, m], segments.stop[0, m]
        inside = seen & (time >= (settle + stop) / 2) & (time < stop)
        if inside.sum() >= 3:
            noise[:, m] = members.observed[:, ::stride][:, inside].std(axis=1)
    return noise
