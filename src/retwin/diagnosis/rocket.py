"""A classifier without a trained network: random convolutions, then a ridge (the ROCKET family).

MiniRocket: Dempster, Schmidt and Webb, "MINIROCKET: a very fast (almost) deterministic transform
for time series classification", KDD 2021; here sktime's for several channels. Its kernels sum to
zero and see no constant, but a constant residual is what a biased actuator shows. So the running
sum of the residual, of which a constant is the slope, is given to them as channels of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, softmax
from torch import Tensor

from retwin.data.trajectories import Trajectories
from retwin.diagnosis.features import Features, class_index, class_order
from retwin.errors import InputError
from retwin.nets.networks import Standardise
from retwin.nets.training import Fit
from retwin.progress import Progress
from retwin.serialisation.models import read_model, write_model

__all__ = ["RocketDiagnoser", "fit_rocket"]

KERNELS = 9996
"""The paper's 10 000, in whole lots of its 84 kernels."""

SHORTEST = 9
"""Readings that a kernel spans."""

PENALTIES = np.logspace(-1, 5, 13)
"""Of the ridge; the best is found by leave-one-out."""

NEVER = -2.0
"""The score of a class that was not among the examples; those of the ridge lie about -1 and 1."""

PARAMETERS = ("channels_per_kernel", "channels", "dilations", "per_dilation", "biases")
"""What sktime's transform holds when it is fitted, in its order."""


class RocketDiagnoser:
    """A transform and a linear read-out.

    Parameters
    ----------
    features: what it looks at.
    classes: in the order of the probabilities.
    samples: readings per trajectory that the transform was fitted for.
    weights: by name: those of PARAMETERS, `mean` and `scale` of the features, and of the read-out
        `slope` (classes, kernels) and `level` (classes).
    figures: the `accuracy` and the `log_loss` on what was held out.

    """

    def __init__(
        self,
        features: Features,
        *,
        classes: tuple[str, ...],
        samples: int,
        weights: dict[str, Tensor],
        figures: dict[str, float],
    ) -> None:
        self.features = features
        self.classes = classes
        self.samples = samples
        self.weights = weights
        self.fitted = Fit(figures, {}, 0, "a ridge is solved, not trained")

    @cached_property
    def _transform(self) -> Any:
        """Fitted anew to anything of the right shape, then given its own parameters."""
        transform = _minirocket(len(self.weights["biases"]), seed=0)
        transform.fit(_channels(torch.zeros(1, self.samples, self.features.width)))
        transform.parameters = tuple(self.weights[name].numpy() for name in PARAMETERS)
        return transform

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        standard = (self.features(trajectories) - self.weights["mean"]) / self.weights["scale"]
        if standard.shape[1] != self.samples:
            raise InputError(
                "trajectories.steps",
                expected=f"as many as it was trained on, {self.samples} readings",
                got=f"{standard.shape[1]} readings",
                remedy="cut or pad them to that length",
            )
        convolved = _convolved(self._transform, standard)
        slope, level = (self.weights[name].double().numpy() for name in ("slope", "level"))
        found: NDArray = softmax(convolved @ slope.T + level, axis=1)
        # The comparison with a bias gives a finite share also where a channel is not finite.
        found[~np.isfinite(_channels(standard)).all(axis=(1, 2))] = np.nan
        return found

    def save(self, folder: str | Path) -> None:
        """Write weights and description, see `retwin.serialisation.models`."""
        about = {
            "classes": self.classes,
            **self.features.about(),
            "samples": self.samples,
            "figures": self.fitted.figures,
        }
        with write_model(folder, "rocket", about, self.weights):
            pass

    @classmethod
    def load(cls, folder: str | Path) -> RocketDiagnoser:
        """Read what `save` wrote; InputError when it is not a ROCKET diagnoser or damaged."""
        about, weights = read_model(folder, "rocket")
        return cls(
            Features.of(about),
            classes=tuple(about["classes"]),
            samples=about["samples"],
            weights=weights,
            figures=about["figures"],
        )


