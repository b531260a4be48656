"""Surrogates as FMUs: each network and each residual model against torch, for the same noise."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import ndtr, ndtri

import retwin as rt
from retwin.compiler import compilers
from retwin.deploy.actuator.draws import drawn
from retwin.deploy.fmu.export import export_fmu
from retwin.deploy.fmu.surrogates import DRAWS, ENSEMBLE
from retwin.errors import InputError
from retwin.nets.mixtures import BernoulliHead, Blocks
from retwin.twins.commands.range import CommandRange
from retwin.update.corrections import Chain, SampledSensor
from retwin.update.residual import SequenceMixture, SequenceResidual
from retwin.update.residual.model import ResidualModel
from retwin.update.residual.sequence import pick, pool

fmpy = pytest.importorskip("fmpy")
build_platform_binary = pytest.importorskip("fmpy.build").build_platform_binary

STEPS, RATE, SEED = 40, 10.0, 5
BEFORE = 12
"""Samples of a segment that ends before an FMU begins."""
COMMANDS = np.random.default_rng(1).normal(size=(STEPS, 2))
NETWORKS = {
    "mlp": rt.MLP((8, 5)),
    "linear": rt.MLP(()),
    "lstm": rt.LSTM(7, 2),
    "tcn": rt.TCN(5, 3, 4),
    "state_space": rt.StateSpace(4, 6),
}


class Doubled(rt.Additive):
    """An operator of a user."""

    def apply(self, context: Any, z: torch.Tensor) -> torch.Tensor:
        return super().apply(context, 2 * z)


CAUSAL = SequenceMixture(network=rt.LSTM(6), features=5, components=2, members=3)


def surrogate(network: Any, inputs: int = 2, outputs: int = 3) -> rt.Surrogate:
    """One with random weights and units."""
    torch.manual_seed(0)
    made = rt.Surrogate(
        network,
        inputs=rt.Channels.numbered("u", inputs),
        outputs=rt.Channels.numbered("y", outputs),
        rate=RATE,
    )
    _in_random_units(made)
    return made.eval()


def _in_random_units(module: torch.nn.Module) -> None:
    for name, values in module.named_buffers():
        if name.endswith(("mean", "scale")):
            values.copy_(torch.rand_like(values) + 0.5)


def corrected(
    network: Any,
    density: SequenceMixture,
    correction: Any = rt.Additive(),  # noqa: B008 - frozen
    channels: tuple[int, int] = (2, 3),
) -> rt.CorrectedTwin:
    """One with a residual model of random weights, bounds within its range, and persistence."""
    of = surrogate(network, *channels)
    made = SequenceResidual(correction, density, inputs=of.inputs, outputs=of.outputs)
    _in_random_units(made)
    with torch.no_grad():
        for name in ("shift", "trust", "persistence"):
            getattr(made, name).uniform_()
        made.bounds.uniform_(2.0, 3.0)
        made.spread.uniform_(1.0, 2.0)
        for each in made.members.parameters():
            each.mul_(2.0)
    return rt.CorrectedTwin(of, made.eval())


def uniform(count: int, seed: int = SEED) -> np.ndarray:
    """The first numbers of the FMU's generator."""
    with np.errstate(over="ignore"):
        x = np.uint64(seed) * np.uint64(0xD1342543DE82EF95)
        x = x + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x ^= x >> np.uint64(31)
    return ((x >> np.uint64(11)).astype(float) + 0.5) / 2.0**53


@contextmanager
def instance(path: Path, **faults: float) -> Iterator[tuple[Any, dict[str, int]]]:
    """A running instance of a file or its folder, with noise, and the references of variables."""
    found = fmpy.read_model_description(str(path), validate=True)
    reference = {each.name: each.valueReference for each in found.modelVariables}
    folder = str(path) if path.is_dir() else fmpy.extract(str(path))
    slave = fmpy.instantiate_fmu(folder, found, "CoSimulation")
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.setInteger([reference["seed"]], [SEED])
    slave.setBoolean([reference["noise"]], [True])
    for name, value in faults.items():
        slave.setReal([reference[f"fault.{name}"]], [value])
    slave.exitInitializationMode()
    yield slave, reference
    slave.terminate()
    slave.freeInstance()


