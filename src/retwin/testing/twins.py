"""The contract of `Twin`, as checks that can be run on any implementation."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.testing.suite import (
    checks_in,
    quiet_randomness,
    require,
    require_alike,
    require_refused,
    require_same,
    run_checks,
)
from retwin.testing.twin_subject import TwinSubject
from retwin.twins.faults.actuator_faults import Fault, Stuck
from retwin.twins.limits import Limits
from retwin.twins.twin import Twin
from retwin.twins.workers import keep_workers


def check_protocol(subject: TwinSubject) -> None:
    """It has inputs, outputs, rate and simulate."""
    require(
        isinstance(subject.twin, Twin),
        "a twin must have inputs, outputs, rate and simulate, see retwin.Twin",
    )


def check_result(subject: TwinSubject) -> None:
    """The result has the twin's channels and rate, the commands, and finite outputs for them."""
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
    given = subject.commands.astype(made.commands.dtype)
    require_same(made.commands, given, "commands must come back as they were given")


def check_labels(subject: TwinSubject) -> None:
    """Labels are those of the faults, and "Healthy" where there is none."""
    for faults in (None, [_renamed(fault) for fault in subject.faults]):
        made = subject.simulate(faults=faults)
        given = [None] * len(subject.commands) if faults is None else faults
        wanted = [HEALTHY if fault is None else fault.label for fault in given]
        got = made.labels.tolist()
        require(got == wanted, f"labels must be {wanted}, got {got}")


def _renamed(fault: Fault | None) -> Fault | None:
    """The fault with a label that is not the default of its class, where it can have one."""
    try:
        return replace(fault, label="A name of its own")  # type: ignore[type-var]
    except TypeError:  # None, or a user's fault that is no dataclass with a label
        return fault


def check_seed(subject: TwinSubject) -> None:
    """The same seed gives the same bytes."""
    first, second = (subject.simulate(faults=subject.faults, seed=5) for _ in range(2))
    for name in ("nominal", "observed"):
        same = "the same seed must give the same bytes"
        require_same(getattr(second, name), getattr(first, name), f"{name}: {same}")


def check_severities(subject: TwinSubject) -> None:
    """Open severities depend on the seed alone, so that twins can be compared."""
    for seed in (1, 2):
        left_open = subject.simulate(faults=subject.faults, seed=seed)
        fixed = subject.simulate(faults=subject.drawn(seed), seed=seed)
        require_same(
            left_open.observed,
            fixed.observed,
            f"with seed {seed}, faults must get the severities of draw_faults, as they do in "
            "simulate_in_chunks",
        )


def check_nominal(subject: TwinSubject) -> None:
    """Nominal is the ideal output for the clean commands, whatever the faults and the seed."""
    ideal = subject.simulate(seed=1).nominal
    for name, faults, seed in (("faults", subject.faults, 1), ("the seed", None, 2)):
        got = subject.simulate(faults=faults, seed=seed).nominal
        require_same(got, ideal, f"nominal must not depend on {name}")


def check_faults_act(subject: TwinSubject) -> None:
    """A fault that affects an actuator changes the observed output of its trajectory alone."""
    affected = subject.affected(3)
    require(affected.any(), "no fault of the subject changes its commands; give others")
    healthy = subject.simulate(seed=3).observed
    faulty = subject.simulate(faults=subject.faults, seed=3).observed
    for i, fault in enumerate(subject.faults):
        if fault is None:
            message = f"observed of healthy trajectory {i} must not depend on the others' faults"
            require_alike(faulty[i], healthy[i], message)
        elif affected[i]:
            changed = faulty[i].tobytes() != healthy[i].tobytes()
            require(changed, f"observed of trajectory {i} must change with the fault {fault}")


def check_batch(subject: TwinSubject) -> None:
    """The outputs of a trajectory do not depend on the other trajectories.

    Where the healthy output depends on the seed, only the nominal output is compared.
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
    """The twin's limits (d_u,), infinite where it has none."""
    limits: Limits | None = getattr(subject.twin, "limits", None)
    if limits is None:
        wide = np.full(len(subject.twin.inputs), np.inf)
        return -wide, wide
    return np.array(limits.low, dtype=float), np.array(limits.high, dtype=float)


