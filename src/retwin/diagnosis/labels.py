"""`find_wrong_labels`: labels that diagnoses contradict which were made without labels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.finding import Finding

MAJORITY = 0.8
"""Share of the records of a label that are diagnosed as another class, where labels are exchanged;
and of all other records that are diagnosed as labelled, where single labels are doubtful."""


def find_wrong_labels(
    probabilities: NDArray, labels: NDArray, classes: Sequence[str], ids: Sequence[str]
) -> Iterator[Finding]:
    """Labels that are exchanged as a whole, and labels of single records that seem to be wrong.

    Labels are exchanged where most records of each of them are diagnosed as another one of them: a
    poor diagnoser takes several classes for the same one. A single label is doubtful where most
    other diagnoses agree with their labels.

    Parameters
    ----------
    probabilities : ndarray, shape (n, classes)
        Of a diagnoser that has learned no labels of faults.
    labels : ndarray of int, shape (n,)
        Indices of the labels.
    classes : sequence of str
        Names of the classes.
    ids : sequence of str
        Names of the records.

    """
    # Probability of a diagnosis from which on it contradicts a label.
    answers, certain = probabilities.argmax(axis=1), probabilities.max(axis=1) >= 0.99
    taken = dict[int, int]()
    for label in np.unique(labels).tolist():
        rows = labels == label
        counts = np.bincount(answers[rows & certain], minlength=len(classes))
        answer = int(counts.argmax())
        # Records of a label from which on it may be exchanged as a whole.
        if answer != label and counts[answer] >= max(3, MAJORITY * rows.sum()):
            taken[label] = answer
    if set(taken) != set(taken.values()):
        taken = {}
    for label, answer in taken.items():
        rows = labels == label
        text = f"{classes[label]} seems to stand for {classes[answer]}: "
        text += f"{(answers[rows] == answer).sum()} of {rows.sum()} records are diagnosed so"
        yield Finding("", "", "labels exchanged", text)
    rest = ~np.isin(labels, list(taken))
    if rest.any() and np.mean((answers == labels)[rest]) >= MAJORITY:
        for row in np.flatnonzero(rest & certain & (answers != labels)).tolist():
            text = f"labelled {classes[labels[row]]}, diagnosed as {classes[answers[row]]} with "
            text += f"probability {probabilities[row].max():.3g} by what learned no labels"
            yield Finding(str(ids[row]), "", "label", text)
