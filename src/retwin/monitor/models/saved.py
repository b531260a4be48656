"""Monitors on the disk."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from retwin.checks import finite
from retwin.monitor.detect.disturbance import Disturbance
from retwin.monitor.detect.noise import Noise
from retwin.monitor.detect.predictors import Predictor
from retwin.monitor.detect.promise import Tried
from retwin.monitor.detect.scores import ConformalScores
from retwin.monitor.detect.slack import Slack
from retwin.monitor.models.state import Visible, arrays_of, part_of
from retwin.serialisation.models import check_weights, read_model, refusing, write_model
from retwin.update.dynamics.twin import DynamicsTwin

KIND = "monitor"
"""Kind of the saved model."""
NUMBERS = ("arl", "lasting", "alpha")
"""Attributes of a monitor that are saved as numbers."""
DISTURBANCE = ("coefficients", "mean", "process", "measurement")
"""Attributes of the disturbance that are saved as arrays."""


def write_fields(folder: str | Path, fields: Mapping[str, Any]) -> None:
    """Write the attributes of a monitor."""
    scores, predictors, slack = (fields[name] for name in ("scores", "predictors", "slack"))
    about = {
        "slack": [[each.kappa, each.shift] for each in slack],
        "copies": scores.copies,
        "predictors": [[each.process, each.warm_up, each.effect] for each in predictors],
        "tried": vars(fields["tried"]),
        "visible": [vars(each) for each in fields["visible"]],
        "free": fields["free"],
        **{name: fields[name] for name in NUMBERS},
    }
    arrays = {name: getattr(fields["disturbance"], name) for name in DISTURBANCE}
    arrays |= (
        arrays_of("noise", fields["noise"]) | scores.arrays() | {"resolution": fields["resolution"]}
    )
    tensors = {name: torch.tensor(np.ascontiguousarray(each)) for name, each in arrays.items()}
    with write_model(folder, KIND, about, tensors) as temporary:
        fields["twin"].save(temporary / "twin")


def read_fields(folder: str | Path) -> dict[str, Any]:
    """The attributes of a monitor; InputError if the folder holds none or is damaged."""
    about, weights = read_model(folder, KIND)
    with refusing(folder, expected="a monitor"):
        arrays = {name: each.numpy() for name, each in weights.items()}
        nothing = np.zeros((len(arrays["mean"]), 0))
        own = {name: arrays[name] for name in DISTURBANCE}
        disturbance = Disturbance(**own, held_out=nothing, deviation=nothing)
        noise = part_of(Noise, "noise", arrays)
        scores = ConformalScores.of_arrays(arrays, about["copies"])
        slack = tuple(Slack(*each) for each in about["slack"])
        twin = DynamicsTwin.load(Path(folder) / "twin")
        predictors = tuple(Predictor(*each) for each in about["predictors"])
        streams = len(predictors) * len(twin.outputs)
        of_noise = noise.mean, noise.scale, noise.degrees
        parts = disturbance.mean, scores.independent, slack, *of_noise, arrays["resolution"]
        shapes = [len(each) for each in parts]
        values = (disturbance.coefficients, noise.mean, noise.scale, noise.low, noise.high)
        right = (
            shapes == [streams] * 6 + [len(twin.outputs)]
            and all(np.isfinite(each).all() for each in values)
            and (disturbance.process > 0).all()
            and (disturbance.measurement >= 0).all()
        )
        check_weights(right, f"the calibration of {len(twin.outputs)} outputs", shapes)
        return {
            "twin": twin,
            "disturbance": disturbance,
            "scores": scores,
            "slack": slack,
            "resolution": arrays["resolution"],
            "noise": noise,
            "tried": Tried(**about["tried"]),
            "predictors": predictors,
            "visible": tuple(Visible(**each) for each in about["visible"]),
            "free": tuple(finite("free", each, at_least=0.0) for each in about["free"]),
            **{name: finite(name, about[name], at_least=0.0) for name in NUMBERS},
        }
