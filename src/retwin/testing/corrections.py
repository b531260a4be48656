"""The contract of `Correction`: checks that every operator g must pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from retwin import checks
from retwin.data.segments import Segments
from retwin.data.trajectories import Channels
from retwin.testing.suite import (
    checks_in,
    quiet_randomness,
    require,
    require_alike,
    require_same,
    run_checks,
)

if TYPE_CHECKING:  # the contract of twins needs no torch, which takes seconds to import
    from torch import Tensor

    from retwin.update.corrections import Context, Correction, Discrepancy


@dataclass(frozen=True, eq=False)
class CorrectionSubject:
    """A correction with the trajectories and discrepancies that it is checked on.

    Parameters
    ----------
    correction : Correction
        The operator.
    context : Context
        At least two trajectories, in whose outputs the segments can be identified.
    z : Tensor, shape (n, M, d_z)
        Discrepancies that the operator should be able to infer, 0 for a segment that does not
        exist.

    Raises
    ------
    InputError
        If there are fewer than two trajectories, or not one z for each.

    """

    correction: Correction
    context: Context
    z: Tensor

    def __post_init__(self) -> None:
        checks.require(
            len(self.context) >= 2 and self.z.ndim == 3 and len(self.z) == len(self.context),
            "z",
            expected="shape (n, M, d_z) for n trajectories of the context, n at least 2",
            got=f"{tuple(self.z.shape)} for {len(self.context)}",
            remedy="give a few short trajectories and one z for each",
        )

    @property
    def inputs(self) -> Channels:
        """Numbered channels of the commands, since a context has no names."""
        return Channels.numbered("u", self.context.commands.shape[2])

    @property
    def outputs(self) -> Channels:
        """Numbered channels of the outputs, since a context has no names."""
        return Channels.numbered("y", self.context.path.shape[2])

    def apply(self, z: Tensor, context: Context | None = None) -> Tensor:
        """Corrected outputs (n, T, d_y), by default of the subject's context."""
        return self.correction.apply(context or self.context, z)

    @cached_property
    def clean(self) -> Discrepancy:
        """Discrepancies inferred from corrected outputs without noise, once for all checks."""
        return self.infer()

    def infer(self, *, noise: float = 0.0) -> Discrepancy:
        """Discrepancies inferred from corrected outputs with white noise.

        Parameters
        ----------
        noise : float
            Standard deviation of the noise, in units of the root mean square effect of z.

        Returns
        -------
        Discrepancy
            What `infer` of the correction gives.

        """
        observed = self.apply(self.z).detach()
        effect = (observed - self.context.path).square().mean().sqrt()
        white = np.random.default_rng(0).normal(size=tuple(observed.shape))
        observed = observed + noise * effect * observed.new_tensor(white)
        return self.correction.infer(self.context, observed, observed == observed)


def check_protocol(subject: CorrectionSubject) -> None:
    """The correction has resolution, latent, heads, apply and infer."""
    from retwin.update.corrections import Correction

    require(
        isinstance(subject.correction, Correction),
        "a correction must have resolution, latent, heads, apply, infer; see retwin.Correction",
    )
    resolution = subject.correction.resolution
    valid = resolution in ("segment", "step")
    require(valid, f"resolution must be 'segment' or 'step', got {resolution!r}")


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
    """With z = 0 the outputs do not change."""
    same = subject.apply(subject.z * 0)
    require_alike(same, subject.context.path, "apply with z = 0 must return the path")


def check_apply(subject: CorrectionSubject) -> None:
    """`apply` gives finite outputs of the same shape, and every component of z has an effect."""
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
        require(acts, f"component {component} of z must have an effect")


def check_gradient(subject: CorrectionSubject) -> None:
    """`apply` is differentiable with respect to z."""
    z = subject.z.clone().requires_grad_()
    corrected = subject.apply(z)
    require(corrected.requires_grad, "apply must keep the gradient of z")
    corrected.square().sum().backward()
    require(
        z.grad is not None and z.grad.isfinite().all(),
        "the gradient with respect to z must be finite",
    )
    if z.grad is not None:
        nonzero = z.grad.flatten(0, 1).any(dim=0).tolist()
        require(all(nonzero), f"every component of z must have a gradient, got {nonzero}")


def check_batch(subject: CorrectionSubject) -> None:
    """The results of a trajectory do not depend on the others of the batch.

    An operator with a true `pools` may learn a prior from all trajectories; then this holds for
    `apply` only.
    """
    pools = getattr(subject.correction, "pools", False)
    whole = subject.apply(subject.z).detach()
    found = subject.clean
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


