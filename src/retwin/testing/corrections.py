"""The contract of `Correction`: what every operator g must do, as checks to run on any."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels
from retwin.errors import InputError
from retwin.testing.suite import (
    quiet_randomness,
    require,
    require_alike,
    require_same,
    run_checks,
)

if TYPE_CHECKING:  # torch takes seconds to load, and twins can be checked without it
    from torch import Tensor

    from retwin.update.corrections import Context, Correction, Discrepancy

__all__ = ["CORRECTION_CHECKS", "CorrectionSubject", "check_correction"]


@dataclass(frozen=True, eq=False)
class CorrectionSubject:
    """A correction, and what it is to be tried on.

    Parameters
    ----------
    correction: the operator.
    context: at least two trajectories, with movements that it can tell from each other.
    z: (n, M, d_z), values that it should be able to find again; 0 where a movement does not exist.

    Raises
    ------
    InputError: fewer than two trajectories, or not one z for each.

    """

    correction: Correction
    context: Context
    z: Tensor

    def __post_init__(self) -> None:
        if len(self.context) < 2 or self.z.ndim != 3 or len(self.z) != len(self.context):
            raise InputError(
                "z",
                expected="shape (n, M, d_z) for n trajectories of the context, n at least 2",
                got=f"{tuple(self.z.shape)} for {len(self.context)}",
                remedy="give a few short trajectories and one z for each",
            )

    @property
    def inputs(self) -> Channels:
        """Channels for the commands; a context does not name them."""
        return Channels.numbered("u", self.context.commands.shape[2])

    @property
    def outputs(self) -> Channels:
        """Channels for the outputs; a context does not name them."""
        return Channels.numbered("y", self.context.path.shape[2])

    def apply(self, z: Tensor, context: Context | None = None) -> Tensor:
        """The corrected path, by default of the subject's context."""
        return self.correction.apply(context or self.context, z)

    def infer(self, *, noise: float = 0.0) -> Discrepancy:
        """What is found for z, the outputs being noisy by that share of what z does."""
        observed = self.apply(self.z).detach()
        effect = (observed - self.context.path).square().mean().sqrt()
        drawn = np.random.default_rng(0).normal(size=tuple(observed.shape))
        observed = observed + noise * effect * observed.new_tensor(drawn)
        return self.correction.infer(self.context, observed, observed == observed)


def check_protocol(subject: CorrectionSubject) -> None:
    """It has resolution, latent, heads, apply and infer."""
    from retwin.update.corrections import Correction

    require(
        isinstance(subject.correction, Correction),
        "a correction must have resolution, latent, heads, apply, infer; see retwin.Correction",
    )
    resolution = subject.correction.resolution
    known = resolution in ("segment", "step")
    require(known, f"resolution must be 'segment' or 'step', got {resolution!r}")


def check_latent(subject: CorrectionSubject) -> None:
    """Every component of z is named and belongs to one head."""
    latent = subject.correction.latent(subject.inputs, subject.outputs)
    width = subject.z.shape[2]
    require(len(latent) == width, f"latent must name {width} components, got {latent.names}")
    heads = subject.correction.heads(subject.inputs, subject.outputs)
    names = [head.name for head in heads]
    require(len(set(names)) == len(names), f"heads must have different names, got {names}")
    covered = sum(head.width for head in heads)
    sound = covered == width and all(head.width > 0 for head in heads)
    require(sound, f"heads must share out the {width} components of z, got {heads}")


def check_zero(subject: CorrectionSubject) -> None:
    """With z = 0 nothing changes."""
    same = subject.apply(subject.z * 0)
    require_alike(same, subject.context.path, "apply with z = 0 must give the path back")


