"""Black-box models of outputs by commands, without a twin: rivals of corrected twins.

Belongs here: models whose equations know nothing of the system. Not here: corrections of twins.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from retwin.checks import one_of
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.twin import checked_seed
from retwin.update.blackbox.arx import fit_arx
from retwin.update.blackbox.estimate import BlackBox
from retwin.update.blackbox.lstm import fit_lstm
from retwin.update.blackbox.narx import fit_narx
from retwin.update.blackbox.neural import fit_neural_ss
from retwin.workers.threads import one_thread

__all__ = ["BLACK_BOXES", "BlackBox", "fit_black_box"]

BLACK_BOXES: Mapping[str, Callable[..., BlackBox]] = {
    "arx": fit_arx,
    "narx": fit_narx,
    "neural_ss": fit_neural_ss,
    "lstm": fit_lstm,
}
"""By name, which is that of the source in a study too."""


@one_thread()
def fit_black_box(
    observed: Trajectories,
    kind: str,
    *,
    members: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> BlackBox:
    """A model of the outputs by the commands, from calibration records alone.

    Its order and the strength of its prior are those with the least error of held-out blocks in
    free simulation; an LSTM has neither. Bands are calibrated by the same blocks.

    Parameters
    ----------
    observed : Trajectories
        Healthy calibration trajectories with commands; masked samples are not used.
    kind : str
        "arx", a linear model; "narx", a polynomial of past samples; "neural_ss", a linear
        state-space model with a small network inside its equations; "lstm", a recurrent network.
    members : int, optional
        Networks of an "lstm", whose outputs are averaged; fewer are faster and less accurate.
    seed : int
        Of the first weights of a network, at least 0.
    progress : callable, optional
        Called with the share of the work that is done.

    Returns
    -------
    BlackBox
        Its `twin` simulates from commands: a `DynamicsTwin`, or of "lstm" a `CorrectedTwin`.

    Raises
    ------
    InputError
        An unknown kind; no trajectory, one with a fault, no command channel, or an output that was
        never measured or never changes; or no order that has enough consecutive samples and whose
        free simulation stays finite.

    """
    began, fit = time.perf_counter(), BLACK_BOXES[one_of("kind", kind, BLACK_BOXES)]
    with np.errstate(over="ignore", invalid="ignore"):  # of models that diverge, and are not chosen
        more = {"members": members} if fit is fit_lstm else {}
        found = fit(observed, checked_seed(seed), progress, **more)
    return replace(found, seconds=time.perf_counter() - began)
