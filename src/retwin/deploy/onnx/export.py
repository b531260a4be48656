"""`export_onnx`: a bundle as ONNX graphs, for machines without torch."""

from __future__ import annotations

import importlib.util
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from retwin.data.segments import Segments
from retwin.deploy.bundle.bundle import Bundle
from retwin.deploy.bundle.seal import SCHEMA, seal
from retwin.deploy.onnx.graphs import (
    CorrectionGraph,
    DiagnoserGraph,
    FeaturesGraph,
    GuardGraph,
    ResidualGraph,
    SensorGraph,
    sensor_of,
)
from retwin.deploy.onnx.operators import translations
from retwin.deploy.onnx.portable import padded_times
from retwin.diagnosis import NetworkDiagnoser
from retwin.diagnosis.features import SETTLED
from retwin.errors import InputError
from retwin.nets.networks import MLP, TCN
from retwin.progress import Progress
from retwin.serialisation.models import write_model
from retwin.twins.samplers import RampSampler
from retwin.update.corrections import SampledSensor
from retwin.update.residual import Mixture, ResidualModel

__all__ = ["PARITY", "export_onnx"]

PARITY = 1e-5
"""Greatest difference from torch, in standard units, with which a graph is written."""
EXAMPLES = 3
"""Trajectories that graphs are traced and compared with; with one, its axis would be fixed."""


@dataclass(frozen=True)
class Graph:
    """A module, named example inputs, and the unit of its output.

    Attributes
    ----------
    any_length: inputs whose second axis may have any length.
    strict: whether to trace the code itself and not its run, which knows `len` of any number.

    """

    module: nn.Module
    inputs: Mapping[str, Tensor]
    unit: Tensor | float = 1.0
    any_length: tuple[str, ...] = ()
    strict: bool = False


def export_onnx(
    bundle: Bundle, folder: str | Path, *, progress: Progress | None = None
) -> dict[str, float]:
    """Write the graphs of a bundle and what `Portable` needs beside them into a sealed folder.

    Each graph is run by onnxruntime and compared with torch before anything is written. Returned
    is the greatest difference of each, in standard units: at most 1e-5.

    Raises
    ------
    InputError: onnx, onnxscript or onnxruntime is not installed; a part that has no graph, named
        with the reason; a graph that does not say the same as torch.

    """
    _installed()
    _exportable(bundle)
    graphs = _graphs(bundle)
    parity = {}
    with write_model(folder, "portable", _about(bundle), {}) as inside:
        for done, (name, graph) in enumerate(graphs.items()):
            _write(graph, inside / f"{name}.onnx")
            parity[name] = _difference(graph, inside / f"{name}.onnx")
            if not parity[name] <= PARITY:
                raise InputError(
                    "bundle",
                    expected=f"a graph of {name} that agrees with torch to {PARITY:g}",
                    got=f"a difference of {parity[name]:.2g}",
                    remedy="predict with torch, and report this: the graph is wrong",
                )
            if progress is not None:
                progress((done + 1) / len(graphs))
        seal(inside)
    return parity


def _installed() -> None:
    missing = [
        name for name in ("onnx", "onnxscript", "onnxruntime") if not importlib.util.find_spec(name)
    ]
    if missing:
        raise InputError(
            "onnx",
            expected="the packages onnx, onnxscript and onnxruntime",
            got=f"an installation without {', '.join(missing)}",
            remedy='install them: pip install "retwin[onnx]"',
        )


def _exportable(bundle: Bundle) -> None:
    """Say which part has no graph, and why."""
    surrogate, residual = bundle.twin.surrogate, bundle.twin.residual
    reasons = {
        "surrogate": "it has a state, which torch's exporter unrolls over all samples"
        if not isinstance(surrogate.config, MLP | TCN)
        else "",
        "residual model": "it draws sample by sample, or by a flow's inverse; only mixtures with "
        "one z per movement have a graph"
        if not (isinstance(residual, ResidualModel) and isinstance(residual.density, Mixture))
        else "",
        "residual model's movements": "they are found in the nominal path, by commands only they "
        "are found without torch"
        if residual.segmentation != "commands"
        else "",
        "diagnoser": "it is no network" if not _network(bundle) else "",
    }
    for part, why in reasons.items():
        if why:
            raise InputError(
                "bundle",
                expected="parts that have an ONNX graph",
                got=f"a {part} without one: {why}",
                remedy="use the bundle with torch, or fit that part anew as another kind",
            )


def _network(bundle: Bundle) -> bool:
    return bundle.diagnoser is None or isinstance(bundle.diagnoser, NetworkDiagnoser)


def _graphs(bundle: Bundle) -> dict[str, Graph]:
    """Name to graph, with examples that are simulated."""
    twin, facts = bundle.twin, bundle.facts
    surrogate, residual = twin.surrogate, twin.residual
    assert isinstance(residual, ResidualModel)
    commands = _example_commands(bundle)
    padded = padded_times(Segments.from_commands(commands.numpy()), facts.movements)
    times = {name: torch.as_tensor(each) for name, each in padded.items()}
    generator = torch.Generator().manual_seed(0)
    size, unit = len(residual.latent), surrogate.after.scale
    shape = EXAMPLES, facts.movements
    frozen = torch.full((EXAMPLES, commands.shape[2]), facts.steps)
    frozen[1, 0] = facts.steps // 4
    with torch.no_grad():
        nominal = surrogate(commands)
    draws = {
        "uniform": torch.rand(*shape, len(residual.sizes), generator=generator),
        "own": torch.randn(*shape, size, generator=generator),
        "common": torch.randn(EXAMPLES, 1, size, generator=generator),
    }
    known = {name: times[name] for name in ("start", "settle", "stop")}
    drawing = ResidualGraph(residual, twin.rate)
    context = {"commands": commands, "nominal": nominal, **known, **draws}
    with torch.no_grad():
        z = drawing(**context)
    told = {"told": commands, "frozen": frozen, **times, "z": z}
    correction = CorrectionGraph(residual.correction, surrogate)
    graphs = {
        "surrogate": Graph(surrogate, {"commands": commands}, unit, any_length=("commands",)),
        "residual": Graph(drawing, context, residual.scale),
        "correction": Graph(correction, told, unit, strict=True),
    }
    sensor = sensor_of(residual.correction)
    if sensor is not None:
        graphs["sensor"] = _reading(sensor, nominal, unit, generator)
    return graphs | _judging(bundle, nominal, generator)


