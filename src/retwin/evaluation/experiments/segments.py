"""What is not yet known of a discrepancy with one z per segment, and what would reduce it.

z of a segment is taken as linear in features of its commands, with a scatter of its own. The
coefficients have a posterior, from z* and its covariance of the calibration trajectories: where the
outputs do not determine z, a segment gives no information. The scatter remains, however much is
measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.inference.design import Knowledge
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Context, Correction, Discrepancy, before_sensor, sensor_of
from retwin.update.residual import ResidualModel
from retwin.update.residual.model import describe


@dataclass(frozen=True, eq=False)
class SegmentKnowledge:
    """The posterior of the coefficients, and what it was computed with.

    Attributes
    ----------
    twin : CorrectedTwin
        Its residual model has one z per segment.
    used : Tensor
        (k,) indices of the components of z, the events left out.
    centre, spread : Tensor
        (F,), by which features are standardised.
    scatter : Tensor
        (k, k), covariance of z given the features.
    coefficients : Tensor
        (k, 1 + F), their posterior mean.
    covariance : Tensor
        (k (1 + F), k (1 + F)), their posterior covariance.
    noise : float
        Scale of the error of a sample of the outputs.
    observed : tuple of Tensor
        Of each calibration segment (m,): its trajectory, its features (m, 1 + F), z (m, k), and the
        covariance of z (m, k, k).

    """

    twin: CorrectedTwin
    used: Tensor
    centre: Tensor
    spread: Tensor
    scatter: Tensor
    coefficients: Tensor
    covariance: Tensor
    noise: float
    observed: tuple[Tensor, ...]

    @classmethod
    def of(
        cls, twin: CorrectedTwin, context: Context, found: Discrepancy, commands: NDArray
    ) -> SegmentKnowledge:
        """What `found` shows of z at commands like `commands` (n, T, d_u)."""
        residual = twin.residual
        assert isinstance(residual, ResidualModel)
        valid = torch.as_tensor(context.segments.valid)
        used = (~residual.events).nonzero().flatten()
        z = found.z[valid][:, used].double()
        error = found.covariance[valid][:, used][:, :, used].double()
        reference = residual.context(twin.surrogate, commands)
        features = _features(reference)[torch.as_tensor(reference.segments.valid)]
        centre, spread = features.mean(dim=0), features.std(dim=0)
        spread = torch.where(spread > 1e-9 * features.abs().amax(dim=0), spread, torch.inf)
        design = _with_constant((_features(context)[valid] - centre) / spread)
        scatter, mean, covariance = _regression(design, z, error)
        noise = float(found.noise.median())
        owner = valid.nonzero()[:, 0]
        observed = owner, design, z, error
        return cls(twin, used, centre, spread, scatter, mean, covariance, noise, observed)

    @property
    def trajectories(self) -> int:
        """Number of calibration trajectories."""
        return int(self.observed[0].max()) + 1

    def subset(self, trajectories: NDArray) -> SegmentKnowledge:
        """The information in some of the calibration trajectories alone."""
        owner, design, z, error = self.observed
        kept = torch.isin(owner, torch.as_tensor(trajectories))
        parts = _regression(design[kept], z[kept], error[kept])
        return replace(self, scatter=parts[0], coefficients=parts[1], covariance=parts[2])

    def error(self, trajectories: NDArray) -> float:
        """Root mean square error of the mean of z of some calibration trajectories.

        Each component is divided by the root mean square of z, its mean left out.
        """
        owner, design, z, _ = self.observed
        kept = torch.isin(owner, torch.as_tensor(trajectories))
        left = z - design @ self.coefficients.mT
        return float((left[kept] / z.std(dim=0)).square().mean().sqrt())

    def context(self, commands: NDArray) -> Context:
        """The context of commands (n, T, d_u)."""
        return self.twin.residual.context(self.twin.surrogate, commands)

    def design(self, context: Context) -> Tensor:
        """Features (n, M, 1 + F), 0 where there is no segment."""
        made = _with_constant((_features(context) - self.centre) / self.spread)
        return made * torch.as_tensor(context.segments.valid)[..., None]

    def knowledge(self, commands: NDArray) -> Knowledge:
        """The knowledge about z, each component in units of its scatter, at the segments."""
        context = self.context(commands)
        rows = self.design(context)[torch.as_tensor(context.segments.valid)]
        size = len(self.used)
        predictions = torch.einsum("kj,rf->rkjf", torch.eye(size, dtype=rows.dtype), rows)
        scatter = self.scatter.diagonal().repeat(len(rows))
        return Knowledge(self.covariance, predictions.flatten(0, 1).flatten(1), scatter)

    @torch.no_grad()
    def roots(self, commands: NDArray) -> Tensor:
        """(n, M k, k (1 + F)) roots of the information that outputs of commands would give."""
        context = self.context(commands)
        precision = torch.linalg.inv(self.scatter)
        outputs = self._information(context)
        # Information about the mean of z, when z itself and its scatter are integrated out.
        about = precision - precision @ torch.linalg.inv(precision + outputs) @ precision
        values, vectors = torch.linalg.eigh((about + about.mT) / 2)
        root = (vectors * values.clamp_min(0).sqrt()[..., None, :]).mT
        rows = self.design(context)
        made = torch.einsum("nmaj,nmf->nmajf", root, rows)
        return made.flatten(3).flatten(1, 2)

    def _information(self, context: Context, *, step: float = 0.1) -> Tensor:
        """(n, M, k, k) information about z of each segment in the outputs of its samples.

        Parameters
        ----------
        step : float, default 0.1
            Step of finite differences of z, in standard deviations of its scatter.

        """
        correction: Any = self.twin.residual.correction
        mean = torch.zeros(*context.segments.start.shape, len(self.twin.residual.latent))
        mean[..., self.used] = (self.design(context) @ self.coefficients.mT).float()
        every = _stride(correction, context.rate)
        times = torch.arange(0, context.commands.shape[1], every)
        base = _apply(correction, context, mean, times)
        slopes = []
        for index, deviation in zip(
            self.used.tolist(), self.scatter.diagonal().sqrt().tolist(), strict=True
        ):
            moved = mean.clone()
            moved[..., index] += step * deviation
            change = _apply(correction, context, moved, times) - base
            slopes.append(change.double() / (step * deviation))
        slope = torch.stack(slopes, dim=-1)  # (n, S, d_y, k)
        products = torch.einsum("ntyi,ntyj->ntij", slope, slope)
        start, stop = (
            torch.as_tensor(each)[..., None]
            for each in (context.segments.start, context.segments.stop)
        )
        inside = ((times >= start) & (times < stop)).double()
        return torch.einsum("nmt,ntij->nmij", inside, products) / self.noise**2


def _apply(correction: Correction, context: Context, z: Tensor, times: Tensor) -> Tensor:
    """Corrected outputs (n, S, d_y) at some samples."""
    operator = before_sensor(correction)
    at = getattr(operator, "at", None)
    if at is None:
        return operator.apply(context, z)[:, times]
    return at(context, z, times.expand(len(context), -1))


def _stride(correction: Correction, rate: float) -> int:
    """Samples per sample of the sensor."""
    sensor = sensor_of(correction)
    return 1 if sensor is None or sensor.period is None else sensor.timing(rate)[0]


def _features(context: Context) -> Tensor:
    """Features (n, M, F): those of the residual model, and directions of the commands."""
    made = describe(context).double()
    width = context.commands.shape[2]
    pair = width + context.nominal.shape[2]
    moved = made[..., 2 * pair : 2 * pair + width] - made[..., :width]
    return torch.cat([made, moved.sign()], dim=-1)


def _with_constant(features: Tensor) -> Tensor:
    return torch.cat([torch.ones_like(features[..., :1]), features], dim=-1)


def _regression(
    design: Tensor,
    z: Tensor,
    error: Tensor,
    *,
    rounds: int = 10,
    freedom: float = 4.0,
    wide: float = 100.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Scatter (k, k), coefficients (k, F) and their covariance, from z (m, k) with `error`.

    Scatter and prior variances are estimated from the data too (empirical Bayes).

    Parameters
    ----------
    rounds : int, default 10
        Rounds in which scatter and prior of the coefficients are estimated from each other.
    freedom : float, default 4.0
        Segments for which the first guess of the scatter counts.
    wide : float, default 100.0
        Prior variance of a constant, relative to the mean square of z.

    """
    count, size = z.shape
    features = design.shape[1]
    first = z.square().mean(dim=0) + error.diagonal(dim1=1, dim2=2).mean(dim=0)
    scatter = torch.diag(first)
    prior = (first / (2 * features))[:, None].repeat(1, features)
    prior[:, 0] = wide * first
    mean, covariance = torch.zeros(size, features, dtype=z.dtype), torch.diag(prior.flatten())
    for _ in range(rounds):
        precision = torch.linalg.inv(scatter)
        # z is as uncertain as its scatter at most; then it gives no information.
        about = precision - precision @ _within(error, scatter) @ precision
        information = torch.einsum("mij,mf,mg->ifjg", about, design, design)
        information = information.flatten(2).flatten(0, 1) + torch.diag(1 / prior.flatten())
        covariance = torch.linalg.inv(information)
        target = torch.einsum("mij,mj,mf->if", about, z, design).flatten()
        mean = (covariance @ target).unflatten(0, (size, features))
        left = z - design @ mean.mT
        blocks = covariance.unflatten(0, (size, features)).unflatten(2, (size, features))
        spread = torch.einsum("mf,ifjg,mg->mij", design, blocks, design)
        second = (left[..., None] * left[:, None] + spread + error).sum(dim=0)
        scatter = (second + freedom * torch.diag(first) / 2) / (count + freedom)
        own = mean.square() + covariance.diagonal().unflatten(0, (size, features))
        shared = own[:, 1:].mean(dim=1)
        prior = torch.cat([prior[:, :1], shared[:, None].repeat(1, features - 1)], dim=1)
    return scatter, mean, covariance


def _within(error: Tensor, scatter: Tensor) -> Tensor:
    """Covariances (m, k, k), reduced where they exceed the scatter (k, k)."""
    root = torch.linalg.cholesky(scatter)
    whitened = torch.linalg.solve_triangular(root, error, upper=False)
    whitened = torch.linalg.solve_triangular(root, whitened.mT, upper=False)
    values, vectors = torch.linalg.eigh((whitened + whitened.mT) / 2)
    half = root @ (vectors * values.clamp(0, 1).sqrt()[..., None, :])
    return half @ half.mT
