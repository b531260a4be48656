"""Simulations to Zarr: the same bytes in every mode, nothing repeated, lost or hidden."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import tracemalloc
import uuid
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import retwin as rt
from retwin import twins
from retwin.data.io.zarr_folder import read_header, read_zarr
from retwin.deploy.simulations import Simulated, SimulationPlan, simulate_to
from retwin.deploy.simulations.job import _check_same
from retwin.progress import Progress
from retwin.serialisation.files import sha256
from retwin.serialisation.identity import identity
from retwin.twins.collected import SimulationError
from retwin.twins.commands.samplers import RampSampler
from retwin.twins.twin import Chunk, simulate_in_chunks
from retwin.workers.jobs import alone

FAULTS = {"Healthy": None, "Stuck": rt.Stuck(0, 0.3), "Biased": rt.ActuatorBias(1, (10.0, 50.0))}
SAMPLER = RampSampler((0.0, 0.0), (100.0, 100.0), 10.0, 3.0, segments=2, ramp_durations=(0.3, 0.5))


VOLTAGES = rt.Channels(("a", "b"), ("V", "V"))
PLACE = rt.Channels(("x",), ("m",))
RANGE = rt.Limits((0.0, 0.0), (100.0, 100.0))


@dataclass(frozen=True)
class Toy:
    """Adds noise to its first command, slowly if asked to, and fails above a level.

    Every call leaves a file in `calls`, named by its seed: each chunk has its own.
    """

    calls: str = ""
    pause: float = 0.0
    fails_above: float = np.inf
    workers: int = 0
    inputs: rt.Channels = VOLTAGES
    outputs: rt.Channels = PLACE
    rate: float = 10.0
    limits: rt.Limits = RANGE

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[rt.Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> rt.Trajectories:
        if self.calls:
            (Path(self.calls) / f"{seed}-{uuid.uuid4().hex}").touch()
        time.sleep(self.pause)
        rng = np.random.default_rng(seed)

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            last = chunk.commands[:, -1, 0]
            for i in np.flatnonzero(last > self.fails_above):
                chunk.failed[int(i)] = f"ends at\n{last[i]:.1f}"
            noise = rng.normal(size=(*chunk.held_commands.shape[:2], 1))
            return chunk.commands[..., :1], chunk.held_commands[..., :1] + noise

        return simulate_in_chunks(self, run, commands, faults, seed=seed, progress=progress)


def plan(**changes: Any) -> SimulationPlan:
    settings = {"twin": Toy(), "commands": SAMPLER, "seed": 3, "n": 95, "chunk": 8}
    return SimulationPlan(**{**settings, "faults": FAULTS, **changes})


def calls(folder: Path) -> dict[str, int]:
    """How often each chunk was simulated, by its seed."""
    seeds = [file.name.partition("-")[0] for file in folder.iterdir()]
    return {seed: seeds.count(seed) for seed in seeds}


# --- what is made --------------------------------------------------------------------------------


def test_every_trajectory_is_what_its_twin_says(tmp_path: Path) -> None:
    shares: list[float] = []
    done = simulate_to(tmp_path / "a.zarr", plan(), progress=shares.append, workers=1)
    assert done == Simulated(tmp_path / "a.zarr", 95, {})
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert os.listdir(tmp_path) == ["a.zarr"]
    made = rt.load(tmp_path / "a.zarr")
    assert made.labels.tolist() == (32 * ["Healthy", "Stuck", "Biased"])[:95]
    assert made.ids[[0, 94]].tolist() == ["00000", "00094"]
    assert made.observed.dtype == np.float32
    assert made.inputs == Toy.inputs
    assert made.outputs == Toy.outputs
    assert made.rate == 10.0
    assert made.provenance[0].name == "Toy seed=3"
    assert not made.emulated
    assert made.mask.all()
    np.testing.assert_array_equal(made.nominal[..., 0], made.commands[..., 0])
    # Chunk 5 by hand: its seed is the fifth child of the plan's.
    drawn, simulated = np.random.SeedSequence(3, spawn_key=(5,)).spawn(2)
    commands = SAMPLER.sample(8, rng=np.random.default_rng(drawn))
    faults = [list(FAULTS.values())[i % 3] for i in range(40, 48)]
    hand = Toy().simulate(commands, faults=faults, seed=int(simulated.generate_state(1)[0]))
    np.testing.assert_array_equal(made[40:48].observed, hand.observed.astype(np.float32))
    assert len(np.unique(made.commands[:, -1], axis=0)) == 95


def test_commands_that_are_given_are_taken_in_turn(tmp_path: Path) -> None:
    given = SAMPLER.sample(10, rng=np.random.default_rng(0))
    twin = Toy()
    recorded = twin.simulate(given, seed=0)
    for commands, suffix, options in ((given, ".zarr", {"workers": 1}), (recorded, ".npz", {})):
        file = tmp_path / f"a{suffix}"
        simulate_to(file, plan(commands=commands, n=25, faults={"Healthy": None}), **options)
        np.testing.assert_array_equal(rt.load(file).commands, given[np.arange(25) % 10])
    assert plan(commands=given, n=None).count == 10


def test_npz_and_zarr_hold_the_same(tmp_path: Path) -> None:
    for name, options in (("a.zarr", {"workers": 1}), ("a.npz", {})):
        simulate_to(tmp_path / name, plan(twin=Toy(fails_above=60.0)), **options)
    one, other = (rt.load(tmp_path / name) for name in ("a.zarr", "a.npz"))
    for name in ("commands", "nominal", "observed", "mask", "labels", "ids"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.provenance == other.provenance


def test_an_emulated_twin_says_so(tmp_path: Path, case: rt.Case) -> None:
    some = SimulationPlan(case.emulator, case.sampler, seed=0, n=3)
    simulate_to(tmp_path / "a.zarr", some)
    assert rt.load(tmp_path / "a.zarr").emulated


@dataclass(frozen=True)
class Timed(Toy):
    """Has seen when movements begin, as a corrected twin has."""

    onsets = np.array([[0.4, 1.7]])


def test_a_twin_with_onsets_hands_them_to_the_sampler(tmp_path: Path) -> None:
    simulate_to(tmp_path / "a.zarr", plan(twin=Timed(), n=9), workers=1)
    starts = rt.Segments.from_commands(rt.load(tmp_path / "a.zarr").commands).start
    np.testing.assert_allclose(starts, [[4, 17]] * 9, atol=1e-2)


# --- the same bytes, whoever does it -------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A plan done without interruption in one process, and the SHA-256 of its folder."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "calls").mkdir()
    # The plan of the tests below: slow enough to be interrupted, some trajectories fail.
    slow = plan(twin=Toy(str(folder / "calls"), pause=0.1, fails_above=90.0))
    simulate_to(folder / "a.zarr", slow, workers=1)
    return {"plan": slow, "sha256": sha256(folder / "a.zarr"), "calls": folder / "calls"}


def clean(whole: dict[str, Any]) -> Path:
    for file in whole["calls"].iterdir():
        file.unlink()
    return whole["calls"]


SCRIPT = """
import sys
sys.path.insert(0, {tests!r})
from test_simulations import Toy, plan
from retwin.deploy.simulations import simulate_to
if __name__ == "__main__":
    twin = Toy({calls!r}, pause=0.1, fails_above=90.0)
    simulate_to({target!r}, plan(twin=twin), workers=2)
