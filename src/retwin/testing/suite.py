"""What the contract suites share: a check takes a subject and raises AssertionError."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.errors import InputError

__all__ = [
    "quiet_randomness",
    "require",
    "require_alike",
    "require_refused",
    "require_same",
    "run_checks",
]

Subject = TypeVar("Subject")


def require(condition: Any, message: str) -> None:
    """AssertionError with that message unless the condition holds; with `python -O` too."""
    if not condition:
        raise AssertionError(message)


def require_same(got: NDArray, wanted: NDArray, message: str) -> None:
    """The same bytes: shape, type and every value."""
    same = got.dtype == wanted.dtype and got.shape == wanted.shape
    require(same and got.tobytes() == wanted.tobytes(), f"{message} ({_apart(got, wanted)})")


def require_alike(
    got: ArrayLike, wanted: ArrayLike, message: str, *, tolerance: float = 1e-5
) -> None:
    """The same up to rounding: `tolerance` times the largest value of each channel (last axis)."""
    got, wanted = np.asarray(got, dtype=float), np.asarray(wanted, dtype=float)
    require(got.shape == wanted.shape, f"{message} (shape {got.shape} and {wanted.shape})")
    size = np.abs(wanted)
    scale = size.max(axis=tuple(range(wanted.ndim - 1)), initial=0.0)
    near = np.abs(got - wanted) <= tolerance * np.maximum(scale, 1e-6 * size.max(initial=0.0))
    require(near.all(), f"{message} ({_apart(got, wanted)})")


def _apart(got: NDArray, wanted: NDArray) -> str:
    if got.shape != wanted.shape:
        return f"shape {got.shape} and {wanted.shape}"
    far = np.abs(got.astype(float) - wanted.astype(float)).max(initial=0.0)
    return f"{got.dtype} and {wanted.dtype}, at most {far:.3g} apart"


def require_refused(call: Callable[[], object], argument: str, what: str) -> None:
    """`call` must raise an InputError of one line that names the argument."""
    try:
        call()
    except InputError as error:
        require(
            error.argument == argument,
            f"{what}: the error must name {argument!r}, it says {str(error)!r}",
        )
        require("\n" not in str(error), f"{what}: the error must be one line, it is {error}")
    except Exception as error:
        raise AssertionError(
            f"{what}: must raise InputError, raised {type(error).__name__}: {error}"
        ) from error
    else:
        raise AssertionError(f"{what}: must raise InputError, was accepted")


@contextmanager
def quiet_randomness() -> Iterator[None]:
    """The global generators of Python, numpy and, if it is loaded, torch must stay as they are."""
    before = _generators()
    yield
    for name, state in _generators().items():
        require(
            name not in before or state == before[name],
            f"the global generator of {name} was used or seeded; use a generator of your own",
        )


def _generators() -> dict[str, object]:
    name, keys, *rest = np.random.get_state()  # noqa: NPY002 - looked at, not drawn from
    states: dict[str, object] = {
        "random": random.getstate(),
        "numpy": (name, np.asarray(keys).tobytes(), *rest),
    }
    if torch := sys.modules.get("torch"):
        states["torch"] = torch.get_rng_state().numpy().tobytes()
    return states


def run_checks(checks: Iterable[Callable[[Subject], None]], subject: Subject, title: str) -> None:
    """Run every check; one AssertionError lists all that is broken."""
    broken = []
    for check in checks:
        try:
            check(subject)
        except AssertionError as error:
            broken.append(f"{check.__name__}: {error}")
        except Exception as error:
            broken.append(f"{check.__name__}: raised {type(error).__name__}: {error}")
    listed = "\n".join(f"- {each}" for each in broken)
    require(not broken, f"{title} breaks its contract:\n{listed}")
