"""What the tests share: the arm's case, small sets, and models fitted once per worker."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC
from retwin.nets.mixtures import FLOOR
from retwin.nets.training import Training

# A machine that is busy is no failure.
settings.register_profile("any time", deadline=None)
settings.load_profile("any time")

FIRST = (
    "study/test_study.py",
    "study/test_whole_studies.py",
    "test_docs.py",
    "study/test_simulating.py",
    "update/state_surrogate/test_state_surrogate.py",
    "diagnosis/test_state_inversion.py",
    "long/test_odd_arguments.py",
    "foreign/test_duffing.py",
    "foreign/test_six_joints.py",
    "testing/test_whole_chain.py",
    "deploy/simulations/test_simulations.py",
)
"""Files that take longest. They start first: a worker that got one last would end alone."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {Path(__file__).parent / name: place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: places.get(item.path, len(FIRST)))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item):
    """With RETWIN_DATA set, a test on real data that is skipped has failed."""
    outcome = yield
    report = outcome.get_result()
    if report.skipped and os.environ.get("RETWIN_DATA") and item.get_closest_marker("real_data"):
        report.outcome = "failed"
        report.longrepr = "skipped although RETWIN_DATA is set"


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    """No test changes the number of torch's threads: later ones would be many times slower."""
    before = torch.get_num_threads()
    yield
    assert torch.get_num_threads() == before


# A surrogate that is good to a millimetre takes a second; the default one is tried in one test.
BRISK = Training(max_epochs=6, batch_size=256, learning_rate=1e-2)


@pytest.fixture(scope="session")
def case() -> rt.Case:
    return rt.cases.armpi()


@pytest.fixture(scope="session")
def twin_set(case: rt.Case) -> rt.Trajectories:
    return rt.generate(case.twin, case, per_class=12, seed=100)


@pytest.fixture(scope="session")
def emulated(case: rt.Case) -> rt.Trajectories:
    """Ten trajectories per class of the emulated robot."""
    return rt.generate(case.emulator, case, per_class=10, seed=101)


@pytest.fixture(scope="session")
def ibg(twin_set: rt.Trajectories) -> rt.Surrogate:
    return rt.fit_surrogate(twin_set, rt.MLP((64, 64)), seed=0, training=BRISK)


@pytest.fixture(scope="session")
def rg(ibg: rt.Surrogate, emulated: rt.Trajectories) -> rt.ResidualModel:
    return rt.fit_residual(ibg, emulated, seed=0)


@pytest.fixture(scope="session")
def updated(ibg: rt.Surrogate, rg: rt.ResidualModel) -> rt.CorrectedTwin:
    return rt.CorrectedTwin(ibg, rg, case="armpi")


class ExactArm(torch.nn.Module):
    """The arm's kinematics as a differentiable twin: a surrogate without any error."""

    memoryless = True
    inputs, outputs, rate = KINEMATIC.inputs, KINEMATIC.outputs, KINEMATIC.rate

    def forward(self, commands: torch.Tensor) -> torch.Tensor:
        angles = (commands - KINEMATIC.centre) * KINEMATIC.scale
        pitch = angles[..., 1:].cumsum(dim=-1)
        links = torch.tensor(KINEMATIC.arm.links, dtype=commands.dtype)
        radius, height = pitch.sin() @ links, pitch.cos() @ links
        yaw = angles[..., 0]
        return torch.stack(
            [yaw.sin() * radius, -yaw.cos() * radius, KINEMATIC.arm.base + height], dim=-1
        )

    def predict(self, commands: np.ndarray) -> np.ndarray:
        return KINEMATIC.position(np.asarray(commands, dtype=np.float64)).astype(np.float32)


@pytest.fixture(scope="session")
def exact() -> ExactArm:
    return ExactArm()


@pytest.fixture(scope="session")
def exact_updated(exact: ExactArm) -> rt.CorrectedTwin:
    """A corrected twin of which nothing is trained, so that it is the same on any machine.

    One component: a delay of 5 ± 0.5 samples, and offsets of 2 ± 3 mm.
    """
    density = rt.Mixture(components=1, hidden=(4,))
    rg = rt.ResidualModel(rt.DelayOffset(), density, inputs=exact.inputs, outputs=exact.outputs)
    with torch.no_grad():
        for head, part in rg.parts():
            head.linear.weight.zero_()
            head.linear.bias.zero_()
            width = part.stop - part.start
            diagonal = [1 + width + i * (i + 1) // 2 + i for i in range(width)]
            head.linear.bias[diagonal] = float(np.log(np.expm1(1 - FLOOR)))
        rg.shift.copy_(torch.tensor([5.0, 2e-3, 2e-3, 2e-3]))
        rg.scale.copy_(torch.tensor([0.5, 3e-3, 3e-3, 3e-3]))
        rg.bounds.copy_(10 * (rg.shift + rg.scale))
    return rt.CorrectedTwin(exact, rg.eval())
