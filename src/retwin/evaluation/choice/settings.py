"""`Choice`: which candidates are compared, and at which horizon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from retwin.catalog import CANDIDATES
from retwin.checks import one_of, positive, require
from retwin.twins.faults.actuator_faults import Fault
from retwin.update.corrections import Correction
from retwin.update.dynamics import Dynamics
from retwin.update.residual import Density, Mixture, SequenceMixture
from retwin.update.residual.priors import Priors

MEMBERS = 2
"""Members of a network that is fitted without a part of the records: more lower its error a little,
and take as many times as long."""


class Corrected(Protocol):
    """What says how a twin is corrected, such as a `Case`."""

    @property
    def correction(self) -> Correction:
        """A correction of the outputs or of the commands."""

    @property
    def density(self) -> Density | SequenceMixture:
        """The distribution of z."""

    @property
    def dynamics(self) -> Dynamics:
        """The form of a discrepancy inside state equations."""


@dataclass(frozen=True)
class Choice:
    """Settings of the comparison of candidates.

    Parameters
    ----------
    candidates : sequence of str
        Keys of `retwin.catalog.CANDIDATES` that are compared, the simplest first; by default all
        that the twin and the records allow, and with a `method` those that are simpler than it.
    method : str
        The candidate that is taken whatever the comparison shows; by default the one that it shows.
    forced : bool
        Whether that is so also where a simpler candidate is not clearly worse.
    horizon : float, optional
        Time in s over which predictions from measurements are judged; by default free simulation
        from the commands alone.
    dynamics : Dynamics
        The form of a discrepancy inside state equations.
    correction : Correction, optional
        A correction of the case: per segment, beside a delay and an offset, or per sample, in place
        of `Additive`.
    density, sequence : Density and SequenceMixture
        The distributions of z, one per segment and one per sample.
    yardstick : bool
        Whether models without the twin are fitted as well, to be compared with.
    compare : bool
        Whether candidates are compared; else `method` is fitted to all records, and its bands are
        those of its own fit.
    identified : bool
        Whether the parameters of the twin were identified by these records, so that the twin as it
        is has seen each part that is left out: it is no candidate unless it is named.
    calibrate_on : str or mapping
        The records that are used, see `fit_residual`; only healthy ones are compared.
    prior : Residual, CorrectedTwin, folder, or several of them, optional
        Models of other machines of the kind, for a correction with `CommandSpace`.

    Raises
    ------
    InputError
        An unknown candidate, a horizon that is not positive, or no method where nothing is
        compared.

    """

    candidates: Sequence[str] = ()
    method: str = ""
    forced: bool = True
    horizon: float | None = None
    dynamics: Dynamics = Dynamics()  # noqa: RUF009 - frozen
    correction: Correction | None = None
    density: Density = Mixture()  # noqa: RUF009 - frozen
    sequence: SequenceMixture = SequenceMixture()  # noqa: RUF009 - frozen
    yardstick: bool = False
    compare: bool = True
    identified: bool = False
    calibrate_on: str | Mapping[str, Fault | None] = "healthy"
    prior: Priors | None = None

    @classmethod
    def of(cls, case: Corrected) -> Choice:
        """All candidates, with the forms of the corrections of a case."""
        density, own = case.density, cls()
        return cls(
            dynamics=case.dynamics,
            correction=case.correction,
            density=density if isinstance(density, Density) else own.density,
            sequence=density if isinstance(density, SequenceMixture) else own.sequence,
        )

    @property
    def compared(self) -> bool:
        """Whether there is a comparison: records with faults are not predicted."""
        return self.compare and self.calibrate_on == "healthy"

    @property
    def lighter(self) -> Choice:
        """The same with networks of fewer members, for fits whose means alone are compared."""
        members = min(self.sequence.members, MEMBERS)
        return replace(self, sequence=replace(self.sequence, members=members, refit=False))

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", tuple(self.candidates))
        for name in (*self.candidates, *filter(None, [self.method])):
            one_of("candidates", name, CANDIDATES)
        if self.horizon is not None:
            positive("horizon", self.horizon)
        require(
            self.method or self.compared,
            "method",
            expected="a method where candidates are not compared, or others than healthy records "
            "are used",
            got="none",
            remedy=f"name one of {', '.join(CANDIDATES)}",
        )
