"""`Portable`: a bundle's ONNX export, on onnxruntime and numpy alone: torch is never loaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels, Trajectories
from retwin.deploy.bundle.facts import Facts
from retwin.deploy.bundle.seal import distrusting, read_sealed
from retwin.deploy.bundle.verdicts import Domain, Prediction, distributions
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.twin import Chunk, checked_commands, checked_seed, simulate_in_chunks

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

__all__ = ["Portable", "padded_times", "settled_at"]

GRAPHS = ("surrogate", "residual", "correction", "guard")
"""Those that every export has."""
EXPORTED = "a graph that retwin bundle export wrote"
REMEDY = "make it anew with retwin bundle export"


@dataclass(frozen=True)
class Reader:
    """The sensor's period, and the samples of which one is its first reading's."""

    every: int
    phases: tuple[int, ...]


@dataclass(frozen=True)
class Judge:
    """What a diagnoser looks at and tells; `settled`: readings that its start stays hidden for."""

    classes: tuple[str, ...]
    stride: int
    settled: int | None


@dataclass(frozen=True, eq=False)
class Portable:
    """Predicts as the `Bundle` it was exported from; and simulates, as any `Twin`.

    Attributes
    ----------
    graphs: name to a function from named arrays to an array.
    facts: what it keeps of its case.
    inputs, outputs, rate: channels and samples per second.
    domain: ranges and limits of the guard.
    stride: every how many samples the guard holds the nominal path against the surrogate.
    sensor, diagnoser: how their graphs are used; None where there are none.
    emulated: whether it was fitted to a stand-in for the real system.
    provenance: versions and data, as the bundle's.

    """

    graphs: Mapping[str, Graph]
    facts: Facts
    inputs: Channels
    outputs: Channels
    rate: float
    domain: Domain
    stride: int = 1
    sensor: Reader | None = None
    diagnoser: Judge | None = None
    emulated: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: str | Path, *, threads: int = 1) -> Portable:
        """Read what `export_onnx` wrote, after its seal was verified.

        Parameters
        ----------
        folder: the export.
        threads: of onnxruntime; more than one pays for large batches only.

        Raises
        ------
        InputError: a file that was changed, is missing or was added; another kind or schema; no
            graphs; onnxruntime is not installed.

        """
        runtime = _runtime()
        about = read_sealed(folder, "portable")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # what is wrong is raised, not printed
        with distrusting(folder, expected="the ONNX export of a bundle", remedy=REMEDY):
            sensor, judge = _reader(about["sensor"]), _judge(about["diagnoser"])
            names = [*GRAPHS, *["sensor"] * bool(sensor), *["features", "diagnoser"] * bool(judge)]
            files = {name: Path(folder) / f"{name}.onnx" for name in names}
            return cls(
                graphs={
                    name: Graph(
                        runtime.InferenceSession(file, options, ["CPUExecutionProvider"]), file
                    )
                    for name, file in files.items()
                },
                facts=Facts.of(about),
                inputs=Channels.of(about["inputs"]),
                outputs=Channels.of(about["outputs"]),
                rate=float(about["rate"]),
                domain=Domain.of(about["domain"]),
                stride=int(about["stride"]),
                sensor=sensor,
                diagnoser=judge,
                emulated=bool(about["emulated"]),
                provenance=dict(about["provenance"]),
            )

    def predict(self, trajectories: Trajectories) -> Prediction:
        """Diagnose trajectories, see `Bundle.predict`; they are as long as those it was made for.

        Raises
        ------
        InputError: an export without a diagnoser; other channels or another rate than it was made
            for, or no commands; another length that is not outside; a graph whose output has
            another shape, is not finite, or is no probabilities.

        """
        judge = self.diagnoser
        if judge is None:
            raise InputError(
                "bundle",
                expected="one with a diagnoser",
                got="one without",
                remedy="train a diagnoser, then make the bundle and its export anew",
            )
        self._check(trajectories)
        verdicts = self.domain.judge(
            trajectories, self._mismatch, self._energy, steps=self.facts.steps
        )
        return Prediction.of(
            judge.classes, verdicts, trajectories, partial(self._probabilities, judge)
        )

    def _mismatch(self, trajectories: Trajectories) -> NDArray:
        """See `Guard.mismatch`."""
        self._fits(trajectories.steps, 0)
        every = slice(None, None, self.stride)
        nominal = trajectories.nominal[:, every]
        commands = _single(trajectories.commands[:, every])
        predicted = self.graphs["surrogate"].checked(nominal.shape, commands=commands)
        return self.domain.differences(nominal, predicted)

    def _energy(self, trajectories: Trajectories) -> NDArray:
        """See `Guard.energy`."""
        return self.graphs["guard"].checked((len(trajectories),), **_seen(trajectories))

    def _probabilities(self, judge: Judge, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes) as the diagnoser gives them."""
        settled = settled_at(trajectories, judge.stride, judge.settled)
        features = self.graphs["features"](**_seen(trajectories), settled=settled)
        shape = len(trajectories), len(judge.classes)
        found = self.graphs["diagnoser"].checked(shape, features=features).astype(np.float64)
        if not distributions(found).all():
            raise self.graphs["diagnoser"].refused("numbers that are no probabilities")
        return found

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`; the law of `CorrectedTwin.simulate`, other draws for the same seed.

        Raises InputError beside, for another length or more movements than it was made for.
        """
        rng = np.random.default_rng(checked_seed(seed))
        checked = _single(checked_commands(commands, self.inputs))
        self._fits(checked.shape[1], Segments.from_commands(checked).max_count)

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            return self._corrected(chunk, self._noise(len(chunk.commands), rng))

        return simulate_in_chunks(
            self,
            run,
            checked,
            faults,
            seed=seed,
            progress=progress,
            emulated=self.emulated,
        )

    def _noise(self, count: int, rng: np.random.Generator) -> dict[str, NDArray]:
        """What the graphs of the residual model and of the sensor take, for `count` trajectories.

        Each is independent: `uniform` (n, M, blocks), `own` (n, M, d_z) and `common` (n, 1, d_z)
        of the residual model; `phase` (n, 1), `level` (n, R, d_y), `chance` (n, R, 1) and `glitch`
        (n, R, d_y) of a sensor. `uniform`, `level` and `chance` are uniform on [0, 1); `own`,
        `common` and `glitch` are standard normal.
        """
        residual = self.graphs["residual"]
        blocks, size = residual.width("uniform"), residual.width("own")
        moves = count, self.facts.movements
        noise: dict[str, NDArray] = {
            "uniform": rng.random((*moves, blocks), np.float32),
            "own": rng.standard_normal((*moves, size), np.float32),
            "common": rng.standard_normal((count, 1, size), np.float32),
        }
        if self.sensor is None:
            return noise
        readings = count, -(-self.facts.steps // self.sensor.every)
        width = len(self.outputs)
        return noise | {
            "phase": rng.choice(self.sensor.phases, size=(count, 1)).astype(np.int64),
            "level": rng.random((*readings, width), np.float32),
            "chance": rng.random((*readings, 1), np.float32),
            "glitch": rng.standard_normal((*readings, width), np.float32),
        }

    def _corrected(self, chunk: Chunk, noise: Mapping[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Nominal outputs, and corrected and recorded ones, as this `_noise` has them."""
        nominal = self.graphs["surrogate"](commands=chunk.commands)
        moves = padded_times(chunk.segments, self.facts.movements)
        z = self.graphs["residual"](commands=chunk.commands, nominal=nominal, **moves, **noise)
        outputs = self.graphs["correction"](
            told=_single(chunk.faulty_commands), frozen=chunk.frozen.astype(np.int64), **moves, z=z
        )
        if self.sensor is None:
            return nominal, outputs
        return nominal, self.graphs["sensor"](outputs=outputs, **noise)

    def _check(self, trajectories: Trajectories) -> None:
        for name in ("inputs", "outputs", "rate"):
            ours, theirs = getattr(self, name), getattr(trajectories, name)
            if ours != theirs:
                raise InputError(
                    f"trajectories.{name}",
                    expected=f"what the bundle was made for, {ours}",
                    got=f"{theirs}",
                    remedy="resample or rename, and read files with their case",
                )

    def _fits(self, steps: int, movements: int) -> None:
        if steps != self.facts.steps or movements > self.facts.movements:
            raise InputError(
                "trajectories",
                expected=f"{self.facts.steps} samples and at most {self.facts.movements} movements",
                got=f"{steps} samples, {movements} movements",
                remedy="cut them, or use the bundle with torch, which takes any length",
            )


class Graph:
    """A session of onnxruntime as a function of named arrays; what it does not take is left out."""

    def __init__(self, session: InferenceSession, file: Path) -> None:
        self.session = session
        self.file = file
        self.inputs = {each.name: each.shape for each in session.get_inputs()}

    def __call__(self, **arrays: NDArray) -> NDArray:
        """The one output; InputError where the graph does not run."""
        given = {name: array for name, array in arrays.items() if name in self.inputs}
        with distrusting(self.file, expected=EXPORTED, remedy=REMEDY):
            result: NDArray = self.session.run(None, given)[0]
        return result

    def checked(self, shape: tuple[int, ...], **arrays: NDArray) -> NDArray:
        """The output for arrays of usual size; InputError if it has another shape or NaN."""
        result = self(**arrays)
        if result.shape != shape:
            raise self.refused(f"an output of shape {result.shape} for {shape}")
        if not np.isfinite(result).all():
            raise self.refused("an output that is not finite")
        return result

    def refused(self, got: str) -> InputError:
        """The error for an output that no graph of `export_onnx` has."""
        return InputError(str(self.file), expected=EXPORTED, got=got, remedy=REMEDY)

    def width(self, name: str) -> int:
        """Size of the last axis of an input."""
        return int(self.inputs[name][-1])


def _runtime() -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise InputError(
            "onnx",
            expected="the package onnxruntime",
            got="an installation without it",
            remedy='install it: pip install "retwin[onnx]", or pip install onnxruntime',
        ) from None
    return onnxruntime


def _reader(about: Mapping[str, Any] | None) -> Reader | None:
    if about is None:
        return None
    every = int(about["every"])
    return Reader(every, tuple(int(phase) for phase in about["phases"] or range(every)))


def _judge(about: Mapping[str, Any] | None) -> Judge | None:
    if about is None:
        return None
    settled = about["settled"]
    names = tuple(str(name) for name in about["classes"])
    return Judge(names, int(about["stride"]), None if settled is None else int(settled))


def _seen(trajectories: Trajectories) -> dict[str, NDArray]:
    """The inputs of the graphs that look at trajectories."""
    return {
        "nominal": _single(trajectories.nominal),
        "observed": _single(trajectories.observed),
        "mask": trajectories.mask,
    }


def _single(values: NDArray) -> NDArray:
    return np.ascontiguousarray(values, dtype=np.float32)


def padded_times(segments: Segments, movements: int) -> dict[str, NDArray]:
    """Times of movements (n, movements), padded as `Segments` pads."""
    missing = ((0, 0), (0, movements - segments.max_count))
    padded = {
        name: _single(np.pad(getattr(segments, name), missing, constant_values=segments.steps))
        for name in ("start", "settle", "stop")
    }
    return {**padded, "valid": np.pad(segments.valid, missing)}


def settled_at(trajectories: Trajectories, stride: int, margin: int | None) -> NDArray:
    """The sample (n, 1) until which the start is hidden, see `Features`; 0 where it is shown."""
    last = trajectories.steps - 1
    if margin is None:
        return np.zeros((len(trajectories), 1), dtype=np.int64)
    segments = Segments.from_commands(trajectories.commands)
    if segments.max_count == 0:
        return np.full((len(trajectories), 1), last)
    end = np.ceil(segments.settle[:, :1]).astype(np.int64) + margin * stride
    return np.minimum(end, last)
