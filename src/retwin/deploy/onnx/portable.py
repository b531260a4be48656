"""`Portable`: a bundle's ONNX export, used with onnxruntime; torch is never imported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import needs_extra, require, whole
from retwin.data.segments import Segments
from retwin.data.trajectories import Channels, Trajectories
from retwin.deploy.bundle.facts import Facts
from retwin.deploy.bundle.seal import open_sealed
from retwin.deploy.bundle.verdicts import (
    Domain,
    Prediction,
    are_probabilities,
    check_channels,
    present_diagnoser,
)
from retwin.deploy.onnx.session import Session, bounded_options
from retwin.progress import Progress
from retwin.times import sample_rate
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Chunk, checked_commands, checked_seed, simulate_in_chunks

GRAPHS = ("surrogate", "residual", "correction", "guard")
"""Names of the graphs that every export has."""


@dataclass(frozen=True)
class Sensor:
    """Settings of the sensor's graph.

    Attributes
    ----------
    every : int
        Samples from one measurement to the next.
    phases : tuple of int
        Possible indices of the first measured sample.

    """

    every: int
    phases: tuple[int, ...]

    @classmethod
    def of(cls, about: Mapping[str, Any], steps: int) -> Sensor:
        """The settings from JSON values, for trajectories of so many samples."""
        every = whole("sensor.every", about["every"], at_least=1, at_most=steps)
        phases = about["phases"] or range(every)
        return cls(
            every, tuple(whole("sensor.phases", phase, at_most=every - 1) for phase in phases)
        )


@dataclass(frozen=True)
class Classifier:
    """Settings of the diagnoser's graphs.

    Attributes
    ----------
    classes : tuple of str
        Names of the classes.
    stride : int
        Samples from one feature to the next.
    settled : int or None
        Features after the first motion until which the start is hidden; None if it is not.

    """

    classes: tuple[str, ...]
    stride: int
    settled: int | None

    @classmethod
    def of(cls, about: Mapping[str, Any], steps: int) -> Classifier:
        """The settings from JSON values, for trajectories of so many samples."""
        settled = about["settled"]
        return cls(
            tuple(str(name) for name in about["classes"]),
            whole("diagnoser.stride", about["stride"], at_least=1, at_most=steps),
            None if settled is None else whole("diagnoser.settled", settled, at_most=steps),
        )


@dataclass(frozen=True, eq=False)
class Portable:
    """A bundle's export, which predicts as the `Bundle` does and simulates as any `Twin` does.

    Attributes
    ----------
    graphs : mapping of str to Session
        Functions from named arrays to an array.
    facts : Facts
        The values of the case that are kept.
    inputs, outputs : Channels
        Channels of commands and outputs.
    rate : float
        Sample rate in Hz.
    domain : Domain
        Ranges and limits of the guard.
    stride : int
        Samples from one to the next at which the guard compares nominal outputs and surrogate.
    sensor : Sensor or None
        Settings of the sensor; None if there is none.
    diagnoser : Classifier or None
        Settings of the diagnoser; None if there is none.
    emulated : bool
        Whether the bundle was fitted to an emulation of the real system.
    provenance : mapping
        Versions and data, as in the bundle.

    """

    graphs: Mapping[str, Session]
    facts: Facts
    inputs: Channels
    outputs: Channels
    rate: float
    domain: Domain
    stride: int = 1
    sensor: Sensor | None = None
    diagnoser: Classifier | None = None
    emulated: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.facts.check_classes(self.diagnoser)

    @classmethod
    def load(cls, folder: str | Path, *, threads: int = 1) -> Portable:
        """Read what `export_onnx` wrote, after its seal was verified.

        Parameters
        ----------
        folder : path
            Folder of the export.
        threads : int
            Threads of onnxruntime; more than one helps with large batches only.

        Returns
        -------
        Portable
            The export, ready to predict and to simulate.

        Raises
        ------
        InputError
            If onnxruntime is not installed; if a file was changed, removed or added; if the folder
            is of another kind or schema; or if it is sealed and holds no graphs.

        """
        runtime = needs_extra("onnxruntime", "onnx", "runs the graphs")
        options = bounded_options(runtime)
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # errors are raised, and need not be printed too
        with open_sealed(folder, "portable") as about:
            facts = Facts.of(about)
            sensor, classifier = about["sensor"], about["diagnoser"]
            sensor = None if sensor is None else Sensor.of(sensor, facts.steps)
            classifier = None if classifier is None else Classifier.of(classifier, facts.steps)
            names = [*GRAPHS, *["sensor"] * bool(sensor)]
            names += ["features", "diagnoser"] * bool(classifier)
            files = {name: Path(folder) / f"{name}.onnx" for name in names}
            return cls(
                graphs={
                    name: Session(
                        runtime.InferenceSession(file, options, ["CPUExecutionProvider"]), file
                    )
                    for name, file in files.items()
                },
                facts=facts,
                inputs=Channels.of(about["inputs"]),
                outputs=Channels.of(about["outputs"]),
                rate=sample_rate("rate", about["rate"]),
                domain=Domain.of(about["domain"]),
                stride=whole("stride", about["stride"], at_least=1, at_most=facts.steps),
                sensor=sensor,
                diagnoser=classifier,
                emulated=bool(about["emulated"]),
                provenance=dict(about["provenance"]),
            )

    def predict(self, trajectories: Trajectories) -> Prediction:
        """Diagnose trajectories, and flag those that the bundle was not made for.

        Parameters
        ----------
        trajectories : Trajectories
            The n trajectories, with commands, as long as those of the bundle.

        Returns
        -------
        Prediction
            Probabilities and verdicts, as from `Bundle.predict`.

        Raises
        ------
        InputError
            If the export has no diagnoser; if channels, rate or length are not those of the bundle;
            or if the output of a graph has another shape, is not finite, or is no probabilities.

        """
        classifier = present_diagnoser(self.diagnoser)
        check_channels(trajectories, self)
        verdicts = self.domain.assess(
            trajectories, self._mismatch, self._energy, steps=self.facts.steps
        )
        return Prediction.of(
            classifier.classes, verdicts, trajectories, partial(self._probabilities, classifier)
        )

    def _mismatch(self, trajectories: Trajectories) -> NDArray:
        """See `Guard.mismatch`."""
        self._check_size(trajectories.steps, 0)
        every = slice(None, None, self.stride)
        nominal = trajectories.nominal[:, every]
        commands = _single(trajectories.commands[:, every])
        predicted = self.graphs["surrogate"].checked(nominal.shape, commands=commands)
        return self.domain.differences(nominal, predicted)

    def _energy(self, trajectories: Trajectories) -> NDArray:
        """See `Guard.energy`."""
        return self.graphs["guard"].checked((len(trajectories),), **_outputs(trajectories))

    def _probabilities(self, classifier: Classifier, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes) from the diagnoser's graph."""
        settled = settled_at(trajectories, classifier.stride, classifier.settled)
        features = self.graphs["features"](**_outputs(trajectories), settled=settled)
        shape = len(trajectories), len(classifier.classes)
        found = self.graphs["diagnoser"].checked(shape, features=features).astype(np.float64)
        if not are_probabilities(found).all():
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
        """See `Twin.simulate`.

        The distribution is that of `CorrectedTwin.simulate`; draws of the same seed differ.

        Raises
        ------
        InputError
            If `Twin.simulate` raises it; or if trajectories have another length or more segments
            than those of the bundle.

        """
        rng = np.random.default_rng(checked_seed(seed))
        checked = _single(checked_commands(commands, self.inputs))
        self._check_size(checked.shape[1], Segments.from_commands(checked).max_count)

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            return self._corrected(chunk, self._noise(len(chunk.commands), rng))

        return simulate_in_chunks(
            self, run, checked, faults, seed=seed, progress=progress, emulated=self.emulated
        )

    def _noise(self, count: int, rng: np.random.Generator) -> dict[str, NDArray]:
        """The noise of the residual model and the sensor for `count` trajectories, by graph input.

        All of it is independent. `uniform` (n, M, blocks), `trajectory_uniform` (n, 1, blocks),
        `error_level` (n, R, d_y) and `glitch_level` (n, R, 1) are uniform on [0, 1);
        `segment_noise` (n, M, d_z), `trajectory_noise` (n, 1, d_z) and `glitch_noise` (n, R, d_y)
        are standard normal; `phase` (n, 1) is one of the sensor's phases.
        """
        residual = self.graphs["residual"]
        blocks, size = residual.width("uniform"), residual.width("segment_noise")
        shape = count, self.facts.max_segments
        noise: dict[str, NDArray] = {
            "uniform": rng.random((*shape, blocks), np.float32),
            "segment_noise": rng.standard_normal((*shape, size), np.float32),
            "trajectory_noise": rng.standard_normal((count, 1, size), np.float32),
        }
        # Without it the width of the residual model is known.
        if "trajectory_uniform" in residual.inputs:
            noise["trajectory_uniform"] = rng.random((count, 1, blocks), np.float32)
        if self.sensor is None:
            return noise
        samples = count, -(-self.facts.steps // self.sensor.every)
        width = len(self.outputs)
        return noise | {
            "phase": rng.choice(self.sensor.phases, size=(count, 1)).astype(np.int64),
            "error_level": rng.random((*samples, width), np.float32),
            "glitch_level": rng.random((*samples, 1), np.float32),
            "glitch_noise": rng.standard_normal((*samples, width), np.float32),
        }

    def _corrected(self, chunk: Chunk, noise: Mapping[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Nominal outputs and recorded corrected outputs, for noise as `_noise` draws it."""
        nominal = self.graphs["surrogate"](commands=chunk.commands)
        segments = padded_times(chunk.segments, self.facts.max_segments)
        z = self.graphs["residual"](commands=chunk.commands, nominal=nominal, **segments, **noise)
        outputs = self.graphs["correction"](
            faulty_commands=_single(chunk.faulty_commands),
            frozen=chunk.frozen.astype(np.int64),
            **segments,
            z=z,
        )
        if self.sensor is None:
            return nominal, outputs
        return nominal, self.graphs["sensor"](outputs=outputs, **noise)

    def _check_size(self, steps: int, segments: int) -> None:
        """Raise InputError for another length or more segments than the graphs have."""
        facts = self.facts
        fits = steps == facts.steps and segments <= facts.max_segments
        expected = f"{facts.steps} samples and at most {facts.max_segments} segments"
        got = f"{steps} samples, {segments} segments"
        remedy = "cut them, or use the bundle with torch, which takes any length"
        require(fits, "trajectories", expected=expected, got=got, remedy=remedy)


def _outputs(trajectories: Trajectories) -> dict[str, NDArray]:
    """Outputs and mask by name, as the graphs of guard and features take them."""
    return {
        "nominal": _single(trajectories.nominal),
        "observed": _single(trajectories.observed),
        "mask": trajectories.mask,
    }


def _single(values: NDArray) -> NDArray:
    return np.ascontiguousarray(values, dtype=np.float32)


def padded_times(segments: Segments, max_segments: int) -> dict[str, NDArray]:
    """Times of segments (n, max_segments) in samples, by name; absent segments as in `Segments`."""
    missing = ((0, 0), (0, max_segments - segments.max_count))
    padded = {
        name: _single(np.pad(getattr(segments, name), missing, constant_values=segments.steps))
        for name in ("start", "settle", "stop")
    }
    return {**padded, "valid": np.pad(segments.valid, missing)}


def settled_at(trajectories: Trajectories, stride: int, margin: int | None) -> NDArray:
    """Index (n, 1) of the sample until which `Features` hide the start; 0 if they do not."""
    last = trajectories.steps - 1
    if margin is None:
        return np.zeros((len(trajectories), 1), dtype=np.int64)
    segments = Segments.from_commands(trajectories.commands)
    if segments.max_count == 0:
        return np.full((len(trajectories), 1), last)
    end = np.ceil(segments.settle[:, :1]).astype(np.int64) + margin * stride
    return np.minimum(end, last)