"""


@pytest.mark.slow
def test_killed_and_resumed(tmp_path: Path, whole: dict[str, Any]) -> None:
    folder, target = clean(whole), tmp_path / "a.zarr"
    script = SCRIPT.format(tests=str(Path(__file__).parent), calls=str(folder), target=str(target))
    (tmp_path / "main.py").write_text(script)
    process = subprocess.Popen([sys.executable, tmp_path / "main.py"], start_new_session=True)
    done = tmp_path / "a.zarr.part" / "done"
    deadline = time.monotonic() + 60
    while not (done.exists() and len(list(done.glob("[0-9]*"))) >= 3):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not target.exists()
    finished = [int(mark.stem) for mark in done.glob("[0-9]*")]
    assert 3 <= len(finished) < 12
    written = {
        number: (done.parent / f"data/observed/c/{number}/0/0").stat().st_mtime_ns
        for number in finished
    }
    # What a process that is killed while it writes leaves behind.
    (done.parent / "data/observed/c/0/0/0.0123.partial").write_text("half")
    before = calls(folder)
    result = simulate_to(target, whole["plan"], workers=2)
    assert sha256(target) == whole["sha256"]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.zarr", "main.py"]
    for number, when in written.items():
        assert (target / f"observed/c/{number}/0/0").stat().st_mtime_ns == when
    # Only chunks that were begun and not finished are simulated again: at most one per worker.
    after = calls(folder)
    assert len(after) == 12
    assert sum(after.values()) - 12 <= 2
    assert sum(after.values()) - sum(before.values()) == 12 - len(finished)
    assert result.failed


@pytest.mark.slow
def test_on_a_cluster_with_a_worker_killed(tmp_path: Path, whole: dict[str, Any]) -> None:
    from distributed import LocalCluster

    clean(whole)
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        victims = [worker.pid for worker in cluster.workers.values()]

        def kill(share: float) -> None:
            if share > 0 and len(victims) == 2:
                os.kill(victims.pop(), signal.SIGKILL)

        result = simulate_to(
            tmp_path / "a.zarr",
            whole["plan"],
            scheduler=cluster.scheduler_address,
            progress=kill,
        )
    assert len(victims) == 1
    assert sha256(tmp_path / "a.zarr") == whole["sha256"]
    assert result.failed


@pytest.mark.slow
def test_a_worker_process_that_dies_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "calls").mkdir()
    deadly = Deadly(str(tmp_path / "calls"))
    simulate_to(tmp_path / "a.zarr", plan(twin=deadly, n=24), workers=2)
    simulate_to(tmp_path / "b.zarr", plan(twin=Toy(), n=24), workers=1)
    assert sorted(calls(tmp_path / "calls").values()) == [1, 1, 2]
    np.testing.assert_array_equal(
        rt.load(tmp_path / "a.zarr").observed, rt.load(tmp_path / "b.zarr").observed
    )


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_warnings_of_workers_are_warnings_of_the_caller(
    workers: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.warns(UserWarning, match="the valve sticks") as given:
        simulate_to(tmp_path / "a.zarr", plan(twin=Sticking(), n=24), workers=workers)
    assert {each.category for each in given} == {UserWarning}
    assert capfd.readouterr().err == ""


@dataclass(frozen=True)
class Sticking(Toy):
    """Warns of each call."""

    def simulate(self, commands: NDArray, **options: Any) -> rt.Trajectories:
        warnings.warn("the valve sticks", UserWarning, stacklevel=1)
        return super().simulate(commands, **options)


@dataclass(frozen=True)
class Deadly(Toy):
    """Ends its process when it is asked for the first time ever."""

    def simulate(self, commands: NDArray, **options: Any) -> rt.Trajectories:
        first = not any(Path(self.calls).iterdir())
        if first:
            (Path(self.calls) / f"{options['seed']}-first").touch()
            os._exit(9)
        return super().simulate(commands, **options)


def test_ctrl_c_leaves_what_is_finished(tmp_path: Path, whole: dict[str, Any]) -> None:
    folder = clean(whole)

    def interrupt(share: float) -> None:
        if share > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_to(tmp_path / "a.zarr", whole["plan"], workers=1, progress=interrupt)
    finished = len(list((tmp_path / "a.zarr.part/done").iterdir()))
    assert 0 < finished < 12
    shares: list[float] = []
    simulate_to(tmp_path / "a.zarr", whole["plan"], workers=1, progress=shares.append)
    assert shares[0] == pytest.approx(finished * 8 / 95)
    assert sha256(tmp_path / "a.zarr") == whole["sha256"]
    assert sum(calls(folder).values()) <= 13


@pytest.mark.parametrize("step", ["seal_chunked", "_remove"])
def test_killed_at_the_end(
    tmp_path: Path, whole: dict[str, Any], step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Just before the header is written, and after the folder was moved."""
    clean(whole)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(f"retwin.deploy.simulations.job.{step}", killed)
        with pytest.raises(KeyboardInterrupt):
            simulate_to(tmp_path / "a.zarr", whole["plan"], workers=1)
    before = calls(whole["calls"])
    simulate_to(tmp_path / "a.zarr", whole["plan"], workers=1)
    assert calls(whole["calls"]) == before
    assert sha256(tmp_path / "a.zarr") == whole["sha256"]
    assert os.listdir(tmp_path) == ["a.zarr"]


