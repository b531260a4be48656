"""State equations learned from simulations of black-box twins, and what they are good for.

    python benchmarks/state_surrogate.py [DATA.csv]

Each system is a plain function, or a MuJoCo model, of which nothing but simulations are used. The
error is that of free simulation of 50 fresh command sequences over the standard deviation of the
output, whole, in the first and in the last tenth of the samples; the worst output counts. `speed`
is the twin's time per sample over that of the surrogate. The two wells and the ball are chaotic and
hybrid: without the higher `allowed` of this benchmark they are refused.

`shifted` simulates the spring of a black box with 5.5 N/m and 0.8 N s/m, 12 times two records with
errors of 1 cm, and estimates both through a surrogate that was learned for 2 to 8 N/m and 0.2 to
1.2 N s/m: the median relative error of `fit_dynamics`, and the share of intervals of 1.645 standard
errors that hold the truth.

With DATA.csv, the cascaded tanks: a surrogate of the simple twin as a function, with three
parameters, is calibrated on the estimation record by `fit_dynamics`, and so is the simple twin's
`StateTwin`. RMSE of the validation record in V, which was seen while this was developed.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.typing import NDArray
from record import record

import retwin as rt
from retwin.cases.cascaded_tanks.case import VOLTAGES, benchmark
from retwin.cases.cascaded_tanks.twin import TANKS
from retwin.twins import CommandSampler, HoldSampler
from retwin.update import StateSurrogate, fit_dynamics, fit_state_surrogate

FRESH = 50
RECORDS = 12
SUBSTEPS = 4
Values = Sequence[NDArray]
Row = dict[str, float]


def integrated(
    slope: Callable[[Values, NDArray], Values],
    start: Sequence[float],
    seen: int,
    rate: float,
    commands: NDArray,
) -> NDArray:
    """The first `seen` states of equations, by Runge-Kutta steps."""
    x, found, h = [np.full(len(commands), each) for each in start], [], 1 / rate / SUBSTEPS
    for u in commands[..., 0].T:
        found.append(np.stack(x[:seen], axis=1))
        for _ in range(SUBSTEPS):
            slopes: list[Values] = []
            for share in (0.0, 0.5, 0.5, 1.0):
                last = slopes[-1] if slopes else [np.zeros(len(u))] * len(x)
                slopes.append(slope([a + share * h * k for a, k in zip(x, last, strict=True)], u))
            x = [
                a + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
                for a, k in zip(x, zip(*slopes, strict=True), strict=True)
            ]
    return np.stack(found, axis=1)


def levels(
    commands: NDArray, pump: float = 0.07468, upper: float = 0.053939, lower: float = 0.08972
) -> NDArray:
    """The lower level of the cascaded tanks without overflow."""

    def slope(x: Values, u: NDArray) -> Values:
        between, out = (
            c * np.sqrt(each.clip(0)) for c, each in zip((upper, lower), x, strict=True)
        )
        return [pump * u - between, between - out]

    starts = [each.start for each in TANKS.states]
    found = integrated(slope, starts, 2, TANKS.rate, commands)
    return found[..., 1:].clip(0)


def spring(commands: NDArray, stiffness: float = 4.0, damping: float = 0.5) -> NDArray:
    def slope(x: Values, u: NDArray) -> Values:
        return [x[1], u - damping * x[1] - stiffness * (x[0] + x[0] ** 3)]

    return integrated(slope, [0.2, 0.0], 1, 10.0, commands)


def van_der_pol(commands: NDArray) -> NDArray:
    return integrated(
        lambda x, u: [x[1], (1 - x[0] ** 2) * x[1] - x[0] + u], [2.0, 0.0], 2, 10.0, commands
    )


def two_masses(commands: NDArray) -> NDArray:
    def slope(x: Values, u: NDArray) -> Values:
        between = 3 * (x[0] - x[2])
        return [
            x[1],
            -0.3 * x[1] - between - 2 * x[0] ** 3,
            x[3],
            u - 0.4 * x[3] - 4 * x[2] + between,
        ]

    return integrated(slope, [0.0] * 4, 1, 10.0, commands)


def two_wells(commands: NDArray) -> NDArray:
    return integrated(
        lambda x, u: [x[1], u - 0.3 * x[1] + x[0] - x[0] ** 3], [1.0, 0.0], 1, 10.0, commands
    )


def ball(commands: NDArray) -> NDArray:
    """A ball that a force moves, and that bounces."""
    height, speed, found = np.ones(len(commands)), np.zeros(len(commands)), []
    for u in commands[..., 0].T:
        found.append(height)
        for _ in range(10):
            speed = speed + (u - 9.81) * 0.002
            height = height + speed * 0.002
            speed = np.where((height < 0) & (speed < 0), -0.8 * speed, speed)
    return np.stack(found, axis=1)[..., None]


PENDULUM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body>
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.3"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
</mujoco>
"""


def function_twin(function: Callable[..., NDArray], rate: float, outputs: int = 1) -> rt.Twin:
    channels = rt.Channels.numbered("y", outputs)
    return rt.FunctionTwin(function, rt.Channels(("u",), ("1",)), channels, rate)


def holds(amplitude: float, rate: float, duration: float) -> HoldSampler:
    return HoldSampler((-amplitude,), (amplitude,), rate, duration)


