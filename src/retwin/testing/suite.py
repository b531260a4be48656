"""Assertions and the runner that the contract suites share."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.errors import InputError

Subject = TypeVar("Subject")


def require(condition: Any, message: str) -> None:
    """Assert a condition, also under `python -O`.

    Parameters
    ----------
    condition : object
        True where the contract is kept.
    message : str
        What the contract requires.

    Raises
    ------
    AssertionError
        The condition is false.

    """
    if not condition:
        raise AssertionError(message)


def require_same(got: NDArray, wanted: NDArray, message: str) -> None:
    """Assert that two arrays have the same shape, type and bytes.

    Parameters
    ----------
    got, wanted : ndarray
        The arrays.
    message : str
        What the contract requires.

    Raises
    ------
    AssertionError
        They differ.

    """
    same = got.dtype == wanted.dtype and got.shape == wanted.shape
    require(same and got.tobytes() == wanted.tobytes(), f"{message} ({_difference(got, wanted)})")


def require_alike(
    got: ArrayLike, wanted: ArrayLike, message: str, *, tolerance: float = 1e-5, floor: float = 1e-6
) -> None:
    """Assert that two arrays are equal up to rounding.

    Parameters
    ----------
    got, wanted : array_like
        The arrays, with channels on the last axis.
    message : str
        What the contract requires.
    tolerance : float, default 1e-5
        Largest difference, relative to the largest magnitude in the channel.
    floor : float, default 1e-6
        What the magnitude of a channel counts as at least, relative to that of all.

    Raises
    ------
    AssertionError
        They differ by more.

    """
    got, wanted = np.asarray(got, dtype=float), np.asarray(wanted, dtype=float)
    require(got.shape == wanted.shape, f"{message} (shape {got.shape} and {wanted.shape})")
    size = np.abs(wanted)
    scale = size.max(axis=tuple(range(wanted.ndim - 1)), initial=0.0)
    near = np.abs(got - wanted) <= tolerance * np.maximum(scale, floor * size.max(initial=0.0))
    require(near.all(), f"{message} ({_difference(got, wanted)})")


def _difference(got: NDArray, wanted: NDArray) -> str:
    """The difference of two arrays in words."""
    if got.shape != wanted.shape:
        return f"shape {got.shape} and {wanted.shape}"
    largest = np.abs(got.astype(float) - wanted.astype(float)).max(initial=0.0)
    return f"{got.dtype} and {wanted.dtype}, which differ by up to {largest:.3g}"


def require_refused(call: Callable[[], object], argument: str, what: str) -> None:
    """Assert that a call is refused by an InputError of one line that names the argument.

    Parameters
    ----------
    call : callable
        The call, without arguments.
    argument : str
        The argument that the error must name.
    what : str
        What is wrong with the argument, for the message.

    Raises
    ------
    AssertionError
        The call returns, or raises something else.

    """
    try:
        call()
    except InputError as error:
        require(
            error.argument == argument,
            f"{what}: the error must name {argument!r}, it is {str(error)!r}",
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
    """Assert that the block leaves the global random generators unchanged.

    They are those of Python, numpy and, if it is loaded, torch.

    Raises
    ------
    AssertionError
        One of them was used or seeded.

    """
    before = _generators()
    yield
    for name, state in _generators().items():
        require(
            name not in before or state == before[name],
            f"the global generator of {name} was used or seeded; use a generator of your own",
        )


def _generators() -> dict[str, object]:
    """States of the global random generators."""
    name, keys, *rest = np.random.get_state()  # noqa: NPY002 - read, not drawn from
    states: dict[str, object] = {
        "random": random.getstate(),
        "numpy": (name, np.asarray(keys).tobytes(), *rest),
    }
    if torch := sys.modules.get("torch"):
        states["torch"] = torch.get_rng_state().numpy().tobytes()
    return states


def checks_in(module: Mapping[str, Any]) -> tuple[Callable[[Any], None], ...]:
    """The contract that a module states, given its names: its functions `check_…`, in order."""
    return tuple(each for name, each in module.items() if name.startswith("check_"))


def run_checks(checks: Iterable[Callable[[Subject], None]], subject: Subject, title: str) -> None:
    """Run every check of a suite.

    Parameters
    ----------
    checks : iterable of callable
        Checks of a subject.
    subject : object
        The subject.
    title : str
        Name of the implementation, for the message.

    Raises
    ------
    AssertionError
        It lists all checks that fail.

    """
    failures = []
    for check in checks:
        try:
            check(subject)
        except AssertionError as error:
            failures.append(f"{check.__name__}: {error}")
        except Exception as error:
            failures.append(f"{check.__name__}: raised {type(error).__name__}: {error}")
    listed = "\n".join(f"- {each}" for each in failures)
    require(not failures, f"{title} breaks its contract:\n{listed}")
