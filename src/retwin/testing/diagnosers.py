"""The contract of `Diagnoser`: requirements of every classifier of trajectories, as checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.testing.suite import (
    checks_in,
    quiet_randomness,
    require,
    require_alike,
    require_refused,
    require_same,
    run_checks,
)

if TYPE_CHECKING:  # torch takes seconds to load, and twins can be checked without it
    from retwin.diagnosis import Diagnoser


@dataclass(frozen=True, eq=False)
class DiagnoserSubject:
    """A diagnoser, and the trajectories on which it is checked.

    Parameters
    ----------
    diagnoser : Diagnoser
        A fitted one.
    trajectories : Trajectories
        At least two, of the kind on which it was fitted.

    Raises
    ------
    InputError
        If there are fewer than two trajectories.

    """

    diagnoser: Diagnoser
    trajectories: Trajectories

    def __post_init__(self) -> None:
        if len(self.trajectories) < 2:
            got = f"{len(self.trajectories)}"
            remedy = "give a few of the kind on which the diagnoser was fitted"
            raise InputError("trajectories", expected="at least two", got=got, remedy=remedy)

    def predict(self, trajectories: Trajectories | None = None) -> NDArray:
        """Probabilities (n, classes), by default of the subject's trajectories."""
        return self.diagnoser.predict_proba(
            self.trajectories if trajectories is None else trajectories
        )


def check_protocol(subject: DiagnoserSubject) -> None:
    """The diagnoser has `classes`, each named once, and `predict_proba`."""
    from retwin.diagnosis import Diagnoser

    require(
        isinstance(subject.diagnoser, Diagnoser),
        "a diagnoser must have classes and predict_proba, see retwin.Diagnoser",
    )
    classes = subject.diagnoser.classes
    named = isinstance(classes, tuple) and all(isinstance(name, str) for name in classes)
    several = len(classes) == len(set(classes)) >= 2
    require(named and several, f"classes must be a tuple of different names, got {classes!r}")


def check_probabilities(subject: DiagnoserSubject) -> None:
    """There is one probability per class, none is below 0, and they sum to 1."""
    shape = (len(subject.trajectories), len(subject.diagnoser.classes))
    got = subject.predict()
    sound = isinstance(got, np.ndarray) and got.shape == shape and got.dtype.kind == "f"
    require(sound, f"predict_proba must give an array of shape {shape}, got {np.shape(got)}")
    require((got >= 0).all(), f"probabilities must not be below 0, got {got.min()}")
    require_alike(got.sum(axis=1), np.ones(shape[0]), "probabilities must sum to 1")


def check_blindness(subject: DiagnoserSubject) -> None:
    """Labels, names and provenance of trajectories do not change the probabilities."""
    n = len(subject.trajectories)
    expected = subject.predict()
    wrong = np.resize(subject.diagnoser.classes, n)
    for what, given in {
        "the labels": subject.trajectories.replace(labels=wrong),
        "whether there are labels": subject.trajectories.replace(labels=None),
        "the ids": subject.trajectories.replace(ids=[f"another {i}" for i in range(n)]),
        "the provenance": subject.trajectories.replace(provenance=(Provenance("elsewhere"),)),
        "whether they are emulated": subject.trajectories.replace(
            emulated=not subject.trajectories.emulated
        ),
    }.items():
        require_same(subject.predict(given), expected, f"predict_proba must not depend on {what}")


def check_batch(subject: DiagnoserSubject) -> None:
    """Probabilities of a trajectory do not depend on the others, or on their order."""
    whole = subject.predict()
    reversed_ = subject.predict(subject.trajectories[::-1])
    # The relative error of a small probability is that of its log evidence, which iterations know
    # to within their tolerance.
    require_alike(reversed_, whole[::-1], "order must not matter", floor=0.01)
    for i in range(len(whole)):
        alone = subject.predict(subject.trajectories[i : i + 1])
        message = f"trajectory {i} must give the same alone"
        require_alike(alone, whole[i : i + 1], message, floor=0.01)


def check_missing(subject: DiagnoserSubject) -> None:
    """Probabilities are finite where measurements are missing, even if all are."""
    for share in (2, 1):
        mask = subject.trajectories.mask.copy()
        mask[:, : mask.shape[1] // share] = False
        got = subject.predict(subject.trajectories.replace(mask=mask))
        message = f"1/{share} of the measurements missing: probabilities must be finite, sum to 1"
        require(np.isfinite(got).all() and np.allclose(got.sum(axis=1), 1), message)


def check_other_data(subject: DiagnoserSubject) -> None:
    """Channels or a rate other than those of the training set are refused."""
    given = subject.trajectories
    units = given.outputs.units
    other = Channels(tuple(f"not {name}" for name in given.outputs.names), units)
    more = Channels((*given.outputs.names, "one more"), (*units, "1"))
    wide = given.replace(
        nominal=np.concatenate([given.nominal, given.nominal[..., :1]], axis=2),
        observed=np.concatenate([given.observed, given.observed[..., :1]], axis=2),
        mask=np.concatenate([given.mask, given.mask[..., :1]], axis=2),
        outputs=more,
    )
    for what, argument, unsuitable in (
        ("twice the rate", "rate", given.replace(rate=2 * given.rate)),
        ("outputs of other names", "outputs", given.replace(outputs=other)),
        ("an output too many", "outputs", wide),
    ):
        require_refused(
            lambda t=unsuitable: subject.predict(t),  # type: ignore[misc]
            f"trajectories.{argument}",
            what,
        )


def check_same_again(subject: DiagnoserSubject) -> None:
    """The same trajectories give the same bytes, and no global generator is used."""
    with quiet_randomness():
        first, second = subject.predict(), subject.predict()
    require_same(second, first, "predict_proba must give the same bytes again")


DIAGNOSER_CHECKS: tuple[Callable[[DiagnoserSubject], None], ...] = checks_in(globals())


def check_diagnoser(diagnoser: Diagnoser, trajectories: Trajectories) -> None:
    """Run all `DIAGNOSER_CHECKS`.

    Parameters
    ----------
    diagnoser, trajectories
        See `DiagnoserSubject`.

    Raises
    ------
    AssertionError
        A single one that lists every requirement that is violated.

    """
    subject = DiagnoserSubject(diagnoser, trajectories)
    run_checks(DIAGNOSER_CHECKS, subject, type(diagnoser).__name__)