def followed(twin: rt.Twin, sampler: CommandSampler, settings: StateSurrogate) -> Row:
    """How well a surrogate of a twin follows it, and what it costs."""
    found = fit_state_surrogate(twin, sampler, settings=settings)
    fresh = sampler.sample(FRESH, rng=np.random.default_rng(99)).astype(float)
    made = twin.simulate(fresh, seed=0).observed
    error, tenth = found.twin.simulate(fresh, seed=0).observed - made, made.shape[1] // 10

    def relative(part: slice) -> float:
        rms = np.sqrt(np.mean(error[:, part] ** 2, axis=(0, 1)))
        return float(np.max(rms / made.std(axis=(0, 1))))

    return {
        "states": found.figures["states"],
        "error": relative(slice(None)),
        "first tenth": relative(slice(tenth)),
        "last tenth": relative(slice(-tenth, None)),
        "s": found.seconds,
        "speed": found.figures["speed"],
    }


def springs(values: dict[str, float]) -> rt.Twin:
    return function_twin(partial(spring, **values), 10.0)


def tanks_of(values: dict[str, float]) -> rt.Twin:
    function = partial(levels, **values)
    return rt.FunctionTwin(function, TANKS.inputs, TANKS.outputs, TANKS.rate, limits=TANKS.limits)


SPRINGS = rt.ParametricTwin.built(
    springs,  # type: ignore[arg-type]
    (
        rt.Parameter("stiffness", "N/m", 2.0, 8.0, 4.0),
        rt.Parameter("damping", "N s/m", 0.2, 1.2, 0.5),
    ),
)


def shifted() -> Row:
    """Two parameters of a black box, estimated through its surrogate."""
    truth, sampler = {"stiffness": 5.5, "damping": 0.8}, holds(3.0, 10.0, 20.0)
    surrogate = fit_state_surrogate(SPRINGS, sampler).twin
    errors, inside = [], []
    for seed in range(RECORDS):
        rng = np.random.default_rng(seed)
        made = SPRINGS.with_values(truth).simulate(sampler.sample(2, rng=rng), seed=0)
        made = made.replace(observed=made.observed + rng.normal(0, 0.01, made.observed.shape))
        found = fit_dynamics(surrogate, made)
        for name, value in truth.items():
            errors.append(abs(found.parameters[name] / value - 1))
            inside.append(abs(found.parameters[name] - value) < 1.645 * found.errors[name])
    return {"relative error": float(np.median(errors)), "inside 90 %": float(np.mean(inside))}


def tanks(file: Path) -> dict[str, Row]:
    """Corrected dynamics of the tanks, of the simple twin and of surrogates of it."""
    estimation, validation = benchmark(TANKS)(file)
    twin = rt.ParametricTwin.built(tanks_of, TANKS.parameters)  # type: ignore[arg-type]
    rows = {"StateTwin": calibrated(TANKS, estimation, validation)}
    for spread, seed in ((0.1, 0), (0.1, 1), (0.1, 2), (0.3, 0)):
        settings = StateSurrogate(spread=spread)
        found = fit_state_surrogate(twin, VOLTAGES, estimation, settings, seed=seed)
        rows[f"spread {spread:g}, seed {seed}"] = calibrated(found.twin, estimation, validation) | {
            "surrogate: error, V": found.figures["own_level"],
            "surrogate: s": found.seconds,
        }
    return rows


def calibrated(twin: rt.twins.StateTwin, estimation: rt.Trajectories, test: rt.Trajectories) -> Row:
    began = time.perf_counter()
    fitted = fit_dynamics(twin, estimation)
    duration = time.perf_counter() - began
    before, after = (
        float(np.sqrt(np.mean((each.simulate(test.commands, seed=0).nominal - test.observed) ** 2)))
        for each in (twin, fitted.twin)
    )
    held_out = fitted.figures["held_out"]
    return {"twin, V": before, "corrected, V": after, "held out, V": held_out, "s": duration}


def main() -> None:
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    large = StateSurrogate(states=2, allowed=1e9)
    with TemporaryDirectory() as folder:
        file = Path(folder, "pendulum.xml")
        file.write_text(PENDULUM)
        pendulum = rt.MuJoCoTwin.from_file(file, rate=20.0)
        usual = StateSurrogate()
        rows = {
            "tanks": followed(tanks_of({}), VOLTAGES, usual),
            "hardening spring": followed(springs({}), holds(3.0, 10.0, 20.0), usual),
            "van der Pol": followed(
                function_twin(van_der_pol, 10.0, 2), holds(2.0, 10.0, 20.0), usual
            ),
            "two masses": followed(function_twin(two_masses, 10.0), holds(2.0, 10.0, 30.0), usual),
            "MuJoCo pendulum": followed(pendulum, holds(1.0, 20.0, 15.0), usual),
            "two wells": followed(function_twin(two_wells, 10.0), holds(0.5, 10.0, 30.0), large),
            "bouncing ball": followed(function_twin(ball, 50.0), holds(3.0, 50.0, 4.0), large),
        }
    record("state_surrogate", "State surrogates of black-box twins", rows)
    record("state_surrogate_shifted", "Parameters of a black box", {"spring": shifted()})
    if len(sys.argv) > 1:
        record("state_surrogate_tanks", "Tanks, validation record", tanks(Path(sys.argv[1])))


if __name__ == "__main__":
    main()
