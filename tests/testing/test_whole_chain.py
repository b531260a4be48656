"""The whole chain on toy systems of every shape, and that padding changes nothing.

Surrogate, residual, corrected twin, generation, folders on disk, fidelity, study and report: with
one output and with eight, from 0.01 Hz to 1 kHz, 30 to 5000 samples, a fifth of what was measured
missing, and trajectories of unequal length. The discrepancies of the toys are known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import lfilter

import retwin as rt
from retwin.data.trajectories import HEALTHY
from retwin.nets.networks import LSTM
from retwin.nets.training import Training
from retwin.twins.commands.samplers import RampSampler
from retwin.twins.function import FunctionTwin
from retwin.update.corrections import Additive
from retwin.update.residual import Density, SequenceMixture

QUICK = Training(max_epochs=80, batch_size=512, learning_rate=2e-2, decay="cosine")
DENSITY = rt.Mixture(
    components=1, hidden=(8,), dropout=0.0, training=replace(rt.Mixture().training, max_epochs=60)
)
STEPWISE = SequenceMixture(
    network=rt.TCN(channels=8, levels=4),
    features=4,
    components=1,
    members=2,
    block=10,
    margin=1,
    window=200,
    burn_in=5,
    dropout=0.0,
    training=Training(max_epochs=20, batch_size=6, learning_rate=2e-2),
)
MEAN, SPREAD, NOISE = 0.15, 0.03, 0.004
"""Moments of the discrepancy of every output or command, and the noise, in the toys' units."""


def few_epochs(density: Density | SequenceMixture) -> Density | SequenceMixture:
    """The same density for two fits that are compared: whether they agree needs no good fit."""
    return replace(density, training=replace(density.training, max_epochs=10))


def weights(inputs: int, outputs: int) -> NDArray:
    """How strongly each input drives each output."""
    return np.random.default_rng(8).uniform(0.3, 0.8, (inputs, outputs)) / np.sqrt(inputs)


def ideal(commands: NDArray, outputs: int) -> NDArray:
    """The toys' physics: bent, without memory."""
    return np.tanh(commands @ weights(commands.shape[-1], outputs))