def check_no_segment(subject: CorrectionSubject) -> None:
    """A segment that does not exist is not corrected, and nothing is inferred for it."""
    if subject.correction.resolution != "segment":
        return
    corrected = subject.apply(subject.z).detach()
    mask = corrected == corrected
    bare = replace(subject.context, surrogate_variance=None)  # one per segment, of those that are
    more = replace(bare, segments=_with_another(bare.segments))
    z = subject.z.new_zeros(len(more), more.segments.max_count, subject.z.shape[2])
    z[:, :-1] = subject.z
    message = "a segment that does not exist, z = 0, must change nothing"
    require_alike(subject.apply(z, more), corrected, message)
    found = subject.correction.infer(more, corrected, mask)
    quiet = not found.z[:, -1].any() and not found.identified[:, -1].any()
    require(quiet, "infer must give z = 0, not identified, for a segment that does not exist")
    still = replace(bare, segments=_without_any(bare.segments))
    none = subject.z[:, :0]
    message = "without any segment apply must return the path"
    require_alike(subject.apply(none, still), subject.context.path, message)
    got, wanted = subject.correction.infer(still, corrected, mask).z.shape, none.shape
    require(got == wanted, f"without segments z must have shape {tuple(wanted)}, got {got}")


def _with_another(segments: Segments) -> Segments:
    """The same segments and one more that does not exist."""
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
    """An inferred discrepancy has the shapes of z, a valid covariance, and no gradient."""
    n, count, width = subject.z.shape
    found = subject.infer(noise=0.01)
    wanted = {
        "z": (n, count, width),
        "covariance": (n, count, width, width),
        "identified": (n, count, width),
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
    smallest = np.linalg.eigvalsh(scaled).min(initial=0.0)
    require(smallest > -1e-6, f"covariance must have no negative eigenvalue, got {smallest:.3g}")


def check_recovery(subject: CorrectionSubject) -> None:
    """`infer` recovers the z that `apply` was given, with and without noise."""
    corrected = subject.apply(subject.z).detach()
    error = (subject.apply(subject.clean.z.to(subject.z)) - corrected).square().mean().sqrt()
    effect = (corrected - subject.context.path).square().mean().sqrt()
    require(
        error <= 0.05 * effect,
        f"apply with the inferred z must reproduce the path to 5 %, got {error / effect:.1%}",
    )
    for found in (subject.clean, subject.infer(noise=0.02)):
        size = subject.z.abs().flatten(0, 1).amax(dim=0)
        near = (found.z - subject.z).abs() <= 0.2 * size
        share = found.identified.double().mean()
        require(share >= 0.5, f"infer must identify at least half of z, got {share:.0%}")
        right = near[found.identified].double().mean()
        require(
            right >= 0.9, f"infer must recover z where identified, it recovered {right:.0%} of it"
        )


def check_mask(subject: CorrectionSubject) -> None:
    """Outputs that were not measured have no effect; without any, nothing is identified."""
    observed = subject.apply(subject.z).detach()
    mask = observed == observed
    mask[:, : mask.shape[1] // 8] = False
    results = [
        subject.correction.infer(
            subject.context, observed.where(mask, observed.new_tensor(value)), mask
        )
        for value in (0.0, 1e3)
    ]
    message = "infer must not use samples where the mask is False"
    require_alike(results[1].z, results[0].z, message)
    blind = subject.correction.infer(subject.context, observed * 0, mask & False)
    require(blind.z.isfinite().all(), "z must be finite even if nothing was measured")
    require(not blind.identified.any(), "nothing is identified where nothing was measured")


def check_arguments_kept(subject: CorrectionSubject) -> None:
    """Arguments do not change, results repeat exactly, and global generators are not used."""
    observed = subject.apply(subject.z).detach()
    mask = observed == observed
    given = {"path": subject.context.path, "z": subject.z, "observed": observed, "mask": mask}
    before = {name: value.clone() for name, value in given.items()}
    with quiet_randomness():
        again = subject.correction.infer(subject.context, observed, mask)
        subject.apply(subject.z)
    for name, value in given.items():
        require(value.equal(before[name]), f"{name} must not be changed")
    require_same(again.z.numpy(), subject.clean.z.numpy(), "infer must give the same bytes again")


CORRECTION_CHECKS: tuple[Callable[[CorrectionSubject], None], ...] = checks_in(globals())


def check_correction(correction: Correction, context: Context, z: Tensor) -> None:
    """Run all `CORRECTION_CHECKS`.

    Parameters
    ----------
    correction, context, z : Correction, Context, Tensor
        See `CorrectionSubject`.

    Raises
    ------
    AssertionError
        If the correction violates its contract; the message lists every violation.

    """
    subject = CorrectionSubject(correction, context, z)
    run_checks(CORRECTION_CHECKS, subject, type(correction).__name__)
