"""`Stages`: the progress of a study as one share of all its work, and its stages as they finish."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from retwin.catalog import SOURCES
from retwin.progress import FinishedStage, Report, ResumedStage
from retwin.study.files import Job

__all__ = ["Stages"]

PREPARED, WORKED = 0.1, 0.97
"""Shares that are done when the data are prepared, and when all jobs are, as measured for the arm.

Only the time left depends on them, while the data are prepared.
"""
SECONDS = {
    "surrogate": 25.0,
    "residual": 3.0,
    "update": 20.0,
    "diagnosis": 15.0,
    "simulation": 15.0,
    "fidelity": 12.0,
    "portrait": 20.0,
}
"""Seconds of a job on one core by its kind, as measured for the arm: the weight of its share."""
STAGES = {
    "surrogate": "surrogate",
    "residual": "residual model",
    "update": "update of the twin",
    "diagnosis": "diagnoses",
    "simulation": "simulations",
    "fidelity": "fidelity",
    "portrait": "predictive overlay",
}
"""Kinds of jobs in words."""


@dataclass
class Stages:
    """The progress of a study, from its data to its scores.

    Attributes
    ----------
    report : callable
        Called with the name of the present stage and the share of all work that is done, which
        never falls; once with each `FinishedStage`; and once with a `ResumedStage` if jobs were
        done before.

    """

    report: Report
    _shares: dict[Job, float] = field(default_factory=dict)
    _highest: float = 0.0
    _finished: set[str] = field(default_factory=set)
    _begun: dict[str, float] = field(default_factory=dict)

    def prepare(self, stage: str, share: float) -> None:
        """A share of the data is read or simulated.

        How many stages there are is not known, so that each has half of what is left for them.
        """
        begun = self._begun.setdefault(stage, self._highest)
        self._share(stage, begun + max(0.0, PREPARED - begun) / 2 * share)
        if share >= 1.0:
            self.finish(stage)

    def finish(self, stage: str) -> None:
        """A stage is done; the first call counts."""
        if stage not in self._finished:
            self._finished.add(stage)
            self._share(FinishedStage(stage), self._highest)

    def begin(self, shares: Mapping[Job, float]) -> None:
        """The jobs of the study, and which share of each is done already."""
        self._shares = dict(shares)
        if any(shares.values()):
            self._share(ResumedStage("jobs that were done before"), self._done())

    def work(self, job: Job, share: float) -> None:
        """A share of a job is done."""
        before, self._shares[job] = self._shares[job], max(self._shares[job], share)
        self._share(_named(job), self._done())
        if before < 1.0 and all(
            share >= 1.0 for each, share in self._shares.items() if _named(each) == _named(job)
        ):
            self.finish(_named(job))

    def _done(self) -> float:
        """The share of all work that the jobs make, which begin when the data are prepared."""
        whole = sum(SECONDS[each.kind] for each in self._shares)
        done = sum(SECONDS[each.kind] * share for each, share in self._shares.items())
        return PREPARED + (WORKED - PREPARED) * done / whole

    def _share(self, stage: str, share: float) -> None:
        self._highest = max(self._highest, share)
        self.report(stage, self._highest)


def _named(job: Job) -> str:
    """The stage of a job: that of all runs and folds."""
    source = SOURCES.get(job.name)
    of = source.title if source else job.name
    return f"{STAGES[job.kind]}: {of}" if of else STAGES[job.kind]
