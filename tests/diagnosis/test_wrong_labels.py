"""Labels that diagnoses contradict."""

from __future__ import annotations

import numpy as np
import pytest

from retwin.diagnosis.labels import find_wrong_labels

CLASSES = ("Healthy", "Leak", "Stuck", "Bias")
TRUE = np.repeat(np.arange(4), 6)
IDS = [f"run {number}" for number in range(24)]


def diagnosed(certain: float = 0.995, wrong: float = 0.0) -> np.ndarray:
    """Probabilities of a diagnoser that is right but for a share of the records."""
    rng = np.random.default_rng(0)
    answers = np.where(rng.random(24) < wrong, (TRUE + 1) % 4, TRUE)
    return np.where(answers[:, None] == np.arange(4), certain, (1 - certain) / 3)


def test_right_labels_have_no_finding() -> None:
    assert not list(find_wrong_labels(diagnosed(), TRUE, CLASSES, IDS))


@pytest.mark.parametrize("order", [[0, 2, 1, 3], [0, 2, 3, 1], [1, 2, 3, 0]])
def test_exchanged_labels_are_named(order: list[int]) -> None:
    found = list(find_wrong_labels(diagnosed(), np.array(order)[TRUE], CLASSES, IDS))
    assert {each.kind for each in found} == {"labels exchanged"}
    named = [f"{CLASSES[b]} seems to stand for {CLASSES[a]}: 6 of 6" for a, b in enumerate(order)]
    expected = [name for (a, b), name in zip(enumerate(order), named, strict=True) if a != b]
    assert sorted(each.text.split(" records")[0] for each in found) == sorted(expected)


def test_labels_shifted_by_one_record_are_named_where_they_change() -> None:
    found = list(find_wrong_labels(diagnosed(), np.roll(TRUE, 1), CLASSES, IDS))
    assert [each.record for each in found] == ["run 0", "run 6", "run 12", "run 18"]
    assert "labelled Healthy, diagnosed as Leak with probability 0.995" in found[1].text


def test_a_diagnoser_that_is_not_certain_or_mostly_wrong_contradicts_nothing() -> None:
    exchanged = np.array([0, 2, 1, 3])[TRUE]
    assert not list(find_wrong_labels(diagnosed(certain=0.9), exchanged, CLASSES, IDS))
    assert not list(find_wrong_labels(diagnosed(wrong=0.5), TRUE, CLASSES, IDS))


def test_two_classes_taken_for_one_are_not_exchanged() -> None:
    taken = diagnosed()
    taken[6:12] = taken[12:18]  # every leak is diagnosed as stuck, as a poor diagnoser may do
    assert not list(find_wrong_labels(taken, TRUE, CLASSES, IDS))
