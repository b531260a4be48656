"""`Stages`: the progress of a study as one share of all its work, and its stages as they finish."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from retwin.catalog import SOURCES
from retwin.progress import FinishedStage, Report, ResumedStage
from retwin.study.files import Job
from retwin.study.plan import StudyPlan

WORKED = 0.97
"""The share that is done when all jobs are; the rest are the scores and the report."""
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


def expected_seconds(plan: StudyPlan, workers: int) -> float:
    """About how long the jobs of a plan take on so many cores, before they are known exactly."""
    per_source = plan.folds * (SECONDS["residual"] + SECONDS["diagnosis"])
    per_run = SECONDS["surrogate"] + len(plan.sources) * per_source
    once = plan.folds * (SECONDS["fidelity"] + SECONDS["portrait"])
    return (plan.number_of_runs * per_run + once) / workers


@dataclass
class Stages:
    """The progress of a study, from its data to its scores.

    Attributes
    ----------
    report : callable
        Called with the name of the present stage and the share of all work that is done, which
        never falls; once with each `FinishedStage`; and once with a `ResumedStage` if jobs were
        done before.
    expected : float
        The seconds that the jobs are expected to take. The share that is done while the data are
        prepared is the time so far, divided by the time that all work takes at the present speed.
    workers : int
        Jobs at a time.
    clock : callable
        The time in seconds.

    """

    report: Report
    expected: float = 60.0
    workers: int = 1
    clock: Callable[[], float] = time.monotonic
    _shares: dict[Job, float] = field(default_factory=dict)
    _highest: float = 0.0
    _finished: set[str] = field(default_factory=set)
    _begun: dict[str, float] = field(default_factory=dict)
    _started: float = field(init=False)
    _prepared: float = 0.0

    def __post_init__(self) -> None:
        self._started = self.clock()

    def prepare(self, stage: str, share: float) -> None:
        """A share of the data is read or simulated."""
        now = self.clock()
        begun = self._begun.setdefault(stage, now)
        if share > 0 and not self._shares:
            left = (now - begun) * (1 - share) / share
            self._share(stage, self._part(now, left + self.expected))
        else:
            self._share(stage, self._highest)
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
        left = sum(SECONDS[job.kind] for job, share in shares.items() if share < 1) / self.workers
        self._prepared = max(self._highest, self._part(self.clock(), left))
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
        return self._prepared + max(0.0, WORKED - self._prepared) * done / whole

    def _part(self, now: float, left: float) -> float:
        """The share that is done if so many seconds of work are left."""
        spent = now - self._started
        return WORKED * spent / (spent + left) if spent > 0 else 0.0

    def _share(self, stage: str, share: float) -> None:
        self._highest = max(self._highest, share)
        self.report(stage, self._highest)


def _named(job: Job) -> str:
    """The stage of a job: that of all runs and folds."""
    source = SOURCES.get(job.name)
    of = source.title if source else job.name
    return f"{STAGES[job.kind]}: {of}" if of else STAGES[job.kind]