@pytest.mark.slow
def test_a_finished_folder_is_not_made_again(tmp_path: Path, whole: dict[str, Any]) -> None:
    first = simulate_to(tmp_path / "a.zarr", whole["plan"])
    before = calls(clean(whole))
    assert simulate_to(tmp_path / "a.zarr", whole["plan"]) == first
    assert calls(whole["calls"]) == before == {}


def test_memory_does_not_grow_with_the_number(tmp_path: Path) -> None:
    peaks = []
    for n in (512, 4096):
        long = SimulationPlan(Toy(), replace(SAMPLER, duration=50.0), seed=0, n=n, chunk=256)
        tracemalloc.start()
        simulate_to(tmp_path / f"{n}.zarr", long, workers=1)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


# --- what goes wrong -----------------------------------------------------------------------------


def test_failed_trajectories_are_recorded_and_left_out(tmp_path: Path) -> None:
    result = simulate_to(tmp_path / "a.zarr", plan(twin=Toy(fails_above=60.0)), workers=1)
    every = rt.load(tmp_path / "a.zarr")
    simulate_to(tmp_path / "b.zarr", plan(), workers=1)
    sound = rt.load(tmp_path / "b.zarr")
    ends = sound.commands[:, -1, 0]
    assert set(result.failed) == set(np.flatnonzero(ends > 60.0).tolist())
    some = min(result.failed)
    assert result.failed[some] == f"ends at {ends[some]:.1f}"
    header = read_header(tmp_path / "a.zarr")
    assert {int(i): reason for i, reason in header["failed"].items()} == result.failed
    kept = ends <= 60.0
    np.testing.assert_array_equal(every.observed, sound.observed[kept])
    np.testing.assert_array_equal(every.labels, sound.labels[kept])
    assert every.ids.tolist() == sound.ids[kept].tolist()