def check_apply(subject: CorrectionSubject) -> None:
    """What comes out is a finite path of the same shape, and every component of z acts."""
    path = subject.context.path
    corrected = subject.apply(subject.z)
    require(
        corrected.shape == path.shape and corrected.isfinite().all(),
        f"apply must give finite numbers of shape {tuple(path.shape)}, "
        f"got {corrected.dtype} of shape {tuple(corrected.shape)}",
    )
    for component in range(subject.z.shape[2]):
        alone = subject.z * 0
        alone[..., component] = subject.z[..., component]
        acts = not subject.apply(alone).equal(subject.apply(alone * 0))
        require(alone.any(), f"component {component} of the subject's z is 0; give another z")
        require(acts, f"component {component} of z must do something")


def check_gradient(subject: CorrectionSubject) -> None:
    """`apply` can be differentiated by z."""
    z = subject.z.clone().requires_grad_()
    corrected = subject.apply(z)
    require(corrected.requires_grad, "apply must keep the gradient of z")
    corrected.square().sum().backward()
    require(
        z.grad is not None and z.grad.isfinite().all(), "the gradient by z must be finite numbers"
    )
    if z.grad is not None:
        reached = z.grad.flatten(0, 1).any(dim=0).tolist()
        require(all(reached), f"every component of z must have a gradient, got {reached}")


def check_batch(subject: CorrectionSubject) -> None:
    """What a trajectory gives does not depend on those beside it.

    An operator with a true `pools` may learn from all of them what to believe beforehand; then
    this holds for `apply` only.
    """
    pools = getattr(subject.correction, "pools", False)
    whole = subject.apply(subject.z).detach()
    found = subject.infer()
    mask = whole == whole
    for i in range(len(subject.context)):
        one = slice(i, i + 1)
        context = subject.context[one]
        message = f"trajectory {i} must give the same alone"
        require_alike(subject.apply(subject.z[one], context), whole[one], f"apply: {message}")
        if pools:
            continue
        alone = subject.correction.infer(context, whole[one], mask[one])
        require_alike(alone.z, found.z[one], f"infer: {message}", tolerance=1e-3)


def check_no_movement(subject: CorrectionSubject) -> None:
    """Where a movement does not exist, nothing is corrected and nothing found."""
    if subject.correction.resolution != "segment":
        return
    corrected = subject.apply(subject.z).detach()
    mask = corrected == corrected
    more = replace(subject.context, segments=_with_another(subject.context.segments))
    z = subject.z.new_zeros(len(more), more.segments.max_count, subject.z.shape[2])
    z[:, :-1] = subject.z
    message = "a movement that does not exist, z = 0, must change nothing"
    require_alike(subject.apply(z, more), corrected, message)
    found = subject.correction.infer(more, corrected, mask)
    quiet = not found.z[:, -1].any() and not found.identified[:, -1].any()
    require(quiet, "infer must give z = 0, not identified, where a movement does not exist")
    still = replace(subject.context, segments=_without_any(subject.context.segments))
    none = subject.z[:, :0]
    message = "without any movement apply must give the path back"
    require_alike(subject.apply(none, still), subject.context.path, message)
    got, wanted = subject.correction.infer(still, corrected, mask).z.shape, none.shape
    require(got == wanted, f"without movements z must have shape {tuple(wanted)}, got {got}")


def _with_another(segments: Segments) -> Segments:
    """The same movements and one more that does not exist."""
    end = np.full((len(segments), 1), float(segments.steps))
    start, settle, stop = (
        np.hstack([times, end]) for times in (segments.start, segments.settle, segments.stop)
    )
    valid = np.hstack([segments.valid, np.zeros(end.shape, dtype=bool)])
    return Segments(start, settle, stop, valid, segments.steps)


def _without_any(segments: Segments) -> Segments:
    nothing = np.empty((len(segments), 0))
    return Segments(nothing, nothing, nothing, nothing.astype(bool), segments.steps)


