"""How many kinds of data that lie are named by `check_records`, and how often clean data are.

Three systems: the emulated arm, the tanks that overflow with the twin that does not, and a heated
room with two outputs whose twin lacks a loss to the floor. Each kind of fault is put into sets of
nine records, into one, three or all of them; it counts as named where a finding has the right
record and, where one channel has it, the right channel.

    python benchmarks/lying_data.py --repeats 5 --clean 30
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC
from retwin.cases.cascaded_tanks.case import OVERFLOWING, VOLTAGES
from retwin.cases.cascaded_tanks.twin import TANKS
from retwin.data import Trajectories
from retwin.twins import State, StateTwin
from retwin.update.agreement import check_with_twin

RECORDS, THINNED = 9, 4
EVERY = "every"
"""Of a fault that all records have: a finding must be about all, or about each."""

Arrays = dict[str, NDArray]
Lie = Callable[[Arrays, int, int, np.random.Generator], None]
"""Changes arrays in place: those of all records, the record and the channel that lie."""


def room(x, u, p):
    flow = p.heat * u.heater - p.loss * (1 + u.fan) * (x.air - 20) - p.wall * (x.air - x.brick)
    return flow / p.capacity, p.wall * (x.air - x.brick) / 4000 - 2e-4 * p.floor * (x.brick - 15)


ROOM = StateTwin(
    [State("air", "degC", 20.0, 0.0, 90.0), State("brick", "degC", 20.0, 0.0, 90.0)],
    lambda x, u: (x.air, x.brick),
    rt.Channels(("heater", "fan"), ("1", "1")),
    rt.Channels(("air", "brick"), ("degC", "degC")),
    0.5,
    derivative=room,
    parameters=(
        rt.Parameter("heat", "W", 10.0, 1000.0, 180.0),
        rt.Parameter("loss", "W/K", 0.1, 20.0, 2.0),
        rt.Parameter("wall", "W/K", 0.1, 50.0, 6.0),
        rt.Parameter("capacity", "J/K", 10.0, 5000.0, 300.0),
        rt.Parameter("floor", "1", 0.0, 10.0, 0.0),
    ),
)
"""A room with a heater and a fan; the twin does not know that its wall loses heat to the floor."""


def arm(seed: int) -> tuple[rt.Twin, Trajectories]:
    case = rt.cases.armpi()
    assert case.emulator is not None
    commands = case.sampler.sample(RECORDS, rng=np.random.default_rng(seed))
    # A clean arm executes all movements, and its sensors have no glitches.
    real = replace(case.emulator, missed=0.0, glitch=0.0)
    made = real.simulate(commands, seed=seed)
    twin = rt.FunctionTwin(
        KINEMATIC.position, KINEMATIC.inputs, KINEMATIC.outputs, made.rate / THINNED
    )
    thin = {
        name: getattr(made, name)[:, ::THINNED]
        for name in ("commands", "nominal", "observed", "mask")
    }
    return twin, made.replace(**thin, rate=twin.rate)


def tanks(seed: int) -> tuple[rt.Twin, Trajectories]:
    commands = VOLTAGES.sample(RECORDS, rng=np.random.default_rng(seed))
    return TANKS, _measured(TANKS, OVERFLOWING, commands, 0.02, seed)


def heated(seed: int) -> tuple[rt.Twin, Trajectories]:
    rng = np.random.default_rng(seed)
    holds = rng.uniform(0, 1, (RECORDS, 20, 2)).repeat(30, axis=1)
    real = ROOM.parametric().with_values(
        {"heat": 210.0, "loss": 1.7, "wall": 5.0, "capacity": 350.0, "floor": 1.0}
    )
    return ROOM, _measured(ROOM, real, holds, 0.05, seed)


def _measured(
    twin: rt.Twin, real: rt.Twin, commands: NDArray, noise: float, seed: int
) -> Trajectories:
    outputs = real.simulate(commands, seed=0).observed.astype(float)
    outputs += noise * np.random.default_rng(seed).normal(size=outputs.shape)
    nominal = twin.simulate(commands, seed=0).observed
    return Trajectories(
        commands, nominal, outputs, twin.rate, inputs=twin.inputs, outputs=twin.outputs
    )


SYSTEMS = {"arm": arm, "tanks": tanks, "room": heated}


@dataclass(frozen=True)
class Kind:
    """A kind of lie: what it does, and where it must be named.

    `channel` states whether the lie is in one output; `of` is `one`, `three` or `every` record;
    `outputs` and `inputs` are how many of these a system needs for it; `whole` is whether it
    changes all records at once.
    """

    name: str
    lie: Lie
    channel: bool = True
    of: str = "one"
    outputs: int = 1
    inputs: int = 1
    whole: bool = False


def freeze(a: Arrays, i: int, k: int, rng, start: float, end: float = 1.0, every: bool = False):
    y = a["observed"]
    begin, stop = (round(share * y.shape[1]) for share in (start, end))
    use = slice(None) if every else k
    y[i, begin:stop, use] = y[i, begin, use]


def clip(a: Arrays, i: int, k: int, rng, low: float | None, high: float | None):
    y = a["observed"][i, :, k]
    ends = [None if q is None else y.min() + q * np.ptp(y) for q in (low, high)]
    a["observed"][i, :, k] = np.clip(y, *ends)


def drop(a: Arrays, i: int, k: int, rng, share: float, length: int, value: float = 0.0):
    y = a["observed"]
    count = max(1, round(share * y.shape[1] / length))
    for start in rng.choice(np.arange(5, y.shape[1] - 5 - length), count, replace=False):
        y[i, start : start + length, k] = value


def spike(a: Arrays, i: int, k: int, rng, size: float, count: int, length: int = 1):
    """Spikes of a size in ranges of the output."""
    y = a["observed"]
    for start in rng.choice(np.arange(5, y.shape[1] - 5 - length), count, replace=False):
        y[i, start : start + length, k] += size * np.ptp(y[i, :, k])


def noise(a: Arrays, i: int, k: int, rng, size: float, every: bool = False):
    y = a["observed"]
    use = slice(None) if every else slice(k, k + 1)
    mean, deviation = y[i, :, use].mean(axis=0), y[i, :, use].std(axis=0)
    y[i, :, use] = mean + size * deviation * rng.normal(size=y[i, :, use].shape)


def scale(a: Arrays, i: int, k: int, rng, factor: float, name: str = "observed"):
    a[name][i, :, k % a[name].shape[2]] *= factor


def copy(
    a: Arrays, i: int, k: int, rng, size: float = 0.0, shift: int = 0, step: float = 0.0, own=False
):
    """A copy of another record, by default with its commands."""
    j = (i + 4) % RECORDS
    y = np.roll(a["observed"][j], shift, axis=0)
    if shift > 0:
        y[:shift] = y[shift]
    if shift < 0:
        y[shift:] = y[shift - 1]
    y = y + size * np.ptp(y, axis=0) * rng.normal(size=y.shape)
    if step:
        q = step * np.ptp(y, axis=0)
        a["observed"][j] = np.round(a["observed"][j] / q) * q
        y = np.round(y / q) * q
    a["observed"][i] = y
    if not own:
        a["commands"][i], a["nominal"][i] = a["commands"][j], a["nominal"][j]


def swap_records(a: Arrays, i: int, k: int, rng, name: str = "observed"):
    j = (i + 4) % RECORDS
    a["observed"][[i, j]] = a["observed"][[j, i]]


def roll_records(a: Arrays, i: int, k: int, rng, by: int):
    a["observed"][:] = np.roll(a["observed"], by, axis=0)


def shuffle_records(a: Arrays, i: int, k: int, rng):
    order = rng.permutation(RECORDS)
    a["observed"][:] = np.roll(a["observed"][order], 1, axis=0)[np.argsort(order)]


def other_record(a: Arrays, i: int, k: int, rng):
    a["observed"][i] = a["observed"][(i + 4) % RECORDS] + 1e-2 * rng.normal(
        size=a["observed"][i].shape
    ) * np.ptp(a["observed"], axis=(0, 1))


def exchange(a: Arrays, i: int, k: int, rng, name: str = "observed", every: bool = True):
    rows = slice(None) if every else slice(i, i + 1)
    other = (k + 1) % a[name].shape[2]
    first, second = k % a[name].shape[2], other
    a[name][rows][..., [first, second]] = a[name][rows][..., [second, first]]


def stretch(a: Arrays, i: int, k: int, rng, factor: float, every: bool = False):
    y, time = a["observed"], np.arange(a["observed"].shape[1])
    for row in range(RECORDS) if every else [i]:
        y[row] = np.stack([np.interp(time * factor, time, own) for own in y[row].T], axis=1)


def reverse(a: Arrays, i: int, k: int, rng):
    a["observed"][i] = a["observed"][i, ::-1]


def negate(a: Arrays, i: int, k: int, rng, every: bool = False):
    rows = slice(None) if every else slice(i, i + 1)
    y = a["observed"][rows][..., k]
    a["observed"][rows][..., k] = 2 * y.mean() - y


def offset(a: Arrays, i: int, k: int, rng, size: float):
    """An offset in ranges of the output over all records."""
    a["observed"][i, :, k] += size * np.ptp(a["observed"][..., k])


def drift(a: Arrays, i: int, k: int, rng, size: float):
    y = a["observed"]
    y[i, :, k] += size * np.ptp(y[..., k]) * np.linspace(0, 1, y.shape[1])


def late(a: Arrays, i: int, k: int, rng, share: float):
    y = a["observed"][i]
    by = round(share * len(y))
    y[by:], y[:by] = y[:-by].copy(), y[0]


def stuck(a: Arrays, i: int, k: int, rng):
    """A machine that does not move: its outputs are at rest, with their noise."""
    y = a["observed"]
    level = np.median(np.abs(np.diff(y, axis=1)), axis=(0, 1))
    y[i] = y[i, 0] + level * rng.normal(size=y[i].shape)


KINDS = (
    Kind("copy", copy, channel=False),
    Kind("copy with noise of 1e-6", partial(copy, size=1e-6), channel=False),
    Kind("copy with noise of 1e-4", partial(copy, size=1e-4), channel=False),
    Kind("copy, a sample later", partial(copy, shift=1), channel=False),
    Kind("copy, two samples earlier", partial(copy, shift=-2), channel=False),
    Kind("copy, a sample later with noise", partial(copy, size=1e-6, shift=1), channel=False),
    Kind("copy, rounded to 1/200 of the range", partial(copy, step=0.005), channel=False),
    Kind("copy, rounded, a sample later", partial(copy, step=0.005, shift=1), channel=False),
    Kind("copy under other commands", partial(copy, own=True), channel=False),
    Kind("three copies", copy, channel=False, of="three"),
    Kind("frozen from 20 % on", partial(freeze, start=0.2)),
    Kind("frozen from 50 % on", partial(freeze, start=0.5)),
    Kind("frozen from 70 % on", partial(freeze, start=0.7)),
    Kind("frozen from 30 to 60 %", partial(freeze, start=0.3, end=0.6)),
    Kind("all outputs frozen from 20 % on", partial(freeze, start=0.2, every=True), channel=False),
    Kind("frozen all the time", partial(freeze, start=0.0)),
    Kind("frozen until 50 %", partial(freeze, start=0.0, end=0.5)),
    Kind("frozen in three records", partial(freeze, start=0.3), of="three"),
    Kind("all frozen in every record", partial(freeze, start=0.2, every=True), False, EVERY),
    Kind("clipped at 70 %", partial(clip, low=None, high=0.7)),
    Kind("clipped at 85 %", partial(clip, low=None, high=0.85)),
    Kind("clipped below 30 %", partial(clip, low=0.3, high=None)),
    Kind("clipped on both sides", partial(clip, low=0.25, high=0.75)),
    Kind("clipped in every record", partial(clip, low=None, high=0.6), of=EVERY),
    Kind("dropouts, 1 % of the samples", partial(drop, share=0.01, length=1)),
    Kind("dropouts, 5 % of the samples", partial(drop, share=0.05, length=1)),
    Kind("a single dropout", partial(drop, share=0.0, length=1)),
    Kind("dropouts of five samples", partial(drop, share=0.03, length=5)),
    Kind("dropouts in every record", partial(drop, share=0.01, length=1), of=EVERY),
    Kind("-9999 at 5 %", partial(drop, share=0.05, length=1, value=-9999.0)),
    Kind("65535 now and then", partial(drop, share=0.02, length=2, value=65535.0)),
    Kind("a spike of 1e6", partial(spike, size=1e6, count=1)),
    Kind("a spike of 100 ranges", partial(spike, size=100.0, count=1)),
    Kind("a spike of 3 ranges", partial(spike, size=3.0, count=1)),
    Kind("a spike of 1 range", partial(spike, size=1.0, count=1)),
    Kind("a negative spike", partial(spike, size=-5.0, count=1)),
    Kind("five spikes", partial(spike, size=4.0, count=5)),
    Kind("a spike of two samples", partial(spike, size=3.0, count=1, length=2)),
    Kind("white noise", partial(noise, size=1.0)),
    Kind("white noise of a tenth", partial(noise, size=0.1)),
    Kind("white noise of ten times", partial(noise, size=10.0)),
    Kind("white noise in all outputs", partial(noise, size=1.0, every=True), channel=False),
    Kind("unit 1000 times", partial(scale, factor=1e3)),
    Kind("unit 1/1000", partial(scale, factor=1e-3)),
    Kind("unit 100 times", partial(scale, factor=100.0)),
    Kind("unit 10 times", partial(scale, factor=10.0)),
    Kind("unit 1/10", partial(scale, factor=0.1)),
    Kind("unit 1000 times in every record", partial(scale, factor=1e3), of=EVERY),
    Kind("unit 1/100 in every record", partial(scale, factor=0.01), of=EVERY),
    Kind("command 1000 times", partial(scale, factor=1e3, name="commands"), channel=False),
    Kind("two records exchanged", swap_records, channel=False),
    Kind(
        "records shifted by one", partial(roll_records, by=1), channel=False, of=EVERY, whole=True
    ),
    Kind("records shuffled", shuffle_records, channel=False, of=EVERY, whole=True),
    Kind("outputs of another run", other_record, channel=False),
    Kind("outputs exchanged", exchange, of=EVERY, outputs=2, whole=True),
    Kind("outputs exchanged in one", partial(exchange, every=False), outputs=2),
    Kind(
        "commands exchanged",
        partial(exchange, name="commands"),
        channel=False,
        of=EVERY,
        inputs=2,
        whole=True,
    ),
    Kind("time base 10 % fast", partial(stretch, factor=1.1), channel=False),
    Kind("time base 10 % slow", partial(stretch, factor=0.9), channel=False),
    Kind(
        "time base 10 % fast in every record",
        partial(stretch, factor=1.1, every=True),
        channel=False,
        of=EVERY,
        whole=True,
    ),
    Kind("time reversed", reverse, channel=False),
    Kind("sign reversed", negate),
    Kind("sign reversed in every record", partial(negate, every=True), of=EVERY, whole=True),
    Kind("offset of two ranges", partial(offset, size=2.0)),
    Kind("drift by two ranges", partial(drift, size=2.0)),
    Kind("late by a quarter", partial(late, share=0.25), channel=False),
    Kind("healthy, but stuck", stuck, channel=False),
    Kind("three healthy ones stuck", stuck, channel=False, of="three"),
)


def arrays_of(records: Trajectories) -> Arrays:
    names = ("commands", "nominal", "observed")
    return {name: np.array(getattr(records, name), dtype=float) for name in names}


def tell(kind: Kind, records: Trajectories, rng: np.random.Generator) -> tuple[Trajectories, set]:
    """Records that lie, and the (record, channel) that must be named; "" for any channel."""
    made = arrays_of(records)
    k = int(np.argmax(np.ptp(made["observed"], axis=1).mean(axis=0)))  # one that moves
    first, number = int(rng.integers(RECORDS)), {"one": 1, "three": 3, EVERY: RECORDS}[kind.of]
    rows = [(first + n) % RECORDS for n in range(number)]
    for i in rows[: 1 if kind.whole else None]:
        kind.lie(made, i, k, rng)
    channel = records.outputs.names[k] if kind.channel else ""
    ids = records.ids.tolist()
    return records.replace(**made), {(ids[i], channel) for i in rows}


def named(findings: Sequence[rt.data.Finding], expected: set) -> float:
    """The share of what is expected that findings name; a copy may be either of a pair."""
    right = [
        any(
            (each.record in (record, "") or (each.kind == "copy" and record in each.text))
            and (not channel or each.channel == channel)
            for each in findings
        )
        for record, channel in expected
    ]
    return float(np.mean(right))


def lies(repeats: int) -> Iterator[tuple[str, dict[str, float]]]:
    data = {name: [make(seed) for seed in range(repeats)] for name, make in SYSTEMS.items()}
    for kind in KINDS:
        row = {}
        for name, sets in data.items():
            twin = sets[0][0]
            if len(twin.outputs) < kind.outputs or len(twin.inputs) < kind.inputs:
                continue
            shares = []
            for seed, (twin, records) in enumerate(sets):
                changed, expected = tell(kind, records, np.random.default_rng(seed))
                found = check_with_twin(None if "command 1000" in kind.name else twin, changed)
                shares.append(named(found.findings, expected))
            row[name] = float(np.mean(shares))
        yield kind.name, row


def clean(count: int) -> Iterator[tuple[str, int, int, list[str]]]:
    """False remarks in sets of clean records: how many of how many records, and which."""
    for name, make in SYSTEMS.items():
        remarks, records = [], 0
        for seed in range(1000, 1000 + count):
            twin, made = make(seed)
            found = check_with_twin(twin, made)
            remarks += [f"{seed}: {each}" for each in rt.data.summarise(found.findings)]
            records += len(made)
        yield name, len(remarks), records, remarks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--clean", type=int, default=10)
    parser.add_argument("--system", choices=SYSTEMS, action="append")
    chosen = parser.parse_args()
    for name in set(SYSTEMS) - set(chosen.system or SYSTEMS):
        del SYSTEMS[name]
    shares = []
    print(f"{'kind':42}" + "".join(f"{name:>8}" for name in SYSTEMS))
    for name, row in lies(chosen.repeats):
        shares += row.values()
        print(
            f"{name:42}" + "".join(f"{row[s]:8.0%}" if s in row else "       –" for s in SYSTEMS),
            flush=True,
        )
    print(f"{len(KINDS)} kinds, {np.mean(shares):.1%} named")
    for name, count, records, remarks in clean(chosen.clean):
        print(f"clean {name}: {count} remarks in {records} records")
        for each in remarks[:5]:
            print("   ", each)


if __name__ == "__main__":
    main()