@pytest.mark.slow
def test_when_everything_fails_at_once_it_ends(tmp_path: Path) -> None:
    for name in ("a.zarr", "a.npz"):
        with pytest.raises(SimulationError, match="8 of 8 simulations failed: trajectory 0: ends"):
            simulate_to(tmp_path / name, plan(twin=Toy(fails_above=-1.0)))
        assert not (tmp_path / name).exists()
    with pytest.raises(SimulationError):
        simulate_to(tmp_path / "b.zarr", plan(twin=Toy(fails_above=-1.0), n=8), workers=1)
    assert not (tmp_path / "b.zarr.part").exists()


def test_a_number_too_large_to_be_stored_is_a_failure(tmp_path: Path) -> None:
    result = simulate_to(tmp_path / "a.zarr", plan(twin=Huge(), n=4))
    assert result.failed == {1: "a value is too large for float32"}
    assert len(rt.load(tmp_path / "a.zarr")) == 3
    simulate_to(tmp_path / "b.zarr", plan(twin=Huge(), n=4, dtype="float64"))
    assert rt.load(tmp_path / "b.zarr").observed.max() == 1e200


@dataclass(frozen=True)
class Huge(Toy):
    """The second trajectory is beyond single precision."""

    def simulate(self, commands: NDArray, **options: Any) -> rt.Trajectories:
        made = super().simulate(commands.astype(np.float64), **options)
        observed = made.observed.copy()
        observed[1] = 1e200
        return made.replace(observed=observed)


