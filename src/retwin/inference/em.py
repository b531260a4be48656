"""Expectation-maximisation: latent variables and hyperparameters in turn."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

State = TypeVar("State")
Hyper = TypeVar("Hyper")


def expectation_maximisation(
    state: State,
    hyper: Hyper,
    *,
    infer: Callable[[State, Hyper], State],
    learn: Callable[[State, Hyper], Hyper],
    rounds: int,
    converged: Callable[[Hyper, Hyper], bool] | None = None,
) -> tuple[State, Hyper]:
    """Type-II maximum likelihood of hyperparameters (empirical Bayes).

    Parameters
    ----------
    state, hyper
        Latent variables and hyperparameters to begin with, of any type.
    infer : callable
        The latent variables for some hyperparameters, from the previous ones on.
    learn : callable
        The most probable hyperparameters for some latent variables, from the previous ones on.
    rounds : int
        Times that both are done, at most.
    converged : callable, optional
        Whether hyperparameters are near enough to the previous ones to end.

    References
    ----------
    Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1 (1977).

    """
    for _ in range(rounds):
        state = infer(state, hyper)
        previous, hyper = hyper, learn(state, hyper)
        if converged is not None and converged(hyper, previous):
            break
    return state, hyper
