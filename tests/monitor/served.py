"""A live monitor of emulated tanks behind its HTTP interface, with names that try to be markup."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import httpx
import numpy as np

import retwin as rt
from retwin.monitor import Explanations, Gate, Live, Registry, Store, fit_monitor
from retwin.monitor.server import create_app, listening, serving
from retwin.twins import ActuatorGain, Parameter, ParameterShift, SensorBias, State, StateTwin
from retwin.update import Dynamics, Library, fit_dynamics

BEGIN = 1_700_000_000
STEPS = 400
TWIN = "tank/<b>1</b>"
PUMP, LEVEL = "pump<script>alert(1)</script>", "<img src=x onerror=alert(1)>"
LEAKING = "<img src=x onerror=alert(document.domain)>"
ASSETS = (LEAKING, 'a/b?c=1#d%20"', "../../etc/passwd", "plain")
TANK = StateTwin(
    (State("level", "m", 0.5, 0.0, 3.0),),
    lambda x, u: x.level,
    rt.Channels((PUMP,), ("V",)),
    rt.Channels((LEVEL,), ("m",)),
    1.0,
    derivative=lambda x, u, p: (0.1 * u[0] - p.drain * x.level,),
    parameters=(Parameter("drain", "1/s", 0.01, 1.0, 0.1),),
)
CAUSES = {
    "leak</td><script>alert(2)</script>": ParameterShift("drain", size=(0.02, 0.5)),
    "weak pump": ActuatorGain(0, size=(-0.8, -0.1)),
    "sensor": SensorBias(0, size=(-0.5, 0.5)),
}


@dataclass(frozen=True)
class Served:
    """A server that runs, and what is behind it."""

    url: str
    token: str
    store: Store
    live: Live
    explanations: Explanations

    def client(self, token: str | None = None) -> httpx.Client:
        own = {"authorization": f"Bearer {self.token if token is None else token}"}
        return httpx.Client(base_url=self.url, headers=own, timeout=60, verify=False)

    def send(self, asset: str, first: int, last: int, seed: int = 5) -> dict:
        """Samples of a machine, of which the one that is named so leaks from sample 200 on."""
        fault = ParameterShift("drain", size=0.2, onset=200.0) if asset == LEAKING else None
        made = recorded(seed, fault)
        rows = [
            {
                "asset": asset,
                "time": BEGIN + k,
                "values": {PUMP: float(made.commands[0, k, 0]), LEVEL: made.observed[0, k, 0]},
            }
            for k in range(first, last)
        ]
        with self.client() as client:
            answer = client.post("/samples", json=rows)
        assert answer.status_code == 200, answer.text
        return dict(answer.json()[asset])


def recorded(seed: int, fault: rt.Fault | None = None, count: int = 1) -> rt.Trajectories:
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.0, 2.0, size=(count, STEPS // 20, 1)), 20, axis=1)
    made = TANK.simulate(pump, faults=[fault] * count, seed=0, parameters={"drain": 0.13})
    return made.replace(observed=made.observed + 0.01 * rng.normal(size=made.observed.shape))


@contextmanager
def served(folder: Path) -> Iterator[Served]:
    """A server with two versions of a twin: one with too much noise, and a better shadow."""
    twin = fit_dynamics(TANK, recorded(0), Dynamics(Library(0, (), False))).twin
    with Store(folder / "store") as store:
        registry = Registry(store, TWIN)
        for number, version in ((1, replace(twin, noise=9 * twin.noise)), (2, twin)):
            made = fit_monitor(version, recorded(1, count=2), "1 per day")
            made.save(folder / f"{number}")
            registry.propose(folder / f"{number}", f"<b>number</b> {number}")
        registry.promote(1)
        registry.shadow(2)
        live, token = Live(store), secrets.token_urlsafe()
        for name in ASSETS:
            live.add(name, TWIN)
        with (
            Explanations(live, lambda twin: dict(CAUSES)) as explanations,
            Gate(live) as gate,
            listening("127.0.0.1", 0) as bound,
        ):
            app = create_app(live, gate, token=token, explanations=explanations)
            with serving(app, bound):
                url = f"http://127.0.0.1:{bound.getsockname()[1]}"
                yield Served(url, token, store, live, explanations)