@dataclass(frozen=True)
class Short(Toy):
    """Loses a trajectory without a word."""

    def simulate(self, commands: NDArray, **options: Any) -> rt.Trajectories:
        return super().simulate(commands, **options)[1:]


@pytest.mark.slow
@pytest.mark.parametrize("chunk", ["observed/c/3/0/0", "labels/c/3"])
def test_a_damaged_chunk_is_seen_when_it_is_read(tmp_path: Path, chunk: str) -> None:
    folder = tmp_path / "a.zarr"
    simulate_to(folder, plan(), workers=1)
    file = folder / chunk
    sound = file.read_bytes()
    for at in range(0, len(sound), 1 + len(sound) // 40):
        file.write_bytes(sound[:at] + bytes([sound[at] ^ 1]) + sound[at + 1 :])
        with pytest.raises(rt.InputError, match=r"a\.zarr") as caught:
            rt.load(folder)
        assert "\n" not in str(caught.value)
    file.unlink()
    with pytest.raises(rt.InputError, match="chunk 3 as it was written"):
        rt.load(folder)
    assert len(read_zarr(folder, slice(0, 24))) == 24, "the other chunks are sound"


def test_rows_of_a_large_folder(tmp_path: Path) -> None:
    simulate_to(tmp_path / "a.zarr", plan(twin=Toy(fails_above=60.0)), workers=1)
    simulate_to(tmp_path / "b.zarr", plan(), workers=1)
    whole = read_zarr(tmp_path / "b.zarr")
    for rows in (slice(5, 40), slice(None), slice(None, None, -9), slice(90, 200), slice(0, 0)):
        part = read_zarr(tmp_path / "b.zarr", rows)
        np.testing.assert_array_equal(part.observed, whole.observed[rows])
        assert part.ids.tolist() == whole.ids[rows].tolist()
    some = read_zarr(tmp_path / "a.zarr", slice(10, 20))
    assert set(some.ids.tolist()) < {f"{i:05d}" for i in range(10, 20)}, "failures are left out"
    rt.save(whole, tmp_path / "c.zarr")
    assert read_zarr(tmp_path / "c.zarr", slice(3, 5)).ids.tolist() == ["00003", "00004"]


def test_a_newer_schema_is_refused(tmp_path: Path) -> None:
    simulate_to(tmp_path / "a.zarr", plan(n=3))
    file = tmp_path / "a.zarr" / "zarr.json"
    header = json.loads(file.read_text())
    header["attributes"]["retwin"]["schema"] = 3
    file.write_text(json.dumps(header))
    with pytest.raises(rt.InputError, match="schema 2 or older, got schema 3; upgrade"):
        rt.load(tmp_path / "a.zarr")


# --- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("match", "changes"),
    [
        ("another seed", {"seed": 4}),
        ("another chunk", {"chunk": 9}),
        ("another n", {"n": 96}),
        ("another twin", {"twin": Toy(fails_above=1e3)}),
        ("another commands", {"commands": replace(SAMPLER, segments=1)}),
        ("another faults", {"faults": dict(reversed(FAULTS.items()))}),
        ("another clip, dtype", {"clip": True, "dtype": "float64"}),
    ],
)
def test_another_plan_is_refused(tmp_path: Path, match: str, changes: dict[str, Any]) -> None:
    def interrupt(share: float) -> None:
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_to(tmp_path / "a.zarr", plan(), progress=interrupt, workers=1)
    simulate_to(tmp_path / "b.zarr", plan(), workers=1)
    for name in ("a.zarr", "b.zarr"):
        with pytest.raises(rt.InputError, match=f"{match};"):
            simulate_to(tmp_path / name, plan(**changes), workers=1)
    simulate_to(tmp_path / "a.zarr", plan(twin=Toy(workers=7)), workers=1)
    assert sha256(tmp_path / "a.zarr") == sha256(tmp_path / "b.zarr")