def simulated(path: Path, commands: np.ndarray, outputs: int = 3, **faults: float) -> np.ndarray:
    """Drawn outputs, means and quantiles (4, T, d_y), each for the command of its own sample."""
    with instance(path, **faults) as (slave, reference):
        given = [reference[name] for name in rt.Channels.numbered("u", commands.shape[1]).names]
        names = rt.Channels.numbered("y", outputs).names
        made = []
        for k, command in enumerate(commands):
            slave.setReal(given, command)
            values = [
                slave.getReal([reference[f"{name}{suffix}"] for name in names])
                for suffix in ("", ".mean", ".q05", ".q95")
            ]
            made.append(values)
            slave.doStep(k / RATE, 1 / RATE)
    return np.array(made).swapaxes(0, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_a_surrogate_has_the_outputs_of_its_network(name: str, tmp_path: Path) -> None:
    twin = surrogate(NETWORKS[name])
    path = export_fmu(twin, tmp_path / "twin.fmu").path
    with torch.no_grad():
        expected = twin.double()(torch.tensor(COMMANDS)[None])[0].numpy()
    for made in simulated(path, COMMANDS):
        np.testing.assert_allclose(made / expected.std(0), expected / expected.std(0), atol=1e-7)


@pytest.mark.parametrize(
    ("network", "encoder"),
    [
        pytest.param("mlp", rt.LSTM(6), id="mlp"),
        pytest.param("lstm", rt.TCN(4, 3, 3), id="lstm", marks=pytest.mark.slow),
    ],
)
def test_a_corrected_surrogate_has_the_draws_and_the_quantiles_of_the_twin(
    network: str, encoder: Any, tmp_path: Path
) -> None:
    density = SequenceMixture(network=encoder, features=5, components=2, members=3)
    twin = corrected(NETWORKS[network], density)
    path = export_fmu(twin, tmp_path / "twin.fmu").path
    drawn, mean, *quantiles = simulated(path, COMMANDS)
    nominal, z, z_mean, members, bounds = _reference(twin)
    spread = (nominal + z).std(axis=0)
    np.testing.assert_allclose(drawn / spread, (nominal + z) / spread, atol=1e-5)
    np.testing.assert_allclose(mean / spread, (nominal + z_mean) / spread, atol=1e-6)
    for made, level in zip(quantiles, (0.05, 0.95), strict=True):
        at = made - nominal
        free = np.abs(at) < bounds - 1e-6
        reached = members.marginal_cdf(torch.tensor(at)[None])[0].numpy()
        assert free.any()
        np.testing.assert_allclose(reached[free], level, atol=1e-6)
        assert (np.abs(at) <= bounds + 1e-9).all()


def _reference(twin: rt.CorrectedTwin) -> tuple[Any, ...]:
    """Nominal outputs, z and its mean (T, d_y), its distribution and bounds, by torch."""
    residual, commands = twin.residual.double(), torch.tensor(COMMANDS)[None]
    assert isinstance(residual, SequenceResidual)
    with torch.no_grad():
        nominal = twin.surrogate.double()(commands)
        (members,) = residual.distributions(torch.cat([commands, nominal], -1))
        level, *rest = uniform(1 + STEPS * 4)
        chosen = torch.tensor([int(members.batch_shape[0] * level)])
        noise = ndtri(np.reshape(rest, (STEPS, 4)))
        share = np.concatenate([residual.persistence[:1], residual.persistence])
        for t in range(1, STEPS):
            noise[t] = share * noise[t - 1] + np.sqrt(1 - share**2) * noise[t]
        one = Blocks([pick(members, chosen)])
        normal = torch.tensor(noise[None, :, 1:])
        z = one.from_noise(torch.tensor(ndtr(noise[None, :, :1])), normal)
        pooled = pool(members)
        bounds = residual.bounds
        values = (nominal, *(each.clamp(-bounds, bounds) for each in (z, pooled.mean)))
    return *(each[0].numpy() for each in values), pooled, bounds.numpy()


@pytest.mark.slow
def test_the_residual_does_not_see_faults(tmp_path: Path) -> None:
    """As in `CorrectedTwin.simulate`: z is that of the commands without faults."""
    twin = corrected(NETWORKS["mlp"], CAUSAL)
    path = export_fmu(twin, tmp_path / "twin.fmu").path
    healthy, faulty = simulated(path, COMMANDS), simulated(path, COMMANDS, **{"gain.u1": -0.5})
    biased = simulated(path, COMMANDS, **{"bias.y1": 0.25})
    nominal = twin.surrogate.double()
    with torch.no_grad():
        executed = COMMANDS * [0.5, 1.0]
        change = nominal(torch.tensor(executed)[None]) - nominal(torch.tensor(COMMANDS)[None])
    np.testing.assert_allclose((faulty - healthy)[0], change[0].numpy(), atol=1e-6)
    np.testing.assert_allclose((biased - healthy)[0], np.tile([0.25, 0, 0], (STEPS, 1)), atol=1e-9)


@pytest.mark.slow
def test_states_are_kept_and_steps_may_be_of_any_length(tmp_path: Path) -> None:
    path = export_fmu(corrected(NETWORKS["lstm"], CAUSAL), tmp_path / "twin.fmu").path
    ends = []
    for count in (1, 4):
        with instance(path) as (slave, reference):
            for k in range(10 * count):
                slave.doStep(k / RATE / count, 1 / RATE / count)
            state = slave.getFMUState()
            stored = slave.serializeFMUState(state)
            slave.freeFMUState(state)
            slave.doStep(10 / RATE, 1 / RATE)
            ends.append(slave.getReal([reference["y1"]]))
            kept = slave.deserializeFMUState(stored)
            slave.setFMUState(kept)
            slave.freeFMUState(kept)
            slave.doStep(10 / RATE, 1 / RATE)
            assert slave.getReal([reference["y1"]]) == ends[-1]
    assert ends[0] == ends[1]


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_it_reports_commands_outside_the_training_range(version: str, tmp_path: Path) -> None:
    """As `CommandRange` does, with values and speeds; a spectrum is known only at the end."""
    twin, rng = surrogate(NETWORKS["mlp"]), np.random.default_rng(2)
    training = rng.uniform([-1.0, 3.0], [1.0, 5.0], (4, STEPS, 2)).cumsum(axis=1) / STEPS
    twin.trained = trained = CommandRange.of(training, RATE)
    path = export_fmu(twin, tmp_path / "twin.fmu", version=version).path
    found = fmpy.read_model_description(str(path), validate=True)
    inputs = [each for each in found.modelVariables if each.causality == "input"]
    assert tuple(float(each.min) for each in inputs) == trained.low
    assert tuple(float(each.max) for each in inputs) == trained.high
    greatest = np.abs([trained.low, trained.high]).max(axis=0).tolist()
    assert [float(each.nominal) for each in inputs] == greatest
    assert all(float(each.min) <= float(each.start) <= float(each.max) for each in inputs)
    beyond, sudden = training[:1].copy(), training[:1].copy()
    beyond[0, -9:, 1] += 2 * (trained.high[1] - trained.low[1])
    sudden[0, ::2, 0] += 2 * trained.speed[0] / RATE
    for commands in (training[:1], beyond, sudden):
        times = np.arange(STEPS) / RATE
        kinds = [("time", float), ("u1", float), ("u2", float)]
        rows = [(time, *u) for time, u in zip(times, commands[0].tolist(), strict=True)]
        messages: list[str] = []
        made = fmpy.simulate_fmu(
            str(path), stop_time=times[-1], step_size=1 / RATE, output_interval=1 / RATE,
            input=np.array(rows, kinds), record_events=False,
            logger=lambda *given, messages=messages: messages.append(str(given[-1])),
        )  # fmt: skip
        wrong = (trained.scores(commands, RATE)[:, :2] > 1).any()
        assert made["outside_training"].any() == wrong
        assert len(messages) == wrong
        assert all("outside the training range" in each for each in messages)
    other = export_fmu(surrogate(NETWORKS["linear"]), tmp_path / "other.fmu", compiled=False)
    assert "outside_training" not in other.variables, "it cannot report what it does not know"


def test_what_depends_on_the_future_is_refused(tmp_path: Path) -> None:
    of, out = surrogate(NETWORKS["mlp"]), tmp_path / "twin.fmu"
    channels = {"inputs": of.inputs, "outputs": of.outputs}
    for correction in (rt.DelayOffset(), rt.CommandSpace()):
        name = type(correction).__name__
        with pytest.raises(InputError, match=f"(?s)commands.*{name}.*known only after it"):
            export_fmu(per_segment(correction), out)
    for correction, how, reason in (
        (rt.CommandSpace(), {"segmentation": "path"}, "known only at the end"),
        (Chain(rt.DelayOffset(), rt.CommandSpace()), {}, "a Chain of operators"),
    ):
        residual = ResidualModel(correction, rt.Mixture(), **channels, **how)
        with pytest.raises(InputError, match=reason):
            export_fmu(rt.CorrectedTwin(of, residual.eval()), out, commands=ramps(3, 4, 0))
    for period, reason in ((5, "depends on the next one"), (1, "errors .* have no C text")):
        sensor = Chain(rt.Additive(), SampledSensor(period=period / RATE))
        with pytest.raises(InputError, match=reason):
            export_fmu(corrected(NETWORKS["mlp"], CAUSAL, sensor), out)
    with pytest.raises(InputError, match="Doubled, an operator that has no C text"):
        export_fmu(corrected(NETWORKS["mlp"], CAUSAL, Doubled()), out)
    assert not out.exists()


@pytest.mark.slow
def test_the_command_line_exports_a_saved_corrected_twin(call: Any, tmp_path: Path) -> None:
    corrected(NETWORKS["mlp"], CAUSAL).save(tmp_path / "model")
    code, _, err = call("export", "fmu", tmp_path / "model", "--out", tmp_path / "twin.fmu")
    assert code == 0, err
    assert np.isfinite(simulated(tmp_path / "twin.fmu", COMMANDS)).all()


@pytest.mark.slow
@pytest.mark.parametrize("version", ["2.0", "3.0"])
@pytest.mark.parametrize("name", [*NETWORKS, "corrected", "segments"])
def test_the_source_code_is_clean(name: str, version: str, tmp_path: Path) -> None:
    twin: Any = surrogate(NETWORKS.get(name), 1, 1) if name in NETWORKS else None
    commands = None
    if name == "segments":
        twin, commands = per_segment(rt.CommandSpace(), channels=(1, 1)), ramps(9, 4, 0)[..., :1]
    twin = twin or corrected(NETWORKS["tcn"], CAUSAL, channels=(1, 1))
    out = tmp_path / "twin.fmu"
    path = export_fmu(twin, out, version=version, compiled=False, commands=commands).path
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
    strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined")
    driver = Path(__file__).with_name(f"drive_fmi{version[0]}.c")
    token = fmpy.read_model_description(str(path)).guid
    subprocess.run(
        [*next(iter(compilers())), *strict, f'-DTOKEN_GIVEN="{token}"',
         f"-I{tmp_path / 'sources'}", str(driver), str(tmp_path / "sources" / "twin.c"),
         "-o", str(tmp_path / "driver"), "-lm"],
        check=True,
    )  # fmt: skip
    done = subprocess.run([str(tmp_path / "driver")], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_fmpy_compiles_the_source_code(
    version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin = corrected(NETWORKS["mlp"], CAUSAL)
    path = export_fmu(twin, tmp_path / "twin.fmu", version=version).path
    source = export_fmu(twin, tmp_path / "source.fmu", version=version, compiled=False).path
    folder = tmp_path / "folder"
    with zipfile.ZipFile(source) as archive:
        archive.extractall(folder)
    # The program cmake comes with the package of that name, which fmpy requires.
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "build").mkdir()
    build_platform_binary(folder, tmp_path / "build")
    if version == "2.0":
        made = simulated(folder, COMMANDS) - simulated(path, COMMANDS)
        np.testing.assert_allclose(made, 0.0, atol=1e-9)
        return
    found = [fmpy.simulate_fmu(str(each), stop_time=1.0) for each in (folder, path)]
    np.testing.assert_allclose(found[0]["y1.q95"], found[1]["y1.q95"], atol=1e-9)


def ramps(count: int, motion: int, seed: int) -> np.ndarray:
    """Commands (n, T, 2) with three motions of so many steps, at rest between them."""
    at = np.array([0, *(12 * m + 3 + e for m in range(3) for e in (0, motion)), STEPS])
    levels = np.random.default_rng(seed).uniform(-2, 2, (count, 2, 4)).repeat(2, axis=2)
    made = [[np.interp(np.arange(STEPS), at, row) for row in rows] for rows in levels]
    return np.moveaxis(np.array(made), 1, 2).astype(np.float32)


def per_segment(
    correction: Any, missed: float = -9.0, channels: tuple[int, int] = (2, 3)
) -> rt.CorrectedTwin:
    """One with delays and offsets that depend on the commands, and log odds of a missed segment."""
    of = surrogate(NETWORKS["mlp"], *channels)
    residual = ResidualModel(
        correction, rt.Mixture(components=2, hidden=(6,)), inputs=of.inputs, outputs=of.outputs
    )
    residual.shift[0], residual.scale[0], residual.scale[1:] = 2.2, 0.4, 0.1
    residual.bounds.copy_(residual.shift.abs() + 5 * residual.scale)
    for head in residual.heads:
        if isinstance(head, BernoulliHead):
            torch.nn.init.constant_(head.linear.bias, missed)
    return rt.CorrectedTwin(of, residual.eval())


@pytest.mark.parametrize(
    ("correction", "motion"),
    [
        (rt.CommandSpace(), 1),
        (rt.CommandSpace(), 4),
        (Chain(rt.CommandSpace(), SampledSensor(period=0.2)), 4),
        (rt.DelayOffset(), 4),
    ],
)
def test_delays_and_offsets_are_those_of_the_twin_for_the_same_z(
    correction: Any, motion: int, tmp_path: Path
) -> None:
    twin = per_segment(correction, -1.0 if motion == 1 else -20.0)
    # Within the targets of `given`: beyond them the error stays that at their end.
    given, commands = ramps(30, motion, 3), np.float32(0.7) * ramps(1, motion, 4)
    made = export_fmu(twin, tmp_path / "twin.fmu", commands=given)
    assert made.omitted == (("SampledSensor",) if isinstance(correction, Chain) else ())
    outputs, mean, low, high = simulated(made.path, commands[0].astype(float))
    found = drawn(twin, given, DRAWS, 0, any_outputs=True)
    rows = [int(DRAWS * uniform(1)[0]), *range(ENSEMBLE)]
    seeds = [SEED, *(2**64 - 1 - m for m in range(ENSEMBLE))]
    both = zip(rows, seeds, strict=True)
    expected = np.stack([replayed(twin, found, commands, *each) for each in both])
    spread = expected[0].std(axis=0)
    quantiles = np.quantile(expected[1:], [0.05, 0.95], axis=0)
    pairs = ((outputs, expected[0]), (mean, expected[1:].mean(0)), (low, quantiles[0]))
    for here, there in (*pairs, (high, quantiles[1])):
        # Paths of the twin are in single precision: nominal outputs, their interpolation, offsets.
        rounding = 4 * float(np.finfo(np.float32).eps)
        np.testing.assert_allclose(here / spread, there / spread, rtol=rounding, atol=1e-5)
    assert (high > low).all()


@torch.no_grad()
def replayed(twin: Any, found: Any, commands: np.ndarray, row: int, seed: int) -> np.ndarray:
    """Outputs (T, d_y) of the twin's operator with the draw of an instance.

    The twin begins without an error, an FMU with that of its draw: a segment comes before.
    """
    operator = twin.residual.correction
    operator = operator.first if isinstance(operator, Chain) else operator
    twin.surrogate.double()
    before = np.repeat(commands[:, :1], BEFORE, axis=1)
    before[:, :2] *= 0.9
    longer = np.concatenate([before, commands], axis=1, dtype=np.float64)
    context = twin.residual.context(twin.surrogate, longer)
    onsets = np.flatnonzero(np.diff(commands[0], axis=0).any(axis=1)) + 1
    onsets = onsets[np.diff(onsets, prepend=-9) > 1]
    count = 1 + len(onsets)
    z = [(found.delay[row] * RATE).expand(1, count, 1), found.offset[row].repeat(1, count, 1)]
    if isinstance(operator, rt.CommandSpace):
        settle = torch.as_tensor(context.segments.settle).round().long()[0]
        target = torch.as_tensor(longer)[:, settle].clamp(found.low, found.high)
        z[1] = z[1] + found.gain * (target - found.centre)
        numbers = uniform(1 + STEPS * 2, seed)[1 + 2 * onsets[:, None] + np.arange(2)]
        missed = torch.as_tensor(numbers < found.probability[row].numpy())
        z.append(torch.nn.functional.pad(missed, (0, 0, 1, 0))[None])
    made = operator.apply(context, torch.cat([each.double() for each in z], dim=2))
    return made[0, BEFORE:].numpy()
