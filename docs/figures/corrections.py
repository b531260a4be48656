"""The pictures of docs/corrections.md: what each operator can express, and what it cannot.

    python docs/figures/corrections.py

Everything comes from the emulated robot, or from a toy where the picture says so; no real
measurements are needed. Takes some minutes and writes docs/images/corrections-*.png.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray
from scipy import signal
from style import BLUE, GREEN, INK, MUTED, ORANGE, PINK, RULE, blank, dress, note, save, title
from torch import Tensor

import retwin as rt
from retwin.cases.armpi_fpv.twin import ARM, KINEMATIC, UNIT
from retwin.nets.training import Training

EMULATED, TOY = "Emulated robot, no real measurements", "A toy, no real measurements"
COLOURS = {"CommandSpace": BLUE, "DelayOffset": ORANGE, "Additive": GREEN}
STYLES = {"CommandSpace": "-", "DelayOffset": "--", "Additive": ":"}
MM, RATE = 1000.0, KINEMATIC.rate
POLL = round(0.1 * RATE)
"""Samples between two polls of the sensor."""
COUNT, DRAWS = 40, 150
RADIUS_90 = 2.146
"""Radius, in standard deviations, of the ellipse that contains 90 % of a bivariate normal."""


@dataclass(frozen=True, eq=False)
class Robot:
    """The emulated robot, a surrogate of its twin, and healthy trajectories with hidden states."""

    case: rt.Case
    surrogate: rt.Surrogate
    operators: dict[str, rt.Correction]
    made: rt.Trajectories
    hidden: dict[str, NDArray]
    segments: rt.Segments

    @classmethod
    def emulated(cls) -> Robot:
        """The robot of all figures, from fixed seeds."""
        case = rt.cases.armpi()
        twin = rt.generate(case.twin, case, per_class=40, seed=1)
        surrogate = rt.fit_surrogate(
            twin, seed=0, training=Training(max_epochs=12, batch_size=256, learning_rate=5e-3)
        )
        commands = case.sampler.sample(COUNT, rng=np.random.default_rng(4))
        hidden: dict[str, NDArray] = {}
        made = case.emulator.simulate(commands, seed=5, hidden=hidden)
        operators = {"DelayOffset": rt.DelayOffset(), "CommandSpace": case.correction}
        segments = rt.Segments.from_commands(commands)
        return cls(case, surrogate, operators, made, hidden, segments)

    @property
    def errors(self) -> NDArray:
        """The steady-state error of every actuator, (n, M, 4) in degrees."""
        each = np.arange(COUNT)[:, None]
        last = np.ceil(self.segments.stop).astype(int) - 1
        settled = np.ceil(self.segments.settle).astype(int).clip(max=self.made.steps - 1)
        return UNIT * (self.hidden["angles"][each, last] - self.made.commands[each, settled])


def main() -> None:
    """Draw all figures."""
    robot = Robot.emulated()
    found = {
        name: rt.infer_discrepancy(robot.surrogate, robot.made, operator)
        for name, operator in robot.operators.items()
    }
    paths = {name: best_fit(robot.operators[name], *each) for name, each in found.items()}
    predicted = found["DelayOffset"][0].path.numpy()
    healthy = found["CommandSpace"][1]
    save("corrections-movements", movements(robot, predicted, paths), EMULATED)
    save("corrections-unidentified", unidentified(robot, healthy), EMULATED)
    save("corrections-generated", generated(robot), EMULATED)
    save("corrections-severity", severity(robot, healthy), EMULATED)
    save("corrections-polled", polled(robot, paths["CommandSpace"]), EMULATED)
    save("corrections-additive", additive(), TOY)


@torch.no_grad()
def best_fit(operator: rt.Correction, context: rt.Context, found: rt.Discrepancy) -> NDArray:
    """The best fit of an operator, (n, T, d_y)."""
    return operator.apply(context, found.z.to(context.path.dtype)).numpy()


def movements(robot: Robot, predicted: NDArray, paths: Mapping[str, NDArray]) -> Figure:
    """A segment with a delay and an offset, and one that an actuator missed, by both operators."""
    figure = blank(7.2, 5.4)
    grid = figure.subplots(2, 2, sharey="row", sharex="row")
    names = ("delay and offset", "missed by one motor")
    for row, (what, (i, m)) in enumerate(zip(names, examples(robot, predicted), strict=True)):
        start = robot.segments.start[i]
        last = m + 1 + row
        end = int(start[last]) - 5 if last < len(start) else robot.made.steps
        window = np.arange(int(start[m]) - 15, end)
        time, read = (window - start[m]) / RATE, window % POLL == 0
        observed = robot.made.observed[i, window]
        output = int(np.ptp(observed - predicted[i, window], axis=0).argmax())
        for axes, (name, path) in zip(grid[row], paths.items(), strict=True):
            twin, measured, best = (
                MM * each[:, output] for each in (predicted[i, window], observed, path[i, window])
            )
            axes.plot(time, twin, "--", color=MUTED, label="twin")
            axes.plot(
                time[read], measured[read], "o", color=INK, markersize=3.2, label="sensor samples"
            )
            best_name = f"best fit of {name}"
            axes.plot(time, best, color=COLOURS[name], linewidth=2.4, label=best_name, zorder=1.9)
            title(axes, f"{name}: {what}")
            dress(axes, "time since the command, s", f"{'xyz'[output]}, mm")
            residual = np.linalg.norm(observed - path[i, window], axis=-1)[read]
            rms = MM * np.sqrt(np.square(residual).mean())
            note(axes, f"residual: {rms:.1f} mm RMS", low=True, left=True)
            axes.margins(y=0.2)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    other = grid[0, 1].get_legend_handles_labels()
    figure.legend(
        handles + other[0][2:],
        labels + other[1][2:],
        frameon=False,
        fontsize=9,
        ncols=4,
        columnspacing=1.2,
        loc="outside lower center",
    )
    return figure


def examples(robot: Robot, predicted: NDArray) -> tuple[tuple[int, int], tuple[int, int]]:
    """Trajectory and segment: one with a large error, and the missed one with the largest error."""
    missed = robot.hidden["missed"]
    each = np.arange(COUNT)[:, None]
    settled = np.ceil(robot.segments.settle).astype(int).clip(max=robot.made.steps - 30) + 25
    error = np.linalg.norm(robot.made.observed - predicted, axis=-1)[each, settled]
    inner = np.zeros(error.shape, dtype=bool)
    inner[:, 1:-2] = True
    regular = inner & ~(missed.any(axis=-1).cumsum(axis=1) > 0)
    order = np.argsort(np.where(regular, error, np.inf), axis=None)[: regular.sum()]
    large = np.unravel_index(order[int(0.9 * len(order))], error.shape)
    worst = np.unravel_index(
        np.where(inner & (missed.sum(axis=-1) == 1), error, 0).argmax(), error.shape
    )
    return (int(large[0]), int(large[1])), (int(worst[0]), int(worst[1]))


def unidentified(robot: Robot, found: rt.Discrepancy) -> Figure:
    """Which offsets of four joints three outputs identify: ellipses of prior and posterior."""
    z, covariance = found.z.numpy(), found.covariance.numpy()
    seen = ~robot.hidden["missed"].any(axis=-1) & ~(z[..., 5:] > 0.5).any(axis=-1)
    # The segment with the median correlation of the offsets of motors 3 and 4.
    inner = covariance[..., 1:5, 1:5]
    spread = np.sqrt(np.diagonal(inner, axis1=-2, axis2=-1))
    correlation = np.abs(inner[..., 2, 3] / spread[..., 2] / spread[..., 3])
    order = np.argsort(np.where(seen, correlation, np.inf), axis=None)[: seen.sum()]
    i, m = np.unravel_index(order[len(order) // 2], correlation.shape)
    before = np.diag((np.square(z[..., 1:5]) + np.square(spread))[seen].mean(axis=0))
    figure = blank(7.2, 3.7)
    pairs = {"1 and 2: both identified": (0, 1), "3 and 4: only their sum": (3, 2)}
    for axes, (what, (a, b)) in zip(figure.subplots(1, 2), pairs.items(), strict=True):
        pair = np.ix_((a, b), (a, b))
        ellipse(axes, (0, 0), before[pair], color=MUTED, name="prior: 90 % of all segments")
        centre = UNIT * z[i, m, 1:5][[a, b]]
        name = "posterior: 90 %, from three outputs"
        ellipse(axes, centre, inner[i, m][pair], color=COLOURS["CommandSpace"], name=name)
        axes.plot(
            *robot.errors[i, m][[a, b]],
            "x",
            color=INK,
            markersize=8,
            markeredgewidth=2,
            label="true offsets",
        )
        axes.set_aspect("equal")
        axes.set_xlim(-3.1, 3.1)
        axes.set_ylim(-3.1, 3.1)
        dress(axes, f"offset of motor {a + 1}, degrees", f"offset of motor {b + 1}, degrees")
        title(axes, f"Motors {what}")
    marks = axes.get_legend_handles_labels()
    figure.legend(*marks, frameon=False, fontsize=9, ncols=3, loc="outside lower center")
    return figure


def ellipse(
    axes: Axes, centre: tuple[float, float] | NDArray, covariance: NDArray, *, color: str, name: str
) -> None:
    """The ellipse that contains 90 % of samples; the covariance is in command units."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2 * RADIUS_90 * UNIT * np.sqrt(values)
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    for alpha, edge in ((0.15, 0.0), (1.0, 2.0)):
        axes.add_patch(
            Ellipse(
                (float(centre[0]), float(centre[1])),
                width,
                height,
                angle=angle,
                facecolor=color if edge == 0 else "none",
                edgecolor=color,
                linewidth=edge,
                alpha=alpha,
                label=name if edge else None,
            )
        )