def test_a_plan_of_another_version_is_not_resumed() -> None:
    with pytest.raises(rt.InputError, match="one begun by another version of retwin"):
        _check_same(Path("a.zarr"), {"retwin": "0.0.9"}, {"retwin": "0.1.0"})


@pytest.mark.parametrize(
    ("match", "changes"),
    [
        ("n: expected a whole number of at least 1, got None", {"n": None}),
        ("n: ", {"n": 0}),
        ("seed: ", {"seed": -1}),
        ("chunk: ", {"chunk": 0}),
        ("dtype: ", {"dtype": "int8"}),
        ("faults: expected at least 1 class", {"faults": {}}),
        (r"commands: expected numbers of shape \(n, T, 2\)", {"commands": np.zeros((3, 30, 3))}),
        ("commands: expected finite", {"commands": np.full((3, 30, 2), np.nan)}),
        ("a from 0 to 100 V", {"commands": np.full((3, 30, 2), 101.0)}),
    ],
)
def test_a_plan_that_cannot_be(match: str, changes: dict[str, Any]) -> None:
    with pytest.raises(rt.InputError, match=match):
        plan(**changes)


def test_commands_of_another_twin_are_refused() -> None:
    recorded = Toy().simulate(np.zeros((2, 30, 2)), seed=0)
    with pytest.raises(rt.InputError, match=r"commands\.rate: expected that of the twin, 10"):
        plan(commands=recorded.replace(rate=20.0))
    others = rt.Channels(("a", "c"), ("V", "V"))
    named = r"commands\.inputs: expected that of the twin, a \[V\], b \[V\], got a \[V\]"
    with pytest.raises(rt.InputError, match=named):
        plan(commands=recorded.replace(inputs=others))
    assert plan(commands=recorded.replace(inputs=None), n=None).count == 2


def test_clipping_is_asked_for(tmp_path: Path) -> None:
    beyond = np.full((3, 30, 2), 101.0)
    simulate_to(tmp_path / "a.zarr", plan(commands=beyond, clip=True), workers=1)
    assert rt.load(tmp_path / "a.zarr").commands.max() == 100.0
    wide = replace(SAMPLER, high=(200.0, 200.0))
    with pytest.raises(rt.InputError, match="from 0 to 100 V"):
        simulate_to(tmp_path / "b.zarr", plan(commands=wide), workers=1)
    assert os.listdir(tmp_path) == ["a.zarr"], "nothing is left half-written"


@dataclass(frozen=True)
class Strict(Toy):
    """Refuses to be stored beyond a level, and says which trajectory it was."""

    def simulate(self, commands: NDArray, **options: Any) -> rt.Trajectories:
        beyond = np.flatnonzero(commands[:, -1, 0] > self.fails_above)
        if len(beyond):
            raise rt.InputError(
                "commands", expected="less", got=f"more in trajectory {beyond[0]}", remedy="less"
            )
        return super().simulate(commands, **options)


def given(count: int) -> NDArray:
    """Commands that end at the trajectory's number."""
    return np.repeat(np.arange(count, dtype=float), 60).reshape(count, 30, 2)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_bad_input_is_counted_in_the_whole_set_and_leaves_nothing(
    tmp_path: Path, workers: int
) -> None:
    bad = plan(twin=Strict(fails_above=13.0), commands=given(20), n=None, chunk=4)
    for name, options in (("a.zarr", {"workers": workers}), ("a.npz", {})):
        with pytest.raises(rt.InputError, match="more in trajectory 14;"):
            simulate_to(tmp_path / name, bad, **options)
    assert not list(tmp_path.iterdir())