def fit_rocket(
    trajectories: Trajectories,
    *,
    seed: int,
    classes: Sequence[str] | None = None,
    rate: float | None = None,
    kernels: int = KERNELS,
    progress: Progress | None = None,
) -> RocketDiagnoser:
    """Fit MiniRocket and a ridge to labelled trajectories; `fit_diagnoser` without a network.

    Parameters
    ----------
    trajectories: labelled; a stratified fifth is held out to scale the probabilities on.
    seed: same seed, same weights on the same machine.
    classes: their order; by default sorted by name.
    rate: samples per second it looks at; by default 10 Hz or the data's, if lower.
    kernels: as many features; a multiple of 84.

    The ridge's penalty is the best by leave-one-out on the four fifths. Its scores become
    probabilities by one temperature, the best on the held-out fifth (Guo et al., ICML 2017).

    Raises
    ------
    InputError: unlabelled trajectories, fewer than two classes, a label not among `classes`, a
        rate that is no whole part of the data's or leaves fewer than nine readings; sktime is not
        installed.

    """
    order = class_order(trajectories, classes)
    features = Features.at(trajectories, rate)
    if trajectories.steps <= (SHORTEST - 1) * features.stride:
        raise InputError(
            "rate",
            expected=f"at least {SHORTEST} readings per trajectory, the length of a kernel",
            got=f"every {features.stride}th of {trajectories.steps} samples",
            remedy="choose a higher rate or give longer trajectories",
        )
    fitted_on, held_out = trajectories.split(0.8, seed=seed)
    before = Standardise(features.width)
    learnt = before.fit(features(fitted_on))(features(fitted_on))
    transform = _minirocket(kernels, seed)
    transform.fit(_channels(learnt))
    convolved = _convolved(transform, learnt)
    if progress is not None:
        progress(0.4)
    slope, level = _ridge(convolved, fitted_on.labels, order)
    scores = _convolved(transform, before(features(held_out))) @ slope.T + level
    truth = class_index(held_out, order).numpy()
    temperature, log_loss = _temperature(scores, truth)
    weights = {
        **dict(zip(PARAMETERS, map(torch.as_tensor, transform.parameters), strict=True)),
        "mean": before.mean,
        "scale": before.scale,
        "slope": torch.as_tensor(slope / temperature),
        "level": torch.as_tensor(level / temperature),
    }
    if progress is not None:
        progress(1.0)
    return RocketDiagnoser(
        features,
        classes=order,
        samples=learnt.shape[1],
        weights=weights,
        figures={"accuracy": float((scores.argmax(1) == truth).mean()), "log_loss": log_loss},
    )


def _ridge(convolved: NDArray, labels: NDArray, order: tuple[str, ...]) -> tuple[NDArray, NDArray]:
    """Slope (classes, kernels) and level (classes) of scores, the classes in our order."""
    from sklearn.linear_model import RidgeClassifierCV

    centre, spread = convolved.mean(axis=0), convolved.std(axis=0)
    spread[spread == 0] = 1.0
    ridge = RidgeClassifierCV(alphas=PENALTIES).fit((convolved - centre) / spread, labels)
    slope = np.atleast_2d(ridge.coef_) / spread
    level = np.atleast_1d(ridge.intercept_) - slope @ centre
    if len(ridge.classes_) == 2:  # two classes give one row
        slope, level = np.concatenate([-slope, slope]), np.concatenate([-level, level])
    whole = np.zeros((len(order), slope.shape[1]))
    levels = np.full(len(order), NEVER)
    for name, row, value in zip(ridge.classes_, slope, level, strict=True):
        whole[order.index(name)], levels[order.index(name)] = row, value
    return whole, levels


def _temperature(scores: NDArray, truth: NDArray) -> tuple[float, float]:
    """What to divide scores (n, classes) by to make them logits, and their mean log loss then."""

    def loss(log_temperature: float) -> float:
        logs = log_softmax(scores / np.exp(log_temperature), axis=1)
        return float(-logs[np.arange(len(truth)), truth].mean())

    best = minimize_scalar(loss, bounds=(-7.0, 3.0), method="bounded")
    return float(np.exp(best.x)), float(best.fun)


def _channels(standard: Tensor) -> NDArray:
    """Features (n, T', 2 d_y) and the running sum of r, channels first: (n, 3 d_y, T').

    Chosen on the emulated arm, 200 generated trajectories per class, 540 emulated ones tested:
    macro-F1 0.72, without the sums 0.60, without ŷ 0.69, with products of ŷ and r besides 0.71.
    MultiRocket has 0.67 with the sums and 0.62 without, at four times the cost; a CNN has 0.79.
    """
    residual = standard[:, :, standard.shape[2] // 2 :]
    # By the root of T', as a sum of so many independent ones grows: a size like the others'.
    sums = residual.cumsum(dim=1) / standard.shape[1] ** 0.5
    return torch.cat([standard, sums], dim=2).transpose(1, 2).contiguous().numpy()


def _convolved(transform: Any, standard: Tensor) -> NDArray:
    """The share of readings (n, kernels) at which each convolution is above its bias."""
    return transform.transform(_channels(standard)).to_numpy().astype(np.float64)


def _minirocket(kernels: int, seed: int) -> Any:
    try:
        from sktime.transformations.rocket import MiniRocketMultivariate
    except ImportError as error:
        raise InputError(
            "rocket",
            expected="the packages sktime and numba for MiniRocket",
            got=str(error),
            remedy='install them: pip install "retwin[rocket]"',
        ) from None
    # sktime takes seeds of 31 bits.
    return MiniRocketMultivariate(num_kernels=kernels, random_state=seed % 2**31)
