from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from retwin.cases.armpi_fpv.twin import ARM


def chain(angles: np.ndarray) -> np.ndarray:
    """The same arm as a product of homogeneous transforms, slow and plain."""
    lengths = [0.028505, 0.0361, 0.10048, 0.094714]
    end = np.eye(4)
    for joint, (angle, length) in enumerate(zip(angles, lengths, strict=True)):
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.eye(4)
        rotation[:3, :3] = (
            [[c, -s, 0], [s, c, 0], [0, 0, 1]] if joint == 0 else [[1, 0, 0], [0, c, -s], [0, s, c]]
        )
        move = np.eye(4)
        move[2, 3] = length
        end = end @ move @ rotation
    return (end @ [0, 0, 0.05071, 1])[:3]


angles = st.lists(st.floats(-2, 2), min_size=4, max_size=4).map(np.array)


@given(angles)
def test_closed_form_is_the_chain_of_transforms(values: np.ndarray) -> None:
    np.testing.assert_allclose(ARM.position(values), chain(values), atol=1e-12)


@given(angles)
def test_jacobian_is_the_derivative(values: np.ndarray) -> None:
    step = 1e-6
    for joint in range(4):
        moved = np.eye(4)[joint] * step
        numeric = (ARM.position(values + moved) - ARM.position(values - moved)) / (2 * step)
        np.testing.assert_allclose(ARM.jacobian(values)[:, joint], numeric, atol=1e-8)


def test_straight_up() -> None:
    np.testing.assert_allclose(ARM.position(np.zeros(4)), [0, 0, 0.310509], atol=1e-12)
