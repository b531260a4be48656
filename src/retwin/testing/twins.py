"""The contract of `Twin`: what every twin must do, as checks that can be run on any."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retwin.data.segments import Segments
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError
from retwin.testing.suite import (
    quiet_randomness,
    require,
    require_alike,
    require_refused,
    require_same,
    run_checks,
)
from retwin.twins.faults import Fault, Stuck, draw_faults, faulty_commands, frozen_response
from retwin.twins.limits import Limits
from retwin.twins.twin import Twin
from retwin.twins.workers import keep_workers

__all__ = ["TWIN_CHECKS", "TwinSubject", "check_twin"]


@dataclass(frozen=True, eq=False)
class TwinSubject:
    """A twin, and what it is to be tried on.

    Parameters
    ----------
    twin: the twin.
    commands: (n, T, d_u) that it can follow, at least two trajectories that move; a few short ones
        do.
    faults: one per trajectory, None for a healthy one, some of each; those that are there must
        change what the twin does. By default the first is healthy, and in each of the others one
        actuator sticks somewhere before its last movement.

    Raises
    ------
    InputError: commands or faults that the checks cannot work with.

    """

    twin: Twin
    commands: NDArray
    faults: Sequence[Fault | None] = ()

    def __post_init__(self) -> None:
        shape = np.shape(self.commands)
        if len(shape) != 3 or shape[0] < 2 or shape[1] < 8:
            raise InputError(
                "commands",
                expected="numbers of shape (n, T, d_u), n at least 2 and T at least 8",
                got=f"shape {shape}",
                remedy="give a few short trajectories that the twin can follow",
            )
        if not self.faults:
            stuck = [_stuck(each, turn) for turn, each in enumerate(self.commands[1:])]
            object.__setattr__(self, "faults", (None, *stuck))
        healthy = sum(fault is None for fault in self.faults)
        if len(self.faults) != shape[0] or healthy in (0, shape[0]):
            raise InputError(
                "faults",
                expected=f"{shape[0]}, one per trajectory, some None and some not",
                got=f"{len(self.faults)}, {healthy} of them None",
                remedy="give None for a healthy trajectory, or leave faults out",
            )

    def simulate(
        self,
        commands: NDArray | None = None,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int = 0,
    ) -> Trajectories:
        """What the twin says to those commands, by default the subject's."""
        commands = self.commands.copy() if commands is None else commands
        return self.twin.simulate(commands, faults=faults, seed=seed)

    def drawn(self, seed: int) -> list[Fault | None]:
        """The subject's faults with the severities that this seed gives."""
        return draw_faults(self.faults, Segments.from_commands(self.commands), seed)

    def moved(self, seed: int) -> NDArray:
        """(n,) bool: whether the fault changes what the actuators are told or do."""
        drawn = self.drawn(seed)
        told = faulty_commands(self.commands, drawn, Segments.from_commands(self.commands))
        return (frozen_response(told, drawn) != self.commands).any(axis=(1, 2))


def _stuck(commands: NDArray, turn: int) -> Stuck:
    """A fault that acts on (T, d_u): one actuator that moves, another each turn."""
    moving = np.diff(commands, axis=0) != 0
    actuators = np.flatnonzero(moving.any(axis=0))
    if len(actuators) == 0:
        return Stuck(0, onset=0)
    actuator = int(actuators[turn % len(actuators)])
    return Stuck(actuator, onset=(0, int(np.flatnonzero(moving[:, actuator])[-1])))


def check_protocol(subject: TwinSubject) -> None:
    """It has inputs, outputs, rate and simulate."""
    require(
        isinstance(subject.twin, Twin),
        "a twin must have inputs, outputs, rate and simulate, see retwin.Twin",
    )


