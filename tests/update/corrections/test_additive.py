from __future__ import annotations

import numpy as np
import pytest
import torch

import retwin as rt
from retwin import catalog
from retwin.serialisation.configs import from_config, to_config
from retwin.testing import check_correction
from retwin.update.corrections import Additive

KINDS = catalog.classes(catalog.CORRECTIONS)

pytestmark = pytest.mark.numerical


@pytest.fixture(scope="module")
def context(exact, case: rt.Case) -> rt.Context:
    commands = case.sampler.sample(4, rng=np.random.default_rng(0))[:, :300]
    return rt.Context.of(exact, commands, rt.Segments.from_commands(commands), rate=100.0)


def test_it_keeps_the_contract(context: rt.Context) -> None:
    z = torch.tensor(np.random.default_rng(1).normal(0, 0.01, context.path.shape)).float()
    check_correction(Additive(), context, z)


def test_z_is_what_is_measured_beyond_the_path(context: rt.Context) -> None:
    observed = context.path + 0.25
    mask = torch.ones(observed.shape, dtype=torch.bool)
    mask[1, 40:60, 2] = False
    observed = torch.where(mask, observed, 1e6)
    found = Additive().infer(context, observed, mask)
    torch.testing.assert_close(found.z[mask], torch.full_like(found.z[mask], 0.25))
    assert not found.z[~mask].any()
    torch.testing.assert_close(found.identified, mask)
    torch.testing.assert_close(torch.where(mask, Additive().apply(context, found.z), 1e6), observed)


def test_it_may_stand_in_a_model_folder_and_has_a_name() -> None:
    assert from_config(to_config(Additive(), KINDS), KINDS) == Additive()
    assert catalog.make(catalog.CORRECTIONS, "additive", "correction") == Additive()
