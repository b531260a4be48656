"""Contract suites: checks that every twin, correction and diagnoser must pass, for users too.

Belongs here: checks that take an implementation and its subject. Not here: tests of this package.

A suite is a tuple of checks. A check takes a subject and raises AssertionError with the violation.
With pytest, which is optional:

    SUBJECT = TwinSubject(MyTwin(), commands)

    @pytest.mark.parametrize("check", TWIN_CHECKS, ids=lambda check: check.__name__)
    def test_contract(check):
        check(SUBJECT)

Without pytest, `check_twin(MyTwin(), commands)` runs them all and lists every failure.
"""

from __future__ import annotations

from retwin.testing.corrections import CORRECTION_CHECKS, CorrectionSubject, check_correction
from retwin.testing.diagnosers import DIAGNOSER_CHECKS, DiagnoserSubject, check_diagnoser
from retwin.testing.twin_subject import TwinSubject
from retwin.testing.twins import TWIN_CHECKS, check_twin

__all__ = [
    "CORRECTION_CHECKS",
    "DIAGNOSER_CHECKS",
    "TWIN_CHECKS",
    "CorrectionSubject",
    "DiagnoserSubject",
    "TwinSubject",
    "check_correction",
    "check_diagnoser",
    "check_twin",
]