def test_bad_input_keeps_what_an_earlier_call_has_finished(tmp_path: Path) -> None:
    bad = plan(twin=Strict(fails_above=13.0), commands=given(20), n=None, chunk=4)

    def interrupt(share: float) -> None:
        if share > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_to(tmp_path / "a.zarr", bad, workers=1, progress=interrupt)
    with pytest.raises(rt.InputError, match=r"trajectory 14; .* stays in .*a\.zarr\.part"):
        simulate_to(tmp_path / "a.zarr", bad, workers=1)
    assert len(list((tmp_path / "a.zarr.part/done").iterdir())) == 3


class Leak(Exception):
    """It cannot be rebuilt from its message alone."""

    def __init__(self, valve: int, reason: str) -> None:
        super().__init__(f"valve {valve} {reason}")


@dataclass(frozen=True)
class Leaking(Toy):
    """Raises what no other process can build again."""

    def simulate(self, commands: NDArray, **options: Any) -> rt.Trajectories:
        if commands[-1, -1, 0] > self.fails_above:
            raise Leak(3, "leaks")
        return super().simulate(commands, **options)


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "kind"), [(1, Leak), (2, RuntimeError)])
def test_what_a_twin_raises_tells_where(
    tmp_path: Path, workers: int, kind: type[Exception]
) -> None:
    leaking = plan(twin=Leaking(fails_above=9.0), commands=given(12), n=None, chunk=4)
    with pytest.raises(kind, match="valve 3 leaks") as caught:
        simulate_to(tmp_path / "a.zarr", leaking, workers=workers)
    (note,) = caught.value.__notes__
    assert re.fullmatch(r".*test_simulations\.py:\d+, in trajectories 8 to 11", note)
    assert (tmp_path / "a.zarr.part").exists(), "it may go on when the twin is mended"


@pytest.mark.slow
def test_bad_places_and_calls(tmp_path: Path) -> None:
    def refused(match: str, name: str, **options: Any) -> None:
        with pytest.raises(rt.InputError, match=match) as caught:
            simulate_to(tmp_path / name, options.pop("plan", plan()), **options)
        assert "\n" not in str(caught.value)

    refused(r"\.npz or \.zarr", "a.csv")
    refused("at least 1", "a.zarr", workers=0)
    refused("or None with a scheduler", "a.zarr", workers=2, scheduler="tcp://nowhere:1")
    refused("with workers", "a.npz", workers=2)
    refused("for more than 512 MB", "a.npz", plan=plan(n=10**7))
    refused("one trajectory per command", "a.zarr", plan=plan(twin=Short()))
    refused("that other processes can import", "a.zarr", plan=plan(twin=Local()), workers=2)
    refused("the address of a Dask scheduler", "a.zarr", scheduler="nonsense://")
    assert not list(tmp_path.iterdir())
    rt.save(Toy().simulate(np.zeros((2, 30, 2)), seed=0), tmp_path / "saved.zarr")
    refused("which is neither", "saved.zarr")
    (tmp_path / "other.zarr").mkdir()
    refused("which is neither", "other.zarr")
    (tmp_path / "b.zarr.part").mkdir()
    refused("something else there", "b.zarr")
    (tmp_path / "file").touch()
    refused("place that can be written", "file/a.zarr")


@dataclass(frozen=True)
class Local(Toy):
    """Cannot be sent to another process."""

    secret: Callable[[], int] = lambda: 0


# --- what a plan is made of ----------------------------------------------------------------------


@pytest.fixture
def network() -> rt.Surrogate:
    return rt.Surrogate(rt.MLP((4,)), inputs=VOLTAGES, outputs=PLACE, rate=10.0)