def check_result(subject: TwinSubject) -> None:
    """The result has the twin's channels and rate, one finite output per command, the commands."""
    twin, made = subject.twin, subject.simulate()
    require(isinstance(made, Trajectories), f"simulate must return Trajectories, got {type(made)}")
    require(made.inputs == twin.inputs, f"inputs must be the twin's, got {made.inputs}")
    require(made.outputs == twin.outputs, f"outputs must be the twin's, got {made.outputs}")
    require(made.rate == twin.rate, f"rate must be the twin's, {twin.rate}, got {made.rate}")
    shape = (*subject.commands.shape[:2], len(twin.outputs))
    for name in ("nominal", "observed"):
        got = getattr(made, name).shape
        require(got == shape, f"{name} must have shape {shape}, got {got}")
    require(made.mask.all(), "a simulated output must not be missing: observed has NaN")
    told = subject.commands.astype(made.commands.dtype)
    require_same(made.commands, told, "commands must come back as they were given")


def check_labels(subject: TwinSubject) -> None:
    """Labels are the faults' own, and "Healthy" where there is none."""
    for faults in (None, [_renamed(fault) for fault in subject.faults]):
        made = subject.simulate(faults=faults)
        given = [None] * len(subject.commands) if faults is None else faults
        wanted = [HEALTHY if fault is None else fault.label for fault in given]
        got = made.labels.tolist()
        require(got == wanted, f"labels must be {wanted}, got {got}")


def _renamed(fault: Fault | None) -> Fault | None:
    """The fault with a label that is not its kind's, where it can have one."""
    try:
        return replace(fault, label="A name of its own")  # type: ignore[type-var]
    except TypeError:  # None, or a fault of the user's that is made in another way
        return fault


def check_seed(subject: TwinSubject) -> None:
    """The same seed gives the same bytes."""
    first, second = (subject.simulate(faults=subject.faults, seed=5) for _ in range(2))
    for name in ("nominal", "observed"):
        same = "the same seed must give the same bytes"
        require_same(getattr(second, name), getattr(first, name), f"{name}: {same}")


def check_severities(subject: TwinSubject) -> None:
    """Open severities are drawn first, from the seed alone: twins can be compared on them."""
    for seed in (1, 2):
        left_open = subject.simulate(faults=subject.faults, seed=seed)
        fixed = subject.simulate(faults=subject.drawn(seed), seed=seed)
        require_same(
            left_open.observed,
            fixed.observed,
            f"with seed {seed}, faults must get the severities that draw_faults gives; "
            "simulate_in_chunks sees to it",
        )


def check_nominal(subject: TwinSubject) -> None:
    """Nominal is the ideal output for the clean commands, whatever the faults and the seed."""
    ideal = subject.simulate(seed=1).nominal
    for name, faults, seed in (("faults", subject.faults, 1), ("the seed", None, 2)):
        got = subject.simulate(faults=faults, seed=seed).nominal
        require_same(got, ideal, f"nominal must not depend on {name}")


def check_faults_act(subject: TwinSubject) -> None:
    """A fault that moves an actuator changes the observed output, and no other trajectory's."""
    moved = subject.moved(3)
    require(moved.any(), "no fault of the subject changes its commands; give others")
    healthy = subject.simulate(seed=3).observed
    faulty = subject.simulate(faults=subject.faults, seed=3).observed
    for i, fault in enumerate(subject.faults):
        if fault is None:
            message = f"observed of healthy trajectory {i} must not depend on the others' faults"
            require_alike(faulty[i], healthy[i], message)
        elif moved[i]:
            changed = faulty[i].tobytes() != healthy[i].tobytes()
            require(changed, f"observed of trajectory {i} must change with the fault {fault}")


def check_batch(subject: TwinSubject) -> None:
    """What a trajectory gives does not depend on those beside it.

    Of a twin whose healthy output depends on the seed, this is asked of the nominal output only.
    """
    whole = subject.simulate(seed=1)
    names = ["nominal"]
    if subject.simulate(seed=2).observed.tobytes() == whole.observed.tobytes():
        names.append("observed")
    last = len(whole) - 1
    for how, index in (("alone", [last]), ("in another order", [*range(last, -1, -1)])):
        part = subject.simulate(subject.commands[index], seed=1)
        for name in names:
            got, wanted = getattr(part, name), getattr(whole, name)[index]
            require_alike(got, wanted, f"{name} must be the same for trajectories {how}")