def generated(robot: Robot) -> Figure:
    """Samples of the corrected twin: a stuck motor, and the workspace of the arm."""
    figure = blank(7.2, 5.4)
    grid = figure.subplots(2, 2, sharex="row", sharey="row")
    operators = {"DelayOffset": rt.DelayOffset(), "CommandSpace": rt.CommandSpace()}
    commands = robot.case.sampler.sample(DRAWS, rng=np.random.default_rng(8))
    stuck = robot.case.faults["Motor_1_Stuck"]
    for column, (name, operator) in zip(grid.T, operators.items(), strict=True):
        rg = rt.fit_residual(robot.surrogate, robot.made[:20], operator, seed=0)
        updated = rt.CorrectedTwin(robot.surrogate, rg)
        held = updated.simulate(commands[:12], faults=[stuck] * 12, seed=3)
        still = out_of_plane(held.observed[:, 60:].astype(float))
        column[0].plot(
            np.arange(60, held.steps) / RATE, MM * still.T, color=COLOURS[name], linewidth=0.8
        )
        column[0].margins(y=0.15)
        title(column[0], f"{name}: motor 1 is stuck")
        dress(column[0], "time, s", "distance of the tip from the\nplane of the stuck arm, mm")
        note(column[0], f"{MM * np.sqrt(np.square(still).mean()):.1f} mm RMS in 12 samples")
        free = updated.simulate(commands, seed=4)
        tips = MM * free.observed[:, 180::200].reshape(-1, 3)
        across, up = np.hypot(tips[:, 0], tips[:, 1]), tips[:, 2] - MM * ARM.base
        beyond = np.hypot(across, up) - MM * sum(ARM.links)
        workspace(column[1], across, up, out=beyond > 2.0, color=COLOURS[name])
        title(column[1], f"{name}: tip at rest")
        note(column[1], f"{np.mean(beyond > 2.0):.1%} outside the workspace", low=True, left=True)
    return figure


