"""The progress of a study: one share that never falls, and every stage once when it is done."""

from __future__ import annotations

from itertools import count, pairwise

from retwin.progress import FinishedStage, ResumedStage
from retwin.study.files import Job
from retwin.study.progress import Stages

JOBS = [
    Job("surrogate", 0),
    Job("residual", 0, 0, "output"),
    Job("residual", 0, 1, "output"),
    Job("diagnosis", 0, 0, "ibg_rg"),
    Job("diagnosis", 0, 1, "ibg_rg"),
]


def reported(*, done: int = 0) -> list[tuple[str, float]]:
    """What a study reports whose first jobs are done already."""
    shares: list[tuple[str, float]] = []
    ticks = count()
    stages = Stages(
        lambda stage, share: shares.append((stage, share)), clock=lambda: float(next(ticks))
    )
    for share in (0.0, 0.5, 1.0):
        stages.prepare("twin data", share)
    stages.prepare("real data", 0.2)
    stages.begin({job: float(place < done) for place, job in enumerate(JOBS)})
    for job in JOBS[done:]:
        for share in (0.0, 0.6, 0.3, 1.0):
            stages.work(job, share)
    stages.prepare("scores", 0.0)
    stages.finish("scores")
    return shares


def test_the_share_never_falls_and_jobs_are_almost_all_of_it() -> None:
    shares = [share for _, share in reported()]
    assert all(a <= b for a, b in pairwise(shares))
    assert shares[0] == 0.0
    assert 0.9 < shares[-1] < 1.0


def test_each_stage_ends_once_when_all_runs_and_folds_are_done() -> None:
    ended = [stage for stage, _ in reported() if isinstance(stage, FinishedStage)]
    assert len(ended) == len(set(ended)) == 5
    assert ended[:3] == ["twin data", "surrogate", "residual model: output"]
    assert ended[3].startswith("diagnoses: ")
    assert ended[4] == "scores"
    last = max(i for i, (stage, _) in enumerate(reported()) if stage == "residual model: output")
    assert sum(stage == "residual model: output" for stage, _ in reported()[:last]) >= 8


def test_what_was_done_before_is_not_done_again() -> None:
    ended = [stage for stage, _ in reported(done=3) if isinstance(stage, FinishedStage)]
    assert "surrogate" not in ended
    shares = [share for stage, share in reported(done=3) if stage.startswith("diagnoses")]
    assert shares[0] > 0.4
    assert not any(isinstance(stage, ResumedStage) for stage, _ in reported())
    (resumed,) = (share for stage, share in reported(done=3) if isinstance(stage, ResumedStage))
    assert resumed == shares[0]


def test_every_file_that_is_read_moves_the_share() -> None:
    shares: list[float] = []
    ticks = count()
    stages = Stages(lambda stage, share: shares.append(share), 100.0, clock=lambda: next(ticks))
    for stage in ("real.mat", "twin data", "third"):
        for share in (0.0, 0.5, 1.0):
            stages.prepare(stage, share)
    assert len(set(shares)) == 7
    assert shares[-1] < 0.1


def test_the_time_left_is_known_while_data_are_read() -> None:
    """Data that take 40 s before jobs that take 20 s: at half of the data, a third is done."""
    shares: list[float] = []
    now = [0.0]
    stages = Stages(lambda stage, share: shares.append(share), 20.0, clock=lambda: now[0])
    stages.prepare("twin data", 0.0)
    for share in (0.25, 0.5, 1.0):
        now[0] = 40 * share
        stages.prepare("twin data", share)
        left = now[0] * (1 - shares[-1]) / shares[-1]
        assert 60 - now[0] <= left < 1.1 * (62 - now[0])