def _reading(
    sensor: SampledSensor, outputs: Tensor, unit: Tensor, generator: torch.Generator
) -> Graph:
    """The graph of a sensor."""
    count, steps, width = outputs.shape
    readings = -(-steps // (sensor.every or 1))
    inputs = {
        "outputs": outputs,
        "phase": torch.tensor(sensor.phases or (0,))[:1].expand(count, 1).contiguous(),
        "level": torch.rand(count, readings, width, generator=generator),
        "chance": torch.rand(count, readings, 1, generator=generator),
        "glitch": torch.randn(count, readings, width, generator=generator),
    }
    return Graph(SensorGraph(sensor, width), inputs, unit)


def _judging(bundle: Bundle, nominal: Tensor, generator: torch.Generator) -> dict[str, Graph]:
    """The graphs that look at trajectories."""
    spread = bundle.twin.surrogate.after.scale
    observed = nominal + 0.1 * spread * torch.randn(nominal.shape, generator=generator)
    mask = torch.rand(nominal.shape, generator=generator) < 0.9
    seen = {"nominal": nominal, "observed": observed, "mask": mask}
    guard = bundle.guard
    graphs = {"guard": Graph(GuardGraph(guard, guard.features), seen)}
    if isinstance(bundle.diagnoser, NetworkDiagnoser):
        settled = torch.tensor([[0], [7], [50]])
        features = FeaturesGraph(bundle.diagnoser.features)
        graphs["features"] = Graph(
            features, {**seen, "settled": settled}, bundle.diagnoser.before.scale
        )
        told = features(*seen.values(), settled)
        graphs["diagnoser"] = Graph(DiagnoserGraph(bundle.diagnoser), {"features": told})
    return graphs


def _example_commands(bundle: Bundle) -> Tensor:
    """Commands (EXAMPLES, T, d_u) with as many movements as the bundle knows at most."""
    facts, domain = bundle.facts, bundle.guard.domain
    count = max(facts.movements, 1)
    longest = max(1, facts.steps // (2 * count))
    sampler = RampSampler(domain.low, domain.high, count, facts.steps, (longest,))
    return torch.as_tensor(sampler.sample(EXAMPLES, rng=np.random.default_rng(0)))


def _write(graph: Graph, path: Path) -> None:
    """Trace a module and write its ONNX, without the names of files that its code is in."""
    count = torch.export.Dim("n", min=2)
    length = torch.export.Dim("T", min=2)
    shapes = tuple(
        {0: count, 1: length} if name in graph.any_length else {0: count} for name in graph.inputs
    )
    with torch.no_grad(), _quiet():
        traced = torch.export.export(
            graph.module.eval(),
            tuple(graph.inputs.values()),
            dynamic_shapes=shapes,
            strict=graph.strict,
        )
        program = torch.onnx.export(
            traced,
            dynamo=True,
            input_names=list(graph.inputs),
            output_names=["out"],
            custom_translation_table=translations(),
            verbose=False,
        )
    assert program is not None
    for node in program.model.graph.all_nodes():
        node.metadata_props.clear()
    program.save(str(path))


def _difference(graph: Graph, path: Path) -> float:
    """The greatest difference of torch and onnxruntime, in the graph's unit."""
    import onnxruntime

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    given = {name: value.numpy() for name, value in graph.inputs.items()}
    known = {each.name for each in session.get_inputs()}
    (found,) = session.run(None, {name: value for name, value in given.items() if name in known})
    with torch.no_grad():
        expected = graph.module(*graph.inputs.values())
    return float(((torch.as_tensor(found) - expected) / graph.unit).abs().max())


def _about(bundle: Bundle) -> dict[str, Any]:
    """What `Portable` needs beside the graphs."""
    twin, diagnoser = bundle.twin, bundle.diagnoser
    sensor = sensor_of(twin.residual.correction)
    return {
        "schema": SCHEMA,
        **bundle.facts.about(),
        "inputs": vars(twin.inputs),
        "outputs": vars(twin.outputs),
        "rate": twin.rate,
        "emulated": twin.residual.emulated,
        "sensor": None if sensor is None else {"every": sensor.every, "phases": sensor.phases},
        "domain": asdict(bundle.guard.domain),
        "stride": bundle.guard.stride(twin.surrogate),
        "diagnoser": None
        if not isinstance(diagnoser, NetworkDiagnoser)
        else {
            "classes": diagnoser.classes,
            "stride": diagnoser.features.stride,
            "settled": SETTLED if diagnoser.features.hide_start else None,
        },
        "provenance": dict(bundle.provenance),
    }


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter's remarks on itself are not for users of this library."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