def out_of_plane(path: NDArray) -> NDArray:
    """Distance (n, T) in m of the tip from the upright plane through the base that fits best."""
    flat = path[..., :2]
    _, vectors = np.linalg.eigh(np.einsum("nta,ntb->nab", flat, flat))
    return np.einsum("nta,na->nt", flat, vectors[:, :, 0])


def workspace(axes: Axes, across: NDArray, up: NDArray, *, out: NDArray, color: str) -> None:
    """Tips at rest in the vertical plane, and the circle that limits the workspace."""
    angle = np.linspace(0, np.pi / 2, 100)
    length = MM * sum(ARM.links)
    axes.plot(length * np.sin(angle), length * np.cos(angle), color=INK, linewidth=1.2)
    axes.annotate(
        "workspace limit",
        (length * 0.62, length * 0.785),
        (165, 245),
        color=INK,
        fontsize=9,
        arrowprops={"arrowstyle": "-", "color": MUTED},
    )
    axes.plot(across[~out], up[~out], "o", color=color, markersize=2.6, alpha=0.5)
    axes.plot(across[out], up[out], "D", color=INK, markersize=4.2, markerfacecolor=color)
    axes.set_xlim(0, 265)
    axes.set_ylim(110, 265)
    axes.set_aspect("equal")
    dress(axes, "distance from the axis, mm", "height above\nthe shoulder, mm")


