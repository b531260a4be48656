"""What the real records look like: findings, and pictures of those that have some."""

from __future__ import annotations

from typing import Any

from retwin.data.quality.check import Checked
from retwin.data.quality.finding import Finding
from retwin.data.trajectories import Channels, Trajectories
from retwin.report.blocks import Section
from retwin.report.records import TITLE, records_part
from retwin.report.study import Study

SHOWN = ("commands", "nominal", "observed", "mask", "ids")
"""The arrays `records/…` of the records that have findings."""


def records(study: Study) -> Section | None:
    """Of all real records; None in results that do not have them."""
    found, arrays = study.results.records, study.arrays
    if not found:
        return None
    own: dict[str, Any] = {name: arrays[f"records/{name}"] for name in SHOWN}
    shown = Trajectories(
        **own,
        rate=float(arrays["records/rate"]),
        inputs=Channels.of(vars(study.results.inputs)),
        outputs=Channels.of(vars(study.results.outputs)),
    )
    findings = tuple(Finding(**each) for each in found["findings"])
    part = records_part(Checked(shown, findings, found["explained"]))
    return Section("records", TITLE, {"part": part}, [part.figure] if part.figure else [])
