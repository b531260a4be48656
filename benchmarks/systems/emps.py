"""The electro-mechanical positioning system, A. Janot, M. Gautier and M. Brunot (2019).

From the motor's force to the position of a carriage; measured in closed loop, so that in open loop
the twin is an integrator. The first record calibrates, that with pulses of the force tests. Both
are thinned from 1 kHz to 200 Hz: forces are means over a sample, positions are at its begin. The
twin has a mass, viscous friction and an offset; one of two has Coulomb friction too. Both records
begin at rest at 0.
"""

from __future__ import annotations

from pathlib import Path

import torch
from scipy.io import loadmat

import retwin as rt
from retwin.twins import State, StateTwin
from systems.system import System, trajectory

EVERY = 5
"""Samples at 1 kHz per sample."""
SMOOTH = 1e-3
"""Speed in m/s below which the sign of Coulomb friction passes from one to the other."""
PARAMETERS = (
    rt.Parameter("mass", "kg", 20.0, 400.0, 100.0),
    rt.Parameter("viscous", "N s/m", 10.0, 1000.0, 200.0),
    rt.Parameter("offset", "N", -20.0, 20.0, 0.0),
)
COULOMB = rt.Parameter("coulomb", "N", 0.0, 100.0, 10.0)


def sliding(x, u, p):
    return x.speed, (u.force - p.viscous * x.speed - p.offset) / p.mass


def sticking(x, u, p):
    dry = p.coulomb * torch.tanh(x.speed / SMOOTH)
    return x.speed, (u.force - p.viscous * x.speed - dry - p.offset) / p.mass


def position(x, u):
    return x.position


def carriage(derivative, *further: rt.Parameter, substeps: int = 1) -> rt.ParametricTwin:
    return StateTwin(
        [State("position", "m"), State("speed", "m/s")],
        position,
        rt.Channels(("force",), ("N",)),
        rt.Channels(("position",), ("m",)),
        1000.0 / EVERY,
        derivative=derivative,
        parameters=(*PARAMETERS, *further),
        substeps=substeps,
    ).parametric()


def emps(folder: Path, row: str, twin: rt.ParametricTwin) -> System:
    records = []
    for name in ("DATA_EMPS", "DATA_EMPS_PULSES"):
        table = loadmat(folder / "emps" / f"{name}.mat")
        force, measured = (table["gtau"] * table["vir"]).ravel(), table["qm"].ravel()
        samples = len(force) // EVERY
        force = force[: samples * EVERY].reshape(samples, EVERY).mean(axis=1)
        records.append(trajectory(twin, force, measured[::EVERY][:samples]))
    return System(
        twin,
        records[0],
        {row: records[1]},
        "mm",
        1000.0,
        published="9.1 IDIM-LS parameters in open loop",
        data="emps",
    )


SYSTEMS = {
    "emps": lambda folder: emps(folder, "EMPS, without Coulomb friction", carriage(sliding)),
    "emps_coulomb": lambda folder: emps(
        folder, "EMPS, with Coulomb friction", carriage(sticking, COULOMB, substeps=4)
    ),
}
