"""The explorer: any test trajectory in full, picked by whoever reads the page."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Explorer, Key, Section
from retwin.report.plots import caption
from retwin.report.results import Results
from retwin.report.words import DASHES, PALETTE, class_name, order, quantity, slot, source_name

__all__ = ["explorable", "explorer", "packed"]

NOTHING = -32768
"""Stands for a number that is not there."""
STEPS = 65534


def explorable(results: Results) -> bool:
    """Whether the page has an explorer."""
    there = results.portrait is not None and "portrait/bands" in results.arrays
    return there and bool(results.data.test.ids)


def explorer(results: Results) -> Section | None:
    """Commands, outputs and bands, movements, z, probabilities and poses of each trajectory."""
    told = results.portrait
    if told is None or not explorable(results):
        return None
    keys = [
        Key("measured", "ink"),
        Key("nominal", "muted", "dot"),
        Key(
            f"90 % and 50 % of what a healthy twin would do: {source_name(told.source)}",
            f"c{slot(told.source)}",
            "bar",
        ),
        Key("in motion", "grid", "bar"),
        *(
            Key(f"command {name}", f"c{u % len(PALETTE)}", DASHES[u % len(DASHES)])
            for u, name in enumerate(results.inputs.names)
        ),
    ]
    text = (
        "Pick any test trajectory. Bands are those of the corrected twin with nothing broken: a "
        "healthy trajectory should lie within them, a faulty one leaves them. z is inferred from "
        "the outputs as if nothing were broken, so of a faulty trajectory it is not to be "
        "believed; a dash is what outputs do not tell."
    )
    if "pose/observed" in results.arrays:
        text += (
            " The observed pose is the nearest to the nominal one that explains the outputs, an "
            "inference and not a measurement."
        )
    return Section(
        "explorer", "Explorer", [Explorer(caption(results, text), _content(results), keys)]
    )


def _content(results: Results) -> dict[str, Any]:
    """All that the page's script draws, as JSON."""
    told, arrays = results.portrait, results.arrays
    assert told is not None, "as the caller has checked"
    factors = [quantity(unit) for unit in results.outputs.units]
    scale = np.array([factor for factor, _ in factors])
    given = [quantity(unit) for unit in results.inputs.units]
    sources = [name for name in order(list(results.sources)) if results.probabilities(name).size]
    shares = [results.probabilities(name).mean(axis=0) for name in sources]
    labels = results.data.test.labels
    return {
        "ids": results.data.test.ids,
        "truth": [results.classes.index(label) for label in labels],
        "classes": [class_name(name) for name in results.classes],
        "sources": [{"name": source_name(name), "slot": slot(name)} for name in sources],
        "probabilities": packed(np.array(shares)) if sources else None,
        "rate": float(arrays["portrait/rate"]),
        "inputs": {"names": results.inputs.names, "units": [unit for _, unit in given]},
        "outputs": {"names": results.outputs.names, "units": [unit for _, unit in factors]},
        "commands": packed(np.array([f for f, _ in given]) * arrays["portrait/commands"]),
        **{
            name: packed(scale * arrays[f"portrait/{name}"])
            for name in ("nominal", "observed", "bands")
        },
        "times": packed(arrays["portrait/times"]),
        "slot": slot(told.source),
        "latent": _latent(results),
        "pose": _poses(results),
    }


def _latent(results: Results) -> dict[str, Any] | None:
    """The inferred z and how well it is known, in units to read."""
    told, arrays = results.portrait, results.arrays
    assert told is not None
    if not np.isfinite(arrays["portrait/z"]).any():
        return None
    factors = [quantity(unit) for unit in told.movement_units]
    scale = np.array([factor for factor, _ in factors])
    return {
        "names": [name.replace("_", " ") for name in told.movement],
        "units": [unit for _, unit in factors],
        "z": _plain(scale * arrays["portrait/z"]),
        "deviation": _plain(scale * arrays["portrait/deviation"]),
    }


def _plain(values: NDArray) -> Any:
    """Nested lists with four digits; few numbers of very different size are not worth packing."""
    flat = [float(f"{value:.4g}") for value in values.ravel()]
    return np.array(flat).reshape(values.shape).tolist()


def _poses(results: Results) -> dict[str, Any] | None:
    """Chains of points (n, P, points, 3), and the box around all of them."""
    if "pose/observed" not in results.arrays:
        return None
    nominal, observed = (results.arrays[f"pose/{name}"] for name in ("nominal", "observed"))
    both = np.concatenate([nominal, observed])
    low, high = both.min(axis=(0, 1, 2)), both.max(axis=(0, 1, 2))
    air = 0.06 * (high - low).max()
    return {
        "nominal": packed(nominal),
        "observed": packed(observed),
        "low": np.round(low - air * np.array([1, 1, 0]), 4).tolist(),
        "high": np.round(high + air, 4).tolist(),
    }


def packed(values: NDArray) -> dict[str, Any]:
    """Numbers in 16 bits each: whole steps from the least to the greatest; few bytes, no loss seen.

    The script turns them back: low + step (code + 32767), and nothing where the code is -32768.
    """
    known = values[np.isfinite(values)]
    low = float(known.min()) if known.size else 0.0
    step = (float(known.max()) - low) / STEPS if known.size else 0.0
    codes = np.zeros(values.shape) if step == 0 else (values - low) / step
    codes = np.where(np.isfinite(values), np.round(codes) - 32767, NOTHING)
    text = base64.b64encode(codes.astype("<i2").tobytes()).decode()
    return {"low": low, "step": step, "shape": list(values.shape), "codes": text}