def check_arguments_kept(subject: TwinSubject) -> None:
    """The caller's commands are neither changed nor kept; they may be read-only."""
    given = subject.commands.copy()
    made = subject.twin.simulate(given, faults=subject.faults, seed=0)
    require_same(given, subject.commands, "simulate must not change the caller's commands")
    for name in ("commands", "nominal", "observed"):
        shared = np.shares_memory(getattr(made, name), given)
        require(not shared, f"{name} of the result must not share memory with the argument")
    given.flags.writeable = False
    again = subject.twin.simulate(given, faults=subject.faults, seed=0)
    require_same(again.observed, made.observed, "read-only commands must give the same output")


def check_number_types(subject: TwinSubject) -> None:
    """Commands may be of 32 or 64 bits, whole numbers, and in any memory layout."""
    wanted = subject.simulate(subject.commands.astype(np.float64)).nominal
    short = np.asfortranarray(subject.commands.astype(np.float32))
    got = subject.simulate(short).nominal
    require_alike(got, wanted, "32-bit commands in Fortran order must do", tolerance=0.01)
    whole = _whole_numbers(subject)
    if whole is not None:
        got, wanted = (subject.simulate(whole.astype(t)).nominal for t in (int, float))
        require_alike(got, wanted, "whole numbers must do", tolerance=0.01)


def _whole_numbers(subject: TwinSubject) -> NDArray | None:
    """The commands rounded within the limits; None where no whole number lies within them."""
    low, high = _limits(subject)
    low, high = np.ceil(low), np.floor(high)
    return np.clip(np.round(subject.commands), low, high) if (low <= high).all() else None


def _limits(subject: TwinSubject) -> tuple[NDArray, NDArray]:
    limits: Limits | None = getattr(subject.twin, "limits", None)
    if limits is None:
        wide = np.full(len(subject.twin.inputs), np.inf)
        return -wide, wide
    return np.array(limits.low, dtype=float), np.array(limits.high, dtype=float)


def check_lengths(subject: TwinSubject) -> None:
    """Trajectories may have two samples, or many more than usual."""
    held = np.repeat(subject.commands[:, -1:], 3 * subject.commands.shape[1], axis=1)
    long = np.concatenate([subject.commands, held], axis=1)
    for commands in (subject.commands[:, :2], long):
        steps = subject.simulate(commands).steps
        wanted = commands.shape[1]
        require(steps == wanted, f"{wanted} samples of commands must give as many, got {steps}")


def check_too_short(subject: TwinSubject) -> None:
    """Commands without time, one sample or none, are refused."""
    for steps in (0, 1):
        commands = subject.commands[:, :steps]
        require_refused(lambda c=commands: subject.simulate(c), "commands", f"{steps} samples")  # type: ignore[misc]


def check_progress(subject: TwinSubject) -> None:
    """Progress is told as a share that never falls and ends at 1."""
    told: list[float] = []
    subject.twin.simulate(subject.commands.copy(), seed=0, progress=told.append)
    require(told and told[-1] == 1.0, f"progress must end at 1.0, got {told[-3:]}")
    require(min(told) >= 0 and told == sorted(told), f"progress must rise from 0 to 1, got {told}")


def check_bad_commands(subject: TwinSubject) -> None:
    """Commands that cannot be meant are refused in one line that names them."""
    good = subject.commands
    holed, endless = (good.astype(float) for _ in range(2))
    holed[0, 1, 0], endless[0, 1, 0] = np.nan, np.inf
    bad = {
        "a channel too many": np.concatenate([good, good[..., :1]], axis=2),
        "a channel too few": good[..., 1:],
        "one trajectory without its axis": good[0],
        "an axis too many": good[None],
        "no trajectory": good[:0],
        "NaN": holed,
        "an infinite command": endless,
        "text": good.astype(str),
    }
    for what, commands in bad.items():
        require_refused(lambda c=commands: subject.simulate(c), "commands", what)  # type: ignore[misc]


