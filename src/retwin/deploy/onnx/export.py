"""`export_onnx`: a bundle as ONNX graphs, for machines without torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from retwin.checks import needs_extra, require
from retwin.data.segments import Segments
from retwin.deploy.bundle.bundle import Bundle
from retwin.deploy.bundle.seal import SCHEMAS, SUMS, seal
from retwin.deploy.onnx.graphs import (
    CorrectionGraph,
    DiagnoserGraph,
    FeaturesGraph,
    GuardGraph,
    ResidualGraph,
    SensorGraph,
    sampling_sensor,
)
from retwin.deploy.onnx.portable import padded_times
from retwin.deploy.parity import check_parity
from retwin.diagnosis import NetworkDiagnoser
from retwin.diagnosis.trained.features import SETTLED
from retwin.nets.networks import MLP, TCN
from retwin.progress import Progress, tracked
from retwin.serialisation.models import write_model
from retwin.serialisation.places import check_place
from retwin.twins.commands.samplers import RampSampler
from retwin.update.corrections import SampledSensor
from retwin.update.residual import Mixture, ResidualModel
from retwin.update.surrogate import Surrogate

EXAMPLES = 3
"""Trajectories of the example inputs; torch would fix the size of an axis with one."""


@dataclass(frozen=True)
class Graph:
    """A module to export, with example inputs.

    Attributes
    ----------
    module : nn.Module
        The module.
    inputs : mapping of str to Tensor
        Names of its inputs, and examples of them.
    unit : Tensor or float
        Unit of its output, in which differences from torch are given.
    any_length : tuple of str
        Names of the inputs whose second axis may have any length.
    strict : bool
        Whether torch traces the code instead of one run; needed if the code calls `len`.

    """

    module: nn.Module
    inputs: Mapping[str, Tensor]
    unit: Tensor | float = 1.0
    any_length: tuple[str, ...] = ()
    strict: bool = False


def export_onnx(
    bundle: Bundle, folder: str | Path, *, progress: Progress | None = None
) -> dict[str, float]:
    """Write the graphs of a bundle, with what `Portable` needs beside them, into a sealed folder.

    Each graph is run by onnxruntime and compared with torch before the folder is written.

    Parameters
    ----------
    bundle : Bundle
        The bundle.
    folder : path
        Where to write.
    progress : callable, optional
        Called with the share that is done.

    Returns
    -------
    dict of str to float
        Greatest difference of each graph from torch, in standard units, at most 1e-5.

    Raises
    ------
    InputError
        If onnx, onnxscript or onnxruntime is not installed; if a part of the bundle has no graph;
        or if a graph differs from torch by more than 1e-5.

    """
    check_installed()
    _check_exportable(bundle)
    graphs = _graphs(bundle)
    names = [f"{name}.onnx" for name in graphs]
    check_place(folder, folder=True, holds=("model.json", SUMS, *names))
    parity = {}
    with write_model(folder, "portable", _about(bundle), {}) as inside:
        for name, graph in tracked(graphs.items(), len(graphs), progress):
            parity[name] = _write(graph, name, inside / f"{name}.onnx")
        seal(inside)
    return parity


def check_installed() -> None:
    """Require the libraries that write and run graphs."""
    for name in ("onnx", "onnxscript", "onnxruntime"):
        needs_extra(name, "onnx", "writes and checks ONNX graphs")


def _check_exportable(bundle: Bundle) -> None:
    """Raise InputError that names the first part without a graph, and the reason."""
    surrogate, residual, diagnoser = bundle.twin.surrogate, bundle.twin.residual, bundle.diagnoser
    parts = (
        (isinstance(surrogate, Surrogate), "twin in place of a surrogate: it is no network"),
        (
            isinstance(getattr(surrogate, "config", None), MLP | TCN),
            "surrogate without one: it has a state, which torch unrolls over all samples",
        ),
        (
            isinstance(residual, ResidualModel) and isinstance(residual.density, Mixture),
            "residual model without one: it draws sample by sample, or by a flow's inverse; only "
            "mixtures with one z per segment have a graph",
        ),
        (
            residual.segmentation == "commands",
            "residual model without one: its segments are found in the nominal path, and only "
            "those of commands are found without torch",
        ),
        (
            diagnoser is None or isinstance(diagnoser, NetworkDiagnoser),
            "diagnoser without one: it is no network",
        ),
    )
    for exportable, part in parts:
        expected = "parts that have an ONNX graph"
        remedy = "use the bundle with torch, or fit that part anew as another kind"
        require(exportable, "bundle", expected=expected, got=f"a {part}", remedy=remedy)


def _graphs(bundle: Bundle) -> dict[str, Graph]:
    """Graphs by name, with simulated examples."""
    twin = bundle.twin
    surrogate = twin.surrogate
    unit = surrogate.after.scale
    commands = _example_commands(bundle)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        nominal = surrogate(commands)
    graphs = {
        "surrogate": Graph(surrogate, {"commands": commands}, unit, any_length=("commands",)),
        **_correction_graphs(bundle, commands, nominal, generator),
    }
    sensor = sampling_sensor(twin.residual.correction)
    if sensor is not None:
        graphs["sensor"] = _sensor_graph(sensor, nominal, unit, twin.rate, generator)
    return graphs | _assessment_graphs(bundle, nominal, generator)


def _correction_graphs(
    bundle: Bundle, commands: Tensor, nominal: Tensor, generator: torch.Generator
) -> dict[str, Graph]:
    """The graphs that draw discrepancies and apply them."""
    twin, facts = bundle.twin, bundle.facts
    residual = twin.residual
    assert isinstance(residual, ResidualModel)
    padded = padded_times(Segments.from_commands(commands.numpy()), facts.max_segments)
    times = {name: torch.as_tensor(each) for name, each in padded.items()}
    size, shape = len(residual.latent), (EXAMPLES, facts.max_segments)
    frozen = torch.full((EXAMPLES, commands.shape[2]), facts.steps)
    frozen[1, 0] = facts.steps // 4
    noise = {
        "uniform": torch.rand(*shape, len(residual.sizes), generator=generator),
        "segment_noise": torch.randn(*shape, size, generator=generator),
        "trajectory_noise": torch.randn(EXAMPLES, 1, size, generator=generator),
        "trajectory_uniform": torch.rand(EXAMPLES, 1, len(residual.sizes), generator=generator),
    }
    ends = {name: times[name] for name in ("start", "settle", "stop")}
    drawing = ResidualGraph(residual, twin.rate)
    context = {"commands": commands, "nominal": nominal, **ends, **noise}
    with torch.no_grad():
        z = drawing(**context)
    correction = CorrectionGraph(residual.correction, twin.surrogate)
    inputs = {"faulty_commands": commands, "frozen": frozen, **times, "z": z}
    return {
        "residual": Graph(drawing, context, residual.scale),
        "correction": Graph(correction, inputs, twin.surrogate.after.scale, strict=True),
    }


def _sensor_graph(
    sensor: SampledSensor, outputs: Tensor, unit: Tensor, rate: float, generator: torch.Generator
) -> Graph:
    """The graph of a sensor."""
    count, steps, width = outputs.shape
    every, phases = sensor.timing(rate)
    samples = -(-steps // every)
    inputs = {
        "outputs": outputs,
        "phase": torch.tensor(phases or (0,))[:1].expand(count, 1).contiguous(),
        "error_level": torch.rand(count, samples, width, generator=generator),
        "glitch_level": torch.rand(count, samples, 1, generator=generator),
        "glitch_noise": torch.randn(count, samples, width, generator=generator),
    }
    return Graph(SensorGraph(sensor, rate), inputs, unit)


def _assessment_graphs(
    bundle: Bundle, nominal: Tensor, generator: torch.Generator
) -> dict[str, Graph]:
    """The graphs of guard and diagnoser."""
    spread = bundle.twin.surrogate.after.scale
    observed = nominal + 0.1 * spread * torch.randn(nominal.shape, generator=generator)
    mask = torch.rand(nominal.shape, generator=generator) < 0.9
    outputs = {"nominal": nominal, "observed": observed, "mask": mask}
    guard, diagnoser = bundle.guard, bundle.diagnoser
    graphs = {"guard": Graph(GuardGraph(guard, guard.features), outputs)}
    if isinstance(diagnoser, NetworkDiagnoser):
        settled = torch.tensor([[0], [7], [50]])
        features = FeaturesGraph(diagnoser.features)
        inputs = {**outputs, "settled": settled}
        graphs["features"] = Graph(features, inputs, diagnoser.before.scale)
        example = features(*outputs.values(), settled)
        graphs["diagnoser"] = Graph(DiagnoserGraph(diagnoser), {"features": example})
    return graphs


def _example_commands(bundle: Bundle) -> Tensor:
    """Commands (EXAMPLES, T, d_u) with the greatest number of segments of the bundle."""
    facts, domain = bundle.facts, bundle.guard.domain
    count = max(facts.max_segments, 1)
    rate, duration = bundle.twin.rate, facts.steps / bundle.twin.rate
    longest = max(1, facts.steps // (2 * count)) / rate
    sampler = RampSampler(domain.low, domain.high, rate, duration, count, (longest,))
    return torch.as_tensor(sampler.sample(EXAMPLES, rng=np.random.default_rng(0)))


def _write(graph: Graph, name: str, path: Path) -> float:
    """Write the ONNX of a module; its greatest difference from torch, in the graph's unit."""
    import onnxruntime

    lengths = {each: {1: "T"} for each in graph.any_length}
    write_graph(graph.module, graph.inputs, path, lengths=lengths, strict=graph.strict)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    used = [each.name for each in session.get_inputs()]
    (found,) = session.run(None, {each: graph.inputs[each].numpy() for each in used})
    with torch.no_grad():
        expected = graph.module(*graph.inputs.values())
    what = f"a graph of {name}"
    return check_parity("bundle", what, torch.as_tensor(found), expected, graph.unit)