def severity(robot: Robot, healthy: rt.Discrepancy) -> Figure:
    """The severity of a labelled bias, and the offsets that remain for the RG."""
    rng = np.random.default_rng(21)
    motors = np.repeat(np.arange(4), 8)
    shape = (len(motors), robot.segments.max_count)
    bias = rng.uniform(10, 50, size=shape) * rng.choice([-1, 1], size=shape)
    commands = robot.case.sampler.sample(len(motors), rng=rng)
    faults = [rt.ActuatorBias(j, bias=tuple(b)) for j, b in zip(motors, bias, strict=True)]
    made = robot.case.emulator.simulate(commands, faults=faults, seed=6)
    operator = robot.operators["CommandSpace"]
    # The label names the motor but not its bias: one unit stands for any bias.
    labels = [rt.ActuatorBias(j, bias=(1.0,) * shape[1]) for j in motors]
    _, labelled = rt.infer_discrepancy(robot.surrogate, made, operator, faults=labels)
    _, unlabelled = rt.infer_discrepancy(robot.surrogate, made, operator)
    own = np.broadcast_to(np.eye(4, dtype=bool)[motors][:, None], (*shape, 4))
    figure = blank(7.2, 3.7)
    left, right = figure.subplots(1, 2)
    assert labelled.severity is not None
    found = UNIT * (1.0 + labelled.severity.numpy()[own])
    true = UNIT * bias.ravel()
    left.plot([-13, 13], [-13, 13], color=RULE, linewidth=1)
    left.plot(true, found, "o", color=COLOURS["CommandSpace"], markersize=3.5, alpha=0.7)
    dress(left, "true bias, degrees", "estimated bias, degrees")
    title(left, "Severity of the fault")
    note(left, f"mean error {np.abs(found - true).mean():.2f}°", low=True)
    edges = np.linspace(-12, 12, 49)
    for name, discrepancy, kept, style in (
        ("healthy", healthy, None, {"color": INK, "linestyle": "-"}),
        (
            "biased, labelled",
            labelled,
            ~own,
            {"color": COLOURS["CommandSpace"], "linestyle": "--"},
        ),
        (
            "biased, no label",
            unlabelled,
            None,
            {"color": COLOURS["DelayOffset"], "linestyle": "-."},
        ),
    ):
        offsets = UNIT * discrepancy.z[..., 1:5].numpy()
        offsets = offsets[kept] if kept is not None else offsets.ravel()
        share, _ = np.histogram(offsets, edges)
        right.stairs(share / len(offsets), edges, label=name, linewidth=1.8, **style)
    right.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    right.legend(frameon=False, fontsize=9, loc="upper left", handlelength=1.4, borderaxespad=0.2)
    dress(right, "offset attributed to discrepancy, degrees", "share of offsets")
    title(right, "Offsets for the residual model")
    return figure