def check_bad_faults(subject: TwinSubject) -> None:
    """There is one fault per trajectory, of an actuator that exists."""
    rest: list[Fault | None] = [None] * (len(subject.commands) - 1)
    width = subject.commands.shape[2]
    bad: dict[str, list[Fault | None]] = {
        "a fault too few": rest,
        "a fault too many": [None, None, *rest],
        "an actuator that is not there": [Stuck(width, onset=1), *rest],
        "an actuator below 0": [Stuck(-1, onset=1), *rest],
    }
    for what, faults in bad.items():
        require_refused(lambda f=faults: subject.simulate(faults=f), "faults", what)  # type: ignore[misc]


def check_bad_seed(subject: TwinSubject) -> None:
    """A seed is a whole number of at least 0."""
    for seed in (-1, 0.5, None):
        what = f"seed {seed}"
        require_refused(lambda s=seed: subject.simulate(seed=s), "seed", what)  # type: ignore[misc]


def check_limits(subject: TwinSubject) -> None:
    """Commands beyond the twin's limits are refused, or clipped if it says so."""
    limits: Limits | None = getattr(subject.twin, "limits", None)
    for side, bounds in zip((-1.0, 1.0), _limits(subject), strict=True):
        for channel in np.flatnonzero(np.isfinite(bounds)):
            beyond = subject.commands.astype(float)
            beyond[0, -1, channel] = bounds[channel] + side * (1.0 + abs(bounds[channel]))
            name = subject.twin.inputs.names[channel]
            if limits is not None and limits.outside == "clip":
                got = float(subject.simulate(beyond).commands[0, -1, channel])
                kept = np.isclose(got, bounds[channel], rtol=1e-6)
                require(kept, f"{name} must be clipped to {bounds[channel]:g}, got {got:g}")
            else:
                what = f"{name} beyond {bounds[channel]:g}"
                require_refused(lambda b=beyond: subject.simulate(b), "commands", what)  # type: ignore[misc]


def check_global_randomness(subject: TwinSubject) -> None:
    """Nothing is drawn from, or done to, a generator that others share."""
    with quiet_randomness():
        subject.simulate(faults=subject.faults)


def check_pickle(subject: TwinSubject) -> None:
    """It can be sent to another process, and says the same there: studies do so."""
    try:
        copy: Twin = pickle.loads(pickle.dumps(subject.twin))
    except Exception as error:
        raise AssertionError(
            f"must be picklable: {error}; define its functions and classes in a module"
        ) from error
    wanted = subject.simulate(faults=subject.faults, seed=4).observed
    got = copy.simulate(subject.commands.copy(), faults=subject.faults, seed=4).observed
    require_same(got, wanted, "a copy from pickle must say the same")


TWIN_CHECKS: tuple[Callable[[TwinSubject], None], ...] = (
    check_protocol,
    check_result,
    check_labels,
    check_seed,
    check_severities,
    check_nominal,
    check_faults_act,
    check_batch,
    check_arguments_kept,
    check_number_types,
    check_lengths,
    check_too_short,
    check_progress,
    check_bad_commands,
    check_bad_faults,
    check_bad_seed,
    check_limits,
    check_global_randomness,
    check_pickle,
)


def check_twin(twin: Twin, commands: NDArray, faults: Sequence[Fault | None] = ()) -> None:
    """Run all `TWIN_CHECKS`, see `TwinSubject` for the arguments.

    Raises
    ------
    AssertionError: one that lists everything the twin breaks.

    """
    with keep_workers():
        run_checks(TWIN_CHECKS, TwinSubject(twin, commands, faults), type(twin).__name__)
