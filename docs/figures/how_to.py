"""Pictures of the how-to pages: faults, updated parameters, and diagnoses by physics.

    python docs/figures/how_to.py

Takes two minutes, and writes docs/images/faults.png, updating.png and inversion.png. All systems
are emulated.
"""

from __future__ import annotations

import numpy as np
from style import BLUE, GREEN, INK, MUTED, ORANGE, blank, dress, save, title
from tutorial import run

import retwin as rt
from retwin import twins
from retwin.update import LeastSquares

VOLTS, SPEED = rt.Channels(("voltage",), ("V",)), rt.Channels(("speed",), ("rad/s",))
RATE, DURATION = 50.0, 6.0  # Hz, s
TRUE = {"gain": 1.7, "time constant": 0.35}
"""Parameters of the emulated motor; its twin has 2.0 and 0.2."""
NOISE = 0.04  # rad/s


def main() -> None:
    """Draw all of them."""
    faults()
    updating()
    inversion()


def motor(gain: float = 2.0, constant: float = 0.2) -> twins.StateTwin:
    """A motor that lags behind its voltage."""
    return twins.StateTwin(
        [twins.State("speed", "rad/s")],
        lambda x, u: x.speed,
        VOLTS,
        SPEED,
        RATE,
        derivative=lambda x, u, p: ((p[0] * u.voltage - x.speed) / p[1],),
        parameters=(
            twins.Parameter("gain", "rad/(s V)", 1.0, 3.0, gain),
            twins.Parameter("time constant", "s", 0.05, 1.0, constant),
        ),
    )


def commands(count: int, seed: int) -> np.ndarray:
    """Steps of half a second to a second and a half."""
    sampler = twins.HoldSampler((-1.0,), (1.0,), RATE, DURATION, hold_durations=(0.5, 1.5))
    return sampler.sample(count, rng=np.random.default_rng(seed))


def faults() -> None:
    """The same commands, healthy and with six faults."""
    shown = (
        ("actuator stuck from 2 s", twins.Stuck(0, onset=2.0)),
        ("actuator at 60 %", twins.ActuatorGain(0, size=(-0.4, -0.4))),
        ("sensor bias", twins.SensorBias(0, size=(0.4, 0.4))),
        ("sensor drift from 2 s", twins.SensorDrift(0, onset=2.0, size=(0.2, 0.2))),
        ("sensor frozen from 2 s", twins.SensorFreeze(0, onset=2.0)),
        ("time constant doubled", twins.ParameterShift("time constant", size=(0.2, 0.2))),
    )
    given = commands(1, 4).repeat(len(shown), axis=0)
    made = motor().simulate(given, faults=[fault for _, fault in shown], seed=0)
    time = np.arange(made.observed.shape[1]) / RATE
    figure = blank(7.6, 4.2)
    panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    for place, (axes, (name, _)) in enumerate(zip(panels, shown, strict=True)):
        axes.plot(time, made.nominal[place, :, 0], color=MUTED, linewidth=1.2, label="nominal")
        axes.plot(time, made.observed[place, :, 0], color=ORANGE, linewidth=1.6, label="faulty")
        title(axes, name)
        dress(axes, "time, s" if place > 2 else "", "speed, rad/s" if place % 3 == 0 else "")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    save("faults", figure, "A simulated motor")


def updating() -> None:
    """A held-out record before and after its twin's parameters are identified."""
    rng = np.random.default_rng(0)
    made = motor(*TRUE.values()).simulate(commands(6, 1), seed=0)
    measured = made.replace(
        observed=made.observed + rng.normal(scale=NOISE, size=made.observed.shape)
    )
    original = motor()
    free = twins.ParametricTwin(original, original.parameters)
    updated = rt.identify(free, measured[:5], LeastSquares(), seed=0)
    held_out = measured[5:]
    time = np.arange(held_out.observed.shape[1]) / RATE
    figure = blank(7.6, 3.0)
    left, right = figure.subplots(1, 2, width_ratios=(2.2, 1))
    left.plot(
        time, held_out.observed[0, :, 0], color=INK, linewidth=0.9, label="measured, held out"
    )
    for name, twin, colour in (
        ("original twin", original, MUTED),
        ("updated twin", updated.twin, BLUE),
    ):
        simulated = twin.simulate(held_out.commands, seed=0).observed[0, :, 0]
        left.plot(time, simulated, color=colour, linewidth=1.6, label=name)
    dress(left, "time, s", "speed, rad/s")
    figure.legend(
        *left.get_legend_handles_labels(),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=9,
    )
    start = {each.name: each.start for each in original.parameters}
    for place, (name, true) in enumerate(TRUE.items()):
        right.plot(start[name] / true, place, "o", color=MUTED)
        right.plot(updated.values[name] / true, place, "o", color=BLUE)
    right.axvline(1, color=GREEN, linewidth=1.2)
    right.set_yticks(range(len(TRUE)), list(TRUE), fontsize=9)
    right.set_ylim(-0.6, 1.6)
    dress(right, "value / true value", "")
    save("updating", figure, "An emulated motor")


def inversion() -> None:
    """Probabilities of the classes for test trajectories of the tutorial."""
    names = run("fit_inversion")
    some = names["test"][::4]
    classes = names["inversion"].classes
    probabilities = names["inversion"].predict_proba(some)
    order = np.argsort([classes.index(label) for label in some.labels], kind="stable")
    figure = blank(6.4, 4.2)
    axes = figure.subplots()
    axes.imshow(probabilities[order], cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for row, place in enumerate(order):
        axes.plot(
            classes.index(some.labels[place]), row, "s", mfc="none", mec=ORANGE, ms=15, mew=1.6
        )
    short = [
        label.replace("Motor_", "M").replace("Steady_state_error", "bias").replace("_", " ")
        for label in classes
    ]
    axes.set_xticks(range(len(classes)), short, rotation=45, ha="right", fontsize=8)
    axes.set_yticks(range(len(order)), [some.ids[place] for place in order], fontsize=8)
    dress(axes, "class; orange: the true one", "test trajectory")
    axes.grid(visible=False)
    save("inversion", figure, "Emulated robot; dark: probability near 1")


if __name__ == "__main__":
    main()
