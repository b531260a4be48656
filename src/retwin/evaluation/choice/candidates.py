"""`Candidates`: models of increasing complexity that a twin and some records allow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from retwin.data.segments import Segments
from retwin.data.trajectories import Trajectories
from retwin.evaluation.choice.settings import Choice
from retwin.progress import Progress
from retwin.twins.commands.record_sampler import moves_and_rests
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import Additive, Correction, DelayOffset
from retwin.update.dynamics import (
    DynamicsTwin,
    FittedDynamics,
    estimate_noise,
    fit_dynamics,
    state_names,
)
from retwin.update.identification import LeastSquares, Updated, identify
from retwin.update.residual import StationaryNoise, fit_residual

Model = CorrectedTwin | DynamicsTwin


@dataclass(frozen=True, eq=False)
class Candidates:
    """The candidates that are fitted to the same records; what two of them share is fitted once.

    Attributes
    ----------
    twin : Twin
        The twin as it is given, or a surrogate of it.
    records : Trajectories
        Those that are used, with commands.
    settings : Choice
        The forms of the corrections.
    seed : int
        Of networks and searches.
    case : str
        The case that the models name.
    original : Twin, optional
        The twin of a surrogate, by which its error is measured.
    progress : callable, optional
        Called with the share of a fit that is done.

    """

    twin: Twin
    records: Trajectories
    settings: Choice
    seed: int
    case: str = ""
    original: Twin | None = None
    progress: Progress | None = None

    @property
    def fits(self) -> dict[str, Callable[[], Model]]:
        """The candidates that the twin and the records allow, the simplest first."""
        wanted, made = self.settings.candidates, dict[str, Callable[[], Model]]()
        named = "none" in (*wanted, self.settings.method)
        if named or not (self.settings.identified and self.free is not None):
            made["none"] = self.none
        if self.free is not None:
            made["parameters"] = self.parameters
        if self._has_segments("delay_offset"):
            made["delay_offset"] = lambda: self.per_segment(DelayOffset())
        if state_names(self.twin):
            made["dynamics"] = lambda: self.dynamics
        own = self.settings.correction
        own = own if own is not None and own.resolution == "segment" else None
        if own is not None and own != DelayOffset() and self._has_segments("segments"):
            made["segments"] = lambda: self.per_segment(own)
        made["output"] = lambda: self.per_sample(self.identified)
        if state_names(self.twin):
            made["dynamics_output"] = lambda: self.per_sample(self.dynamics)
        return {name: fit for name, fit in made.items() if not wanted or name in wanted}

    @property
    def free(self) -> ParametricTwin | None:
        """The twin with its free parameters; None where it has none."""
        if isinstance(self.twin, StateTwin):
            return self.twin.parametric() if self.twin.free else None
        return self.twin if isinstance(self.twin, ParametricTwin) else None

    def _has_segments(self, name: str) -> bool:
        """Whether the commands move and rest, which a correction per segment needs."""
        if name == self.settings.method:
            return True
        segments = Segments.from_commands(self.records.commands).until(self.records.lengths)
        return bool(moves_and_rests(segments))

    @cached_property
    def updated(self) -> Updated | None:
        """The twin with its parameters identified; None where it has none."""
        if self.free is None:
            return None
        return identify(self.free, self.records, LeastSquares(starts=1), seed=self.seed)

    @property
    def identified(self) -> Twin:
        """The same as a twin, or the twin as it is."""
        return self.twin if self.updated is None else self.updated.twin

    @cached_property
    def learned(self) -> FittedDynamics:
        """Corrected state equations, whose parameters keep their values, and what they learned."""
        return fit_dynamics(
            self.identified,  # type: ignore[arg-type]
            self.records,
            replace(self.settings.dynamics, held=True),
            progress=self.progress,
        )

    @property
    def dynamics(self) -> DynamicsTwin:
        """Corrected state equations."""
        return replace(self.learned.twin, case=self.case)

    def keep_equations(self, name: str) -> DynamicsTwin:
        """The state equations of "none" or "parameters", with noise of states and outputs."""
        own = self.twin if name == "none" else self.identified
        return replace(estimate_noise(own, self.records), case=self.case)  # type: ignore[arg-type]

    def none(self) -> CorrectedTwin:
        """The twin as it is, with its errors as noise."""
        return self._noisy(self.twin)

    def parameters(self) -> CorrectedTwin:
        """The twin with identified parameters, with its errors as noise."""
        return self._noisy(self.identified)

    def per_sample(self, twin: Twin) -> CorrectedTwin:
        """A twin whose outputs are corrected at every sample."""
        own = self.settings.correction
        stepwise = own if own is not None and own.resolution == "step" else Additive()
        return self._correct(twin, stepwise, self.settings.sequence)

    def per_segment(self, correction: Correction) -> CorrectedTwin:
        """The twin with a correction that has one z per segment."""
        return self._correct(self.identified, correction, self.settings.density)

    def _noisy(self, twin: Twin) -> CorrectedTwin:
        return self._correct(twin, Additive(), StationaryNoise())

    def _correct(self, twin: Twin, correction: Correction, density: object) -> CorrectedTwin:
        learns = correction is self.settings.correction  # what machines have in common
        residual = fit_residual(
            twin,
            self.records,
            correction,
            density,  # type: ignore[arg-type]
            seed=self.seed,
            calibrate_on=self.settings.calibrate_on,
            twin=self.original,
            prior=self.settings.prior if learns else None,
            progress=self.progress,
        )
        return CorrectedTwin(twin, residual, self.case)  # type: ignore[arg-type]