def check_discrepancy(subject: CorrectionSubject) -> None:
    """What is found has the shapes of z, a covariance that is one, and no gradient."""
    n, most, width = subject.z.shape
    found = subject.infer(noise=0.01)
    wanted = {
        "z": (n, most, width),
        "covariance": (n, most, width, width),
        "identified": (n, most, width),
        "noise": (n,),
    }
    for name, shape in wanted.items():
        got = getattr(found, name)
        sound = tuple(got.shape) == shape and not got.requires_grad and got.isfinite().all()
        what = f"{tuple(got.shape)}, {got.dtype}"
        require(sound, f"{name} must be finite, of shape {shape}, without gradient, got {what}")
    require(str(found.identified.dtype) == "torch.bool", "identified must hold flags")
    require((found.noise >= 0).all(), f"noise must not be negative, got {found.noise}")
    covariance = found.covariance.double()
    scale = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    scaled = (scale[..., None] * covariance * scale[..., None, :]).numpy()
    require_alike(scaled, scaled.swapaxes(-1, -2), "covariance must be symmetric")
    least = np.linalg.eigvalsh(scaled).min(initial=0.0)
    require(least > -1e-6, f"covariance must have no negative eigenvalue, got {least:.3g}")


def check_recovery(subject: CorrectionSubject) -> None:
    """`infer` finds the z that `apply` was given: exactly without noise, roughly with some."""
    corrected = subject.apply(subject.z).detach()
    found = subject.infer()
    error = (subject.apply(found.z.to(subject.z)) - corrected).square().mean().sqrt()
    effect = (corrected - subject.context.path).square().mean().sqrt()
    require(
        error <= 0.05 * effect,
        f"apply with what infer finds must come within 5 % of the path, got {error / effect:.1%}",
    )
    for noise in (0.0, 0.02):
        found = subject.infer(noise=noise)
        size = subject.z.abs().flatten(0, 1).amax(dim=0)
        near = (found.z - subject.z).abs() <= 0.2 * size
        known = found.identified
        share = known.double().mean()
        require(share >= 0.5, f"infer must identify what is plain to see, got {share:.0%} of z")
        right = near[known].double().mean()
        require(
            right >= 0.9, f"infer must find z again where identified, it found {right:.0%} of it"
        )


def check_mask(subject: CorrectionSubject) -> None:
    """What was not measured does not count, and from nothing nothing is identified."""
    observed = subject.apply(subject.z).detach()
    mask = observed == observed
    mask[:, : mask.shape[1] // 8] = False
    results = [
        subject.correction.infer(
            subject.context, observed.where(mask, observed.new_tensor(value)), mask
        )
        for value in (0.0, 1e3)
    ]
    message = "infer must not look at samples where the mask is False"
    require_alike(results[1].z, results[0].z, message)
    blind = subject.correction.infer(subject.context, observed * 0, mask & False)
    require(blind.z.isfinite().all(), "z must be finite even if nothing was measured")
    require(not blind.identified.any(), "nothing is identified where nothing was measured")


def check_arguments_kept(subject: CorrectionSubject) -> None:
    """Arguments stay as they are, the same call gives the same bytes, no generator is touched."""
    observed = subject.apply(subject.z).detach()
    mask = observed == observed
    given = {"path": subject.context.path, "z": subject.z, "observed": observed, "mask": mask}
    before = {name: value.clone() for name, value in given.items()}
    with quiet_randomness():
        first = subject.correction.infer(subject.context, observed, mask)
        second = subject.correction.infer(subject.context, observed, mask)
        subject.apply(subject.z)
    for name, value in given.items():
        require(value.equal(before[name]), f"{name} must not be changed")
    require_same(second.z.numpy(), first.z.numpy(), "infer must give the same bytes again")


CORRECTION_CHECKS: tuple[Callable[[CorrectionSubject], None], ...] = (
    check_protocol,
    check_latent,
    check_zero,
    check_apply,
    check_gradient,
    check_batch,
    check_no_movement,
    check_discrepancy,
    check_recovery,
    check_mask,
    check_arguments_kept,
)


def check_correction(correction: Correction, context: Context, z: Tensor) -> None:
    """Run all `CORRECTION_CHECKS`, see `CorrectionSubject` for the arguments.

    Raises
    ------
    AssertionError: one that lists everything the correction breaks.

    """
    subject = CorrectionSubject(correction, context, z)
    run_checks(CORRECTION_CHECKS, subject, type(correction).__name__)