def test_identity_tells_apart_what_differs(tmp_path: Path, network: rt.Surrogate) -> None:
    file = tmp_path / "model.xml"
    file.write_text("one")
    before = identity([file])
    file.write_text("two")
    other = rt.Surrogate(rt.MLP((4,)), inputs=VOLTAGES, outputs=PLACE, rate=10.0)
    things = [
        before,
        *map(identity, ([file], file.name, network, other, Toy(), Toy(pause=1.0), Timed())),
        *map(identity, (np.zeros(2), np.zeros(3), np.zeros(2, np.float32), 0.0, None)),
        *map(identity, (rt.load, rt.save, Toy, Toy().simulate, Toy(pause=1.0).simulate)),
        *map(identity, (partial(rt.load, rate=1.0), partial(rt.load, rate=2.0))),
    ]
    assert len(set(things)) == len(things)
    assert identity(rt.cases.armpi().twin) == identity(rt.cases.armpi().twin)


MODEL = """
<mujoco>
  <include file="arm.xml"/>
  <asset><mesh name="box" file="box.obj"/></asset>
  <worldbody><geom type="mesh" mesh="box" pos="0 0 -1"/></worldbody>
  <actuator><motor name="push" joint="hinge"/></actuator>
</mujoco>
"""
ARM = """
<mujoco>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""
CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]


def test_a_mujoco_twin_is_known_by_all_its_files(tmp_path: Path) -> None:
    def identity_of(arm: str, height: int) -> str:
        (tmp_path / "arm.xml").write_text(arm)
        corners = (f"v {x} {y} {height * z}\n" for x, y, z in CORNERS)
        (tmp_path / "box.obj").write_text("".join(corners))
        # MuJoCo keeps meshes by their time of change, in seconds.
        os.utime(tmp_path / "box.obj", (height, height))
        return identity(twins.get(str(tmp_path / "model.xml"), outputs=["arm"]))

    (tmp_path / "model.xml").write_text(MODEL)
    made = [
        identity_of(ARM, 1),
        identity_of(ARM.replace('mass="1"', 'mass="2"'), 1),
        identity_of(ARM, 2),
    ]
    assert len(set(made)) == 3
    assert identity_of(ARM, 1) == made[0]


@pytest.mark.slow
def test_identity_is_the_same_in_another_process(tmp_path: Path, network: rt.Surrogate) -> None:
    network.save(tmp_path / "model")
    code = (
        "import sys, retwin as rt; from retwin.serialisation.identity import identity;"
        "case = rt.cases.armpi();"
        "print(*map(identity, (rt.Surrogate.load(sys.argv[1]), case.sampler, case.twin.physics)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "model"], check=True, capture_output=True, text=True
    )
    case = rt.cases.armpi()
    parts = (rt.Surrogate.load(tmp_path / "model"), case.sampler, case.twin.physics)
    assert done.stdout.split() == [identity(part) for part in parts]


def test_workers_work_alone() -> None:
    @dataclass(frozen=True)
    class Around:
        twin: Toy
        threads: int = 0

    assert alone(Around(Toy(workers=5))) == Around(Toy(workers=1), threads=1)
    same = Toy(workers=1)
    assert alone(same) is same
    assert alone(3) == 3


def test_more_than_the_disk_or_the_memory_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    huge = 999_999_999_999_999_999_999
    with pytest.raises(rt.InputError, match=r"n: expected contents of .* of the free disk"):
        simulate_to(tmp_path / "a.zarr", plan(n=huge))
    with pytest.raises(rt.InputError, match=r"for more than 512 MB"):
        simulate_to(tmp_path / "a.npz", plan(n=huge))
    with pytest.raises(rt.InputError, match="chunk: expected a whole number from 1 to"):
        plan(chunk=2**63)
    monkeypatch.setattr("retwin.serialisation.sizes.memory", lambda: (10**6, 10**6))
    with pytest.raises(rt.InputError, match="chunk: expected contents of at most 500 kB"):
        simulate_to(tmp_path / "a.zarr", plan(n=10**4, chunk=10**4))
    assert not list(tmp_path.iterdir())
    with pytest.raises(rt.InputError, match="per_class: expected contents of at most"):
        rt.generate(rt.cases.armpi().twin, rt.cases.armpi(), per_class=10**7, seed=0)