def polled(robot: Robot, path: NDArray) -> Figure:
    """Records of the sensor in motion and at rest; `path` is the best fit to what was measured."""
    observed, mask = torch.tensor(robot.made.observed), torch.tensor(robot.made.mask)
    predicted = torch.tensor(path)
    sensor = rt.SampledSensor().fitted(observed, mask, predicted, robot.segments, RATE)
    drawn = sensor.read(predicted, torch.Generator().manual_seed(2), RATE).numpy()
    true = KINEMATIC.position(robot.hidden["angles"])
    figure = blank(7.2, 3.7)
    left, right = figure.subplots(1, 2)
    i, m, output = 3, 1, 0
    begin = int(robot.segments.start[i, m])
    window = np.arange(begin - 20, begin + 60)
    time, read = (window - begin) / RATE, list(np.flatnonzero(window % POLL == 0))
    left.plot(time, MM * true[i, window, output], color=RULE, linewidth=5, label="true position")
    seen = MM * robot.made.observed[i, window, output]
    left.plot(time, seen, "o-", color=INK, label="record", markevery=read, markersize=4)
    left.legend(frameon=False, fontsize=9)
    dress(left, "time since the command, s", "x, mm")
    title(left, "In motion: interpolated samples")
    window = np.arange(begin + 110, begin + 195)
    time, read = (window - begin) / RATE, list(np.flatnonzero(window % POLL == 0))
    for name, paths, style in (
        ("measured", robot.made.observed, {"color": INK, "marker": "o"}),
        ("CommandSpace alone", path, {"color": COLOURS["CommandSpace"], "linestyle": "--"}),
        ("with SampledSensor, a sample", drawn, {"color": PINK, "marker": "s"}),
    ):
        values = MM * (paths[i, window, output] - np.median(paths[i, window, output]))
        right.plot(time, values, label=name, markevery=read, markersize=4, **style)
    right.legend(frameon=False, fontsize=9)
    dress(right, "time since the command, s", "x about its median, mm")
    title(right, "At rest: measurement errors")
    return figure


class Identity:
    """A toy twin: its output follows the command at once."""

    memoryless = True

    def __call__(self, commands: Tensor) -> Tensor:
        """Outputs for commands."""
        return commands

    def predict(self, commands: NDArray) -> NDArray:
        """The same for arrays."""
        return commands


def additive() -> Figure:
    """An oscillating system and a twin that does not oscillate, by three operators."""
    ramp = np.array([1.0, -0.6, 0.8])[:, None] * np.clip((np.arange(500) - 50) / 60, 0, 1)
    time = np.arange(500) / RATE
    oscillator = signal.TransferFunction([80.0], [1.0, 2.5, 80.0])
    noise = np.random.default_rng(0).normal(0, 0.003, (3, 500))
    true = np.stack([signal.lsim(oscillator, each, time)[1] for each in ramp]) + noise
    commands = ramp[..., None].astype(np.float32)
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Identity(), commands, segments, rate=RATE)
    observed = torch.tensor(true[..., None], dtype=torch.float32)
    figure = blank(7.2, 3.7)
    left, right = figure.subplots(1, 2)
    left.plot(time, ramp[0], "--", color=MUTED, label="twin")
    left.plot(time, true[0], color=INK, linewidth=3.5, alpha=0.35, label="measured")
    for name, operator in (
        ("CommandSpace", rt.CommandSpace()),
        ("DelayOffset", rt.DelayOffset()),
        ("Additive", rt.Additive()),
    ):
        z = operator.infer(context, observed, torch.ones_like(observed, dtype=torch.bool)).z
        predicted = operator.apply(context, z.float())[0, :, 0].numpy()
        style = {"color": COLOURS[name], "linestyle": STYLES[name], "linewidth": 1.6}
        left.plot(time, predicted, label=f"best fit of {name}", **style)
        right.plot(time, true[0] - predicted, **style)
    for axes in (left, right):
        axes.set_xlim(0.2, 4.2)
    left.legend(frameon=False, fontsize=9, loc="lower right")
    dress(left, "time, s", "output")
    dress(right, "time, s", "measured minus best fit")
    title(left, "An oscillating system and its twin")
    title(right, "Residual")
    return figure


if __name__ == "__main__":
    main()