@dataclass(frozen=True)
class Toy:
    """A system with a known discrepancy, and the correction that describes it."""

    inputs: int
    outputs: int
    rate: float
    steps: int
    correction: rt.Correction
    density: Density | SequenceMixture = DENSITY
    movements: int = 2
    count: int = 16

    @property
    def case(self) -> rt.Case:
        twin = FunctionTwin(
            partial(ideal, outputs=self.outputs),
            inputs=rt.Channels.numbered("u", self.inputs, "V"),
            outputs=rt.Channels.numbered("y", self.outputs, "bar"),
            rate=self.rate,
        )
        return rt.Case(
            name="toy",
            title="Toy",
            faults={HEALTHY: None, "Stuck": rt.Stuck(0, onset=self.steps // 10 / self.rate)},
            twin=twin,
            emulator=None,
            sampler=self.sampler,
            correction=self.correction,
            output_correction=self.correction,
            sensor_rate=self.rate,
            network=rt.MLP((16,)),
            training=QUICK,
            density=self.density,
        )

    @property
    def delay(self) -> int:
        """Delay of the segments in samples, 0 without segments."""
        return 2 if self.correction.resolution == "segment" else 0

    @property
    def sampler(self) -> RampSampler:
        ramps = [self.steps // (share * self.movements) / self.rate for share in (4, 3)]
        return RampSampler(
            (-1.0,) * self.inputs,
            (1.0,) * self.inputs,
            self.rate,
            self.steps / self.rate,
            segments=self.movements,
            ramp_durations=tuple(ramps),
        )

    def commands(self, count: int, seed: int) -> NDArray:
        onset = np.linspace(0, self.steps, self.movements, endpoint=False)[None] + 2.0
        return self.sampler.sample(count, rng=np.random.default_rng(seed), onsets=onset / self.rate)

    @cached_property
    def surrogate(self) -> rt.Surrogate:
        count = max(40, 4000 // self.steps)
        made = self.case.twin.simulate(self.commands(count, 1), seed=0)
        epochs = max(30, 300_000 // (count * self.steps))
        brisk = Training(max_epochs=epochs, batch_size=512, learning_rate=2e-2, decay="cosine")
        return rt.fit_surrogate(made, rt.MLP((16,)), seed=0, training=brisk)

    def measured(self, seed: int, count: int | None = None) -> rt.Trajectories:
        """Measured trajectories, with a delay and offsets from a known distribution."""
        rng = np.random.default_rng(seed)
        commands = self.commands(count or self.count, seed + 1)
        made = self.case.twin.simulate(commands, seed=0)
        operator = self.correction
        polled = isinstance(operator, rt.Chain)
        in_commands = isinstance(operator.first if polled else operator, rt.CommandSpace)
        width = self.inputs if in_commands else self.outputs
        offset = rng.normal(MEAN, SPREAD, (len(commands), 1, width)) * self.begun(commands)
        moment = np.maximum(np.arange(self.steps) - self.delay, 0)
        delayed = commands[:, moment]
        if in_commands:
            outputs = ideal(delayed + offset, self.outputs)
        else:
            outputs = ideal(delayed, self.outputs) + offset
        noisy = outputs + rng.normal(0, NOISE, outputs.shape)
        if polled:
            generator = torch.Generator().manual_seed(seed)
            every_fourth = rt.SampledSensor(period=4 / self.rate, phases=(0.0,))
            noisy = every_fourth.read(torch.as_tensor(noisy), generator, self.rate).numpy()
        return made.replace(observed=noisy, labels=np.full(len(commands), HEALTHY))

    def begun(self, commands: NDArray) -> NDArray:
        """Share (n, T, 1) of the first segment's motion that is done, its delay included."""
        first = rt.Segments.from_commands(commands)
        start, settle = first.start[:, :1] + self.delay, first.settle[:, :1] + self.delay
        time = np.arange(self.steps)
        return np.clip((time - start) / (settle - start), 0, 1)[..., None]


FAST_POLLED = rt.Chain(rt.CommandSpace(), rt.SampledSensor(period=0.08, phases=(0.0,)))
TOYS = {
    "one output, a sample every 100 s": Toy(1, 1, 0.01, 30, rt.DelayOffset()),
    "eight outputs at 1 kHz": Toy(3, 8, 1000.0, 1500, rt.DelayOffset(), count=10),
    "command space, polled": Toy(2, 8, 50.0, 400, FAST_POLLED, movements=3),
    "no segments, one output": Toy(1, 1, 1000.0, 5000, Additive(), STEPWISE, count=1),
    "no segments, eight outputs": Toy(3, 8, 0.01, 30, Additive(), STEPWISE, count=24),
}


def lossy(trajectories: rt.Trajectories, seed: int) -> rt.Trajectories:
    """A fifth of the measurements is missing: samples, single channels, or bursts of either."""
    rng = np.random.default_rng(seed)
    n, steps, width = trajectories.observed.shape
    mask = np.ones((n, steps, width), dtype=bool)
    kinds = [(long, wide) for long in (1, max(2, steps // 50)) for wide in (1, width)]
    for i in range(n):
        long, wide = kinds[i % len(kinds)]
        lost = rng.random((-(-steps // long), wide)) < 0.2
        mask[i] = ~lost.repeat(long, axis=0)[:steps]
    return trajectories.replace(mask=mask & trajectories.mask)


def shortened(trajectories: rt.Trajectories, steps: int) -> rt.Trajectories:
    """The first `steps` samples of each."""
    parts = ("commands", "nominal", "observed", "mask")
    return trajectories.replace(**{p: getattr(trajectories, p)[:, :steps] for p in parts})


def unequal(trajectories: rt.Trajectories) -> rt.Trajectories:
    """Every other one ends after four fifths of the time."""
    odd, even = trajectories[slice(1, None, 2)], trajectories[slice(0, None, 2)]
    short = shortened(odd, 4 * trajectories.steps // 5)
    return rt.Trajectories.concatenate([even, short]) if len(odd) else trajectories


SLOW_TOYS = ("command space, polled", "no segments, one output")


@pytest.fixture(
    scope="module",
    params=[pytest.param(each, marks=[pytest.mark.slow] * (each in SLOW_TOYS)) for each in TOYS],
)
def toy(request: pytest.FixtureRequest) -> Toy:
    return TOYS[request.param]


@pytest.fixture(scope="module")
def calibration(toy: Toy) -> rt.Trajectories:
    return lossy(unequal(toy.measured(3)), seed=4)


@pytest.fixture(scope="module")
def updated(toy: Toy, calibration: rt.Trajectories) -> rt.CorrectedTwin:
    rg = rt.fit_residual(toy.surrogate, calibration, toy.correction, toy.density, seed=5)
    return rt.CorrectedTwin(toy.surrogate, rg, case="toy")


ARRAYS = ("commands", "nominal", "observed", "mask", "labels", "ids")


@pytest.mark.slow
def same(one: rt.Trajectories, other: rt.Trajectories) -> bool:
    """To the byte, and of the same channels and rate."""
    arrays = all(np.array_equal(getattr(one, a), getattr(other, a)) for a in ARRAYS)
    return arrays and all(
        getattr(one, a) == getattr(other, a) for a in ("inputs", "outputs", "rate")
    )


def test_generated_trajectories_are_whole(
    toy: Toy, updated: rt.CorrectedTwin, tmp_path: Path
) -> None:
    """They are finite, named and labelled, repeat to the byte, and survive the disk."""
    case = toy.case
    draw = partial(rt.generate, case=case, per_class=3)
    made = draw(updated, seed=6)
    assert (made.inputs, made.outputs, made.rate) == (case.inputs, case.outputs, toy.rate)
    assert made.observed.shape == (6, toy.steps, toy.outputs)
    assert made.labels.tolist() == [HEALTHY] * 3 + ["Stuck"] * 3
    assert np.isfinite(made.observed).all()
    assert made.mask.all()
    assert same(made, draw(updated, seed=6))
    assert not np.array_equal(made.observed, draw(updated, seed=7).observed)
    updated.save(tmp_path / "twin")
    assert same(made, draw(rt.CorrectedTwin.load(tmp_path / "twin"), seed=6))
    rt.save(made, tmp_path / "made.npz")
    assert same(made, rt.load(tmp_path / "made.npz"))


def test_the_known_discrepancy_is_recovered(toy: Toy, updated: rt.CorrectedTwin) -> None:
    """Draws for new commands have the mean and the spread of the known discrepancy.

    The mean over a few calibration discrepancies has the standard error of their number.
    """
    test = toy.measured(20, count=40)
    drawn = updated.simulate(test.commands.repeat(5, axis=0), seed=1).observed
    last = slice(-toy.steps // 10, None)
    nominal = toy.case.twin.simulate(test.commands, seed=0).nominal
    real = (test.observed - nominal)[:, last].mean(axis=1)
    means = (drawn - nominal.repeat(5, axis=0))[:, last].mean(axis=1)
    tolerance = (4 * real.std(axis=0) / np.sqrt(toy.count)).clip(0.05)
    assert (np.abs(means.mean(axis=0) - real.mean(axis=0)) < tolerance).all()
    assert (np.abs(real.mean(axis=0)) > tolerance).all(), (
        "the discrepancy is larger than the uncertainty"
    )


IN_COMMANDS = rt.CommandSpace(delay_range=(-0.2, 0.8))
POLLED = rt.Chain(IN_COMMANDS, rt.SampledSensor(period=0.4, phases=(0.0,)))
DELAYED = rt.DelayOffset(delay_range=(-0.2, 0.8))
PADDED = {
    "delay and offset": Toy(1, 2, 10.0, 60, DELAYED),
    "command space": Toy(2, 3, 10.0, 60, IN_COMMANDS, count=8),
    "polled": Toy(2, 3, 10.0, 80, POLLED, count=8),
    "polled, timing unknown": Toy(1, 2, 10.0, 100, rt.Chain(DELAYED, rt.SampledSensor())),
    "per sample": Toy(1, 2, 10.0, 60, Additive(), STEPWISE, count=3),
    "per sample, one record": Toy(1, 1, 10.0, 260, Additive(), STEPWISE, count=1),
}


# The toy "polled" infers in the commands too.
SLOW = {"command space": pytest.mark.slow}


@pytest.fixture(params=[pytest.param(name, marks=SLOW.get(name, ())) for name in PADDED])
def short(request: pytest.FixtureRequest) -> Toy:
    return PADDED[request.param]


@pytest.mark.slow
def test_padding_changes_no_discrepancy(short: Toy) -> None:
    """z*, its covariance, what is identified and what is left are those of the record itself."""
    record = lossy(short.measured(3), seed=4)
    _, alone = rt.infer_discrepancy(short.surrogate, record, short.correction)
    longer = record.padded(short.steps + 37)
    _, padded = rt.infer_discrepancy(short.surrogate, longer, short.correction)
    per_sample = short.correction.resolution == "step"
    for name in ("z", "covariance", "identified", "noise"):
        means, theirs = getattr(padded, name), getattr(alone, name)
        if per_sample and name != "noise":
            assert not means[:, short.steps :].any()
            means = means[:, : short.steps]
        torch.testing.assert_close(means, theirs, atol=1e-6, rtol=1e-6, equal_nan=True)


@pytest.mark.slow
def test_padding_changes_no_likelihood(short: Toy) -> None:
    """What the RG learns, and how likely it calls what it learned from, stay what they were."""
    record = lossy(short.measured(3), seed=4)
    brief = few_epochs(short.density)

    def learned(data: rt.Trajectories) -> tuple[torch.nn.Module, torch.Tensor]:
        rg = rt.fit_residual(short.surrogate, data, short.correction, brief, seed=5)
        context, found = rt.infer_discrepancy(short.surrogate, record, rg.correction)
        with torch.no_grad():
            log_density = rg(context).log_prob(found.z.float())
        return rg, log_density[found.identified.all(dim=-1)]

    alone, likely = learned(record)
    padded, as_likely = learned(record.padded(short.steps + 37))
    torch.testing.assert_close(as_likely, likely, atol=1e-6, rtol=1e-6)
    for name, weight in alone.state_dict().items():
        torch.testing.assert_close(padded.state_dict()[name], weight, atol=1e-6, rtol=1e-6)


def test_a_record_gives_the_same_beside_a_longer_one() -> None:
    """Unequal lengths: what is found of one does not depend on how long the others are."""
    toy = PADDED["delay and offset"]
    longer = Toy(1, 2, 10.0, 97, DELAYED).measured(8)
    record = lossy(toy.measured(3), seed=4)
    both = rt.Trajectories.concatenate([record, longer])
    assert both.lengths.tolist() == record.lengths.tolist() + [97] * len(longer)
    _, alone = rt.infer_discrepancy(toy.surrogate, record, DELAYED)
    _, beside = rt.infer_discrepancy(toy.surrogate, both, DELAYED)
    torch.testing.assert_close(beside.z[: len(record)], alone.z, atol=1e-6, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["delay and offset", "per sample"])
def test_fidelity_of_unequal_records(name: str) -> None:
    """It is finite where samples are missing and records end early."""
    toy = PADDED[name]
    rg = rt.fit_residual(toy.surrogate, toy.measured(3), toy.correction, toy.density, seed=5)
    test = lossy(unequal(toy.measured(30, count=6)), seed=31)
    found = rt.measure_fidelity(rt.CorrectedTwin(toy.surrogate, rg), test, draws=19, seed=1).figures
    for figure, value in found.items():
        assert np.isfinite(value.value), figure
    assert 0.5 < found["coverage90"].value <= 1


def test_a_twin_with_memory_learns_nothing_from_padding() -> None:
    """Held outputs are not what a dynamic twin would have said there."""
    toy = PADDED["per sample"]
    made = toy.case.twin.simulate(toy.commands(12, 1), seed=0)
    lag = lfilter([0.2], [1, -0.8], made.nominal, axis=1)
    made = made.replace(nominal=lag, observed=lag)
    how = Training(max_epochs=3, batch_size=4)
    alone = rt.fit_surrogate(made, LSTM(4), seed=0, training=how)
    padded = rt.fit_surrogate(made.padded(90), LSTM(4), seed=0, training=how)
    for name, weight in alone.state_dict().items():
        torch.testing.assert_close(padded.state_dict()[name], weight, atol=1e-6, rtol=1e-6)
    assert padded.fitted.figures == pytest.approx(alone.fitted.figures, rel=1e-5)


def test_files_of_unequal_length_are_padded(tmp_path: Path) -> None:
    """A folder of CSV files, each as long as it is, tells the same as the records themselves."""
    toy = PADDED["delay and offset"]
    record = unequal(toy.measured(3, count=4))
    (tmp_path / HEALTHY).mkdir()
    for i, length in enumerate(record.lengths):
        columns = (record.commands, record.nominal, record.observed)
        block = np.concatenate([each[i, :length] for each in columns], axis=1)
        np.savetxt(tmp_path / HEALTHY / f"{i}.csv", block, delimiter=",", fmt="%.9g")
    read = rt.load(tmp_path, case=toy.case)
    assert read.lengths.tolist() == record.lengths.tolist() == [60, 60, 48, 48]
    _, found = rt.infer_discrepancy(toy.surrogate, read, DELAYED)
    _, wanted = rt.infer_discrepancy(toy.surrogate, record, DELAYED)
    torch.testing.assert_close(found.z, wanted.z, atol=1e-4, rtol=1e-4)


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_lengths_tell_padding_from_what_is_missing(data: st.DataObject) -> None:
    """A trajectory ends with what was measured or commanded last, whatever is missing before."""
    steps, more = data.draw(st.integers(2, 9)), data.draw(st.integers(0, 5))
    mask = data.draw(st.lists(st.booleans(), min_size=steps, max_size=steps))
    level = data.draw(st.lists(st.sampled_from([0.0, 1.0]), min_size=steps, max_size=steps))
    mask[data.draw(st.integers(0, steps - 1))] = True
    column = np.array(level)[None, :, None]
    one = rt.Trajectories(
        commands=column,
        nominal=column,
        observed=column,
        rate=1.0,
        mask=np.array(mask)[None, :, None],
    )
    events = [t for t in range(steps) if mask[t] or (t and level[t] != level[t - 1])]
    assert one.lengths.tolist() == [events[-1] + 1]
    longer = one.padded(steps + more)
    assert longer.lengths.tolist() == one.lengths.tolist()
    assert not longer.mask[:, steps:].any()
    assert (longer.commands[:, steps:] == column[:, -1:]).all()
    with pytest.raises(rt.InputError, match="padding makes them longer"):
        one.padded(steps - 1)


def with_outputs(toy: Toy, scale: list[float], offset: float) -> list[rt.Trajectories]:
    """Twin and calibration data with every output in another unit, and no unit's name."""
    sets = toy.case.twin.simulate(toy.commands(60, 1), seed=0), toy.measured(3)
    unnamed = rt.Channels.numbered("y", toy.outputs)
    return [
        each.replace(
            nominal=each.nominal * scale + offset,
            observed=each.observed * scale + offset,
            outputs=unnamed,
        )
        for each in sets
    ]


ODD = {
    "a millionth and a million": ((1e-6, 1e6), 0.0),
    "tiny numbers": ((1e-12, 1e-12), 0.0),
    "great numbers": ((1e15, 1e15), 0.0),
    "an output that never moves": ((1.0, 0.0), 3.0),
}


@cache
def drawn_discrepancy(
    scale: tuple[float, ...], offset: float, correction: rt.Correction
) -> NDArray:
    """Residuals that the corrected twin generates."""
    twin, measured = with_outputs(PADDED["delay and offset"], list(scale), offset)
    surrogate = rt.fit_surrogate(twin, rt.MLP((16,)), seed=0, training=QUICK)
    # The errors of commands do not have the units of the outputs, which are what changes here.
    density = few_epochs(DENSITY) if isinstance(correction, rt.CommandSpace) else DENSITY
    rg = rt.fit_residual(surrogate, measured, correction, density, seed=5)
    made = rt.CorrectedTwin(surrogate, rg).simulate(measured.commands, seed=1)
    return made.observed - made.nominal


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "correction"),
    [
        *((name, DELAYED) for name in ODD),
        ("a millionth and a million", IN_COMMANDS),
    ],
)
@pytest.mark.filterwarnings("ignore:correction. bands of 90 %")
@pytest.mark.filterwarnings("ignore:calibration. y2, never changes")
def test_the_units_of_outputs_do_not_matter(name: str, correction: rt.Correction) -> None:
    """The same discrepancy is found in other units."""
    scale, offset = ODD[name]
    found = drawn_discrepancy(scale, offset, correction)
    assert np.isfinite(found).all()
    wanted = drawn_discrepancy((1.0, 1.0), 0.0, correction) * scale
    error = np.abs(found - wanted).mean(axis=(0, 1))
    size = np.abs(wanted).mean(axis=(0, 1))
    # Behind a large constant, single precision leaves fewer digits.
    assert (error <= 0.1 * size + 2e-3 * np.array(scale) + 2e-3 * offset).all()


@pytest.mark.slow
@pytest.mark.parametrize("density", [DENSITY, STEPWISE])
def test_no_discrepancy_at_all(density: Density | SequenceMixture) -> None:
    """A real system that is the twin: nothing is added to it, and every figure is a number."""
    toy = PADDED["per sample" if isinstance(density, SequenceMixture) else "delay and offset"]
    measured = toy.measured(3, count=6)
    measured = measured.replace(observed=toy.surrogate.predict(measured.commands))
    rg = rt.fit_residual(toy.surrogate, measured, toy.correction, density, seed=5)
    twin = rt.CorrectedTwin(toy.surrogate, rg)
    made = twin.simulate(measured.commands, seed=1)
    np.testing.assert_allclose(made.observed, made.nominal, atol=1e-6)
    figures = rt.measure_fidelity(twin, measured, draws=19, seed=1).figures
    assert all(np.isfinite(figure.value) for figure in figures.values())


def test_a_single_trajectory_is_warned_of() -> None:
    """It cannot be validated on; what it tells is used."""
    toy = PADDED["delay and offset"]
    with pytest.warns(UserWarning, match="1 trajectories to calibrate on"):
        rg = rt.fit_residual(toy.surrogate, toy.measured(3, count=1), DELAYED, DENSITY, seed=5)
    made = rt.CorrectedTwin(toy.surrogate, rg).simulate(toy.commands(3, 9), seed=1)
    assert np.isfinite(made.observed).all()


@pytest.mark.parametrize("name", PADDED)
def test_nothing_measured_is_refused(name: str) -> None:
    toy = PADDED[name]
    measured = toy.measured(3)
    blind = measured.replace(mask=np.zeros_like(measured.mask))
    with pytest.raises(rt.InputError, match="calibration: expected measurements"):
        rt.fit_residual(toy.surrogate, blind, toy.correction, toy.density, seed=5)


def test_an_output_that_is_never_measured_leaves_the_others() -> None:
    """Its own offset is not identified; delays and the others' offsets are, as without it."""
    toy = PADDED["delay and offset"]
    measured = toy.measured(3)
    half = measured.replace(mask=np.broadcast_to([True, False], measured.mask.shape))
    _, found = rt.infer_discrepancy(toy.surrogate, half, DELAYED)
    assert (found.identified.float().mean(dim=(0, 1)) >= torch.tensor([0.8, 1.0, 0.0])).all()
    assert not found.identified[..., 2].any()
    _, whole = rt.infer_discrepancy(toy.surrogate, measured, DELAYED)
    assert (found.z - whole.z)[..., 0].abs().median() < 0.2
    assert (found.z - whole.z)[..., 1].abs().max() < 0.01


@pytest.mark.slow
def test_a_study_of_two_classes_makes_a_page(tmp_path: Path) -> None:
    """Healthy or stuck: what the updated twin teaches is scored, and the page opens."""
    toy = Toy(2, 1, 10.0, 60, DELAYED)
    rng = np.random.default_rng(2)
    healthy = toy.measured(40, count=10)
    stuck = toy.measured(50, count=10)
    held = stuck.commands.copy()
    held[:, 6:, 0] = held[:, 6:7, 0]
    observed = ideal(held, 1) + rng.normal(MEAN, SPREAD, (10, 1, 1)) * toy.begun(stuck.commands)
    stuck = stuck.replace(observed=observed, labels=np.full(10, "Stuck"))
    rt.save(rt.Trajectories.concatenate([healthy, stuck]), tmp_path / "real.npz")
    plan = rt.StudyPlan(sources=("dt", "ibg_rg"), runs=1, folds=2, per_class=50)
    data = rt.StudyData(real=tmp_path / "real.npz")
    results = rt.run_study(toy.case, plan, data, tmp_path / "study", processes=1)
    assert results.classes == [HEALTHY, "Stuck"]
    assert results.sources["ibg_rg"].runs("accuracy")[0] >= 0.7
    page = rt.write_report(tmp_path / "study")
    assert "Stuck" in Path(page).read_text("utf-8")