def write_graph(
    module: nn.Module,
    inputs: Mapping[str, Tensor],
    path: Path,
    *,
    outputs: Sequence[str] = ("out",),
    batch: Mapping[str, int] | None = None,
    lengths: Mapping[str, Mapping[int, str]] | None = None,
    strict: bool = False,
) -> None:
    """Trace a module and write its ONNX, without the paths of its source files.

    Parameters
    ----------
    module : nn.Module
        The module.
    inputs : mapping of str to Tensor
        Names of its inputs, and examples of them.
    path : path
        The file.
    outputs : sequence of str
        Names of its outputs.
    batch : mapping of str to int, optional
        The axis of each input that may have any length, of at least 2; by default the first.
    lengths : mapping of str to mapping of int to str, optional
        Further such axes of inputs, with their names.
    strict : bool
        Whether torch traces the code instead of one run.

    """
    dims = {"n": torch.export.Dim("n", min=2), "T": torch.export.Dim("T", min=2)}
    shapes = tuple(
        {(batch or {}).get(name, 0): dims["n"]}
        | {axis: dims[each] for axis, each in (lengths or {}).get(name, {}).items()}
        for name in inputs
    )
    with torch.no_grad(), _quiet():
        traced = torch.export.export(
            module.eval(), tuple(inputs.values()), dynamic_shapes=shapes, strict=strict
        )
        program = torch.onnx.export(
            traced.run_decompositions(DECOMPOSITIONS),
            dynamo=True,
            input_names=list(inputs),
            output_names=list(outputs),
            verbose=False,
        )
    assert program is not None
    for node in program.model.graph.all_nodes():
        node.metadata_props.clear()
    program.save(str(path))


