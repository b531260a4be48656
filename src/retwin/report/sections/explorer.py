"""The explorer: any test trajectory in full, picked by the reader."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Section
from retwin.report.figures.figure import Key
from retwin.report.figures.style import DASHES, PALETTE, colour_index, colour_of
from retwin.report.labels import class_name, quantities, source_name
from retwin.report.study import Study
from retwin.results import OverlayInfo

FINE, COARSE, POSE = 16000, 4000, 1500
"""Steps from the smallest to the largest number: of signals, bands, and poses."""


def explorer(study: Study) -> Section | None:
    """Commands, outputs, bands, segments, z, probabilities and poses of each trajectory."""
    overlay = study.results.overlay
    if overlay is None or not study.explorable:
        return None
    healthy = f"90 % and 50 % bands of the healthy twin: {source_name(overlay.source)}"
    keys = [
        Key("measured", "ink"),
        Key("nominal", "muted", "dot"),
        Key(healthy, colour_of(overlay.source), "bar"),
        Key("in motion", "grid", "bar"),
        *(
            Key(f"command {name}", f"c{u % len(PALETTE)}", DASHES[u % len(DASHES)])
            for u, name in enumerate(study.results.inputs.names)
        ),
    ]
    content = _content(study, overlay)
    values = {
        "keys": keys,
        "source": overlay.source,
        "latent": content["latent"] is not None,
        "pose": content["pose"] is not None,
        "pose_keys": _pose_keys(content["pose"] or {}, overlay.source),
        "several": bool(content["classes"]),
    }
    return Section("explorer", "Explorer", values, scripts={"explorer": content})


def _pose_keys(pose: dict[str, Any], source: str) -> list[Key]:
    """What the chains of the picture in space are, in their colours."""
    named = {
        "nominal": Key("nominal", "observed"),
        "updated": Key(f"{source_name(source)}, median", colour_of(source)),
        "observed": Key("measured", "ink"),
    }
    return [key for name, key in named.items() if name in pose]


def _content(study: Study, overlay: OverlayInfo) -> dict[str, Any]:
    """Everything that the page's script draws, as JSON."""
    results, portrait = study.results, study.portrait
    inputs, outputs = (
        quantities(each.units, len(each.names)) for each in (results.inputs, results.outputs)
    )
    scale = np.array([factor for factor, _ in outputs])
    sources = [name for name in study.sources if study.probabilities(name).size]
    shown = results.overlaid
    probabilities = [study.probabilities(name).mean(axis=0)[shown] for name in sources]
    return {
        "ids": [results.data.test.ids[place] for place in shown],
        "truth": study.truth[shown].tolist(),
        "classes": [class_name(name) for name in results.classes],
        "sources": [{"name": source_name(n), "colour": colour_index(n)} for n in sources],
        "probabilities": packed(np.array(probabilities)) if sources else None,
        "rate": float(portrait["rate"]),
        "inputs": {"names": results.inputs.names, "units": [unit for _, unit in inputs]},
        "outputs": {"names": results.outputs.names, "units": [unit for _, unit in outputs]},
        "commands": packed(np.array([f for f, _ in inputs]) * portrait["commands"], 1),
        **{name: packed(scale * portrait[name], 1) for name in ("nominal", "observed")},
        "bands": packed(scale * portrait["bands"], 2, COARSE),
        "times": packed(portrait["times"]),
        "colour": colour_index(overlay.source),
        "latent": _latent(study, overlay),
        "pose": _poses(study),
    }


def _latent(study: Study, overlay: OverlayInfo) -> dict[str, Any] | None:
    """The inferred z and its standard deviation, in the units that are shown."""
    portrait = study.portrait
    if not np.isfinite(portrait["z"]).any():
        return None
    factors = quantities(overlay.latent_units, len(overlay.latents))
    scale = np.array([factor for factor, _ in factors])
    return {
        "names": [name.replace("_", " ") for name in overlay.latents],
        "units": [unit for _, unit in factors],
        "z": _rounded(scale * portrait["z"]),
        "deviation": _rounded(scale * portrait["deviation"]),
    }


def _rounded(values: NDArray) -> Any:
    """Nested lists with four digits; a few numbers of very different size are not packed."""
    flat = [float(f"{value:.4g}") for value in values.ravel()]
    return np.array(flat).reshape(values.shape).tolist()


def _poses(study: Study) -> dict[str, Any] | None:
    """Chains of points (n, P, points, 3), and the box around all of them."""
    if "pose/observed" not in study.arrays:
        return None
    names = [name for name in ("nominal", "observed", "updated") if f"pose/{name}" in study.arrays]
    chains = {name: study.arrays[f"pose/{name}"] for name in names}
    low = np.min([each.min(axis=(0, 1, 2)) for each in chains.values()], axis=0)
    high = np.max([each.max(axis=(0, 1, 2)) for each in chains.values()], axis=0)
    margin = 0.06 * (high - low).max()
    return {
        **{name: packed(each, 1, POSE) for name, each in chains.items()},
        "low": np.round(low - margin * np.array([1, 1, 0]), 4).tolist(),
        "high": np.round(high + margin, 4).tolist(),
    }


def packed(values: NDArray, axis: int = -1, steps: int = FINE) -> dict[str, Any]:
    """Numbers in equal steps from the smallest to the largest, as compressed differences.

    Codes of 16 bits, differences along `axis` (modulo 65536), all low bytes before all high ones,
    deflate, base64: signals change little from sample to sample, so that they take few bytes. The
    page's script computes low + step code; the code 65535 is a missing number.
    """
    known = values[np.isfinite(values)]
    low = float(known.min()) if known.size else 0.0
    step = (float(known.max()) - low) / steps if known.size else 0.0
    codes = np.zeros(values.shape) if step == 0 else (values - low) / step
    # The code of a number that is not defined.
    whole = np.where(np.isfinite(values), np.round(codes), 65535).astype(np.uint16)
    first = np.zeros_like(whole.take([0], axis=axis)) if whole.shape[axis] else whole
    change = np.diff(whole, axis=axis, prepend=first).astype("<u2")
    planes = np.ascontiguousarray(change).view(np.uint8).reshape(-1, 2).T
    text = base64.b64encode(zlib.compress(planes.tobytes(), 6)).decode()
    axis = axis % values.ndim
    return {"low": low, "step": step, "shape": list(values.shape), "axis": axis, "codes": text}