def check_lengths(subject: TwinSubject) -> None:
    """Trajectories may have two samples, or many more than the subject's."""
    held = np.repeat(subject.commands[:, -1:], 3 * subject.commands.shape[1], axis=1)
    long = np.concatenate([subject.commands, held], axis=1)
    for commands in (subject.commands[:, :2], long):
        steps = subject.simulate(commands).steps
        wanted = commands.shape[1]
        require(steps == wanted, f"{wanted} samples of commands must give as many, got {steps}")


def check_too_short(subject: TwinSubject) -> None:
    """Commands of one sample or none are refused."""
    for steps in (0, 1):
        commands = subject.commands[:, :steps]
        require_refused(lambda c=commands: subject.simulate(c), "commands", f"{steps} samples")  # type: ignore[misc]


def check_progress(subject: TwinSubject) -> None:
    """Progress is reported as a fraction that never decreases and ends at 1."""
    reported: list[float] = []
    subject.twin.simulate(subject.commands.copy(), seed=0, progress=reported.append)
    require(reported and reported[-1] == 1.0, f"progress must end at 1.0, got {reported[-3:]}")
    rising = min(reported) >= 0 and reported == sorted(reported)
    require(rising, f"progress must rise from 0 to 1, got {reported}")


def check_bad_commands(subject: TwinSubject) -> None:
    """Commands of another shape or with values that are not finite are refused."""
    good = subject.commands
    with_nan, with_inf = (good.astype(float) for _ in range(2))
    with_nan[0, 1, 0], with_inf[0, 1, 0] = np.nan, np.inf
    bad = {
        "a channel too many": np.concatenate([good, good[..., :1]], axis=2),
        "a channel too few": good[..., 1:],
        "one trajectory without its axis": good[0],
        "an axis too many": good[None],
        "no trajectory": good[:0],
        "NaN": with_nan,
        "an infinite command": with_inf,
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
        "an actuator that is not there": [Stuck(width, onset=0.0), *rest],
        "an actuator below 0": [Stuck(-1, onset=0.0), *rest],
    }
    for what, faults in bad.items():
        require_refused(lambda f=faults: subject.simulate(faults=f), "faults", what)  # type: ignore[misc]


def check_bad_seed(subject: TwinSubject) -> None:
    """A seed is a whole number of at least 0."""
    for seed in (-1, 0.5, None):
        what = f"seed {seed}"
        require_refused(lambda s=seed: subject.simulate(seed=s), "seed", what)  # type: ignore[misc]


def check_limits(subject: TwinSubject) -> None:
    """Commands beyond the twin's limits are refused, or clipped where `outside` is "clip"."""
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
    """The global random generators are neither used nor seeded."""
    with quiet_randomness():
        subject.simulate(faults=subject.faults)


def check_pickle(subject: TwinSubject) -> None:
    """It can be sent to another process, as in studies, and simulates the same there."""
    try:
        copy: Twin = pickle.loads(pickle.dumps(subject.twin))
    except Exception as error:
        raise AssertionError(
            f"must be picklable: {error}; define its functions and classes in a module"
        ) from error
    wanted = subject.simulate(faults=subject.faults, seed=4).observed
    got = copy.simulate(subject.commands.copy(), faults=subject.faults, seed=4).observed
    require_same(got, wanted, "a copy from pickle must simulate the same")


TWIN_CHECKS: tuple[Callable[[TwinSubject], None], ...] = checks_in(globals())


def check_twin(twin: Twin, commands: NDArray, faults: Sequence[Fault | None] = ()) -> None:
    """Run all `TWIN_CHECKS` on a twin, whose worker processes are kept for all of them.

    Parameters
    ----------
    twin, commands, faults
        See `TwinSubject`.

    Raises
    ------
    AssertionError
        It lists all checks that fail.

    """
    with keep_workers():
        run_checks(TWIN_CHECKS, TwinSubject(twin, commands, faults), type(twin).__name__)