def _count_below(boundaries: Tensor, values: Tensor, *, right: bool = False, **_: object) -> Tensor:
    """`torch.searchsorted`: how many of K boundaries (..., K) are below values (..., T)."""
    below = torch.le if right else torch.lt
    return below(boundaries[..., None, :], values[..., None]).sum(dim=-1)


def _running_maximum(values: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """`torch.cummax` along the last axis of values (n, K)."""
    before = torch.ones(2 * values.shape[-1:], dtype=torch.bool).tril()
    found = torch.where(before, values[:, None], -torch.inf).max(dim=-1)
    return found.values, found.indices


DECOMPOSITIONS = {
    torch.ops.aten.searchsorted.Tensor: _count_below,
    torch.ops.aten.cummax.default: _running_maximum,
}
"""Operators that torch's exporter lacks, by others, for the small K of segments."""


def _about(bundle: Bundle) -> dict[str, Any]:
    """The description that `Portable` needs beside the graphs."""
    twin, diagnoser = bundle.twin, bundle.diagnoser
    sensor = sampling_sensor(twin.residual.correction)
    return {
        "schema": SCHEMAS["portable"],
        **bundle.facts.about(),
        "inputs": vars(twin.inputs),
        "outputs": vars(twin.outputs),
        "rate": twin.rate,
        "emulated": twin.residual.emulated,
        "sensor": sensor and dict(zip(("every", "phases"), sensor.timing(twin.rate), strict=True)),
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
    """Silence the exporter's logs and warnings, which concern its own development."""
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
