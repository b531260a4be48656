"""A synthetic study: made-up scores, but counts, scores and probabilities that fit together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MOTORS = range(1, 5)
CLASSES = [
    "Healthy",
    *(f"Motor_{motor}_Stuck" for motor in MOTORS),
    *(f"Motor_{motor}_Steady_state_error" for motor in MOTORS),
]
SKILL = {"dt": 1.2, "ibg": 1.5, "ibg_rg": 2.4}
PUBLISHED = {
    "dt": {
        "macro_f1": "0.644 ± 0.036",
        "auroc": "0.931 ± 0.008",
        "healthy_recall": "0.06",
        "generate": "8.5 h",
    },
    "ibg_rg": {
        "macro_f1": "0.753 ± 0.026",
        "auroc": "0.945 ± 0.006",
        "healthy_recall": "0.62",
        "generate": "4–5 min",
    },
}
Study = tuple[dict[str, Any], dict[str, NDArray]]


def _source(rng: np.random.Generator, truth: NDArray, skill: float, runs: int) -> Study:
    noise = rng.gumbel(size=(runs, len(truth), len(CLASSES)))
    logits = noise + skill * 1.6 * np.eye(len(CLASSES))[truth]
    logits[:, truth == 0, 5:] += 2.2 / skill
    probabilities = np.exp(1.5 * logits)
    probabilities /= probabilities.sum(axis=2, keepdims=True)
    predictions = probabilities.argmax(axis=2)
    confusion = np.zeros((len(CLASSES), len(CLASSES)), dtype=int)
    np.add.at(confusion, (np.tile(truth, runs), predictions.ravel()), 1)
    right = predictions == truth
    recall = np.array([right[:, truth == c].mean(axis=1) for c in range(len(CLASSES))])
    scores = {
        "accuracy": right.mean(axis=1),
        "macro_f1": recall.mean(axis=0) - 0.01,
        "balanced_accuracy": recall.mean(axis=0),
        "healthy_recall": recall[0],
        "auroc": 0.85 + 0.05 * skill + 0.005 * rng.standard_normal(runs),
        "auroc_micro": 0.86 + 0.05 * skill + 0.005 * rng.standard_normal(runs),
        "ece": 0.1 + 0.02 * rng.random(runs),
    }
    content: dict[str, Any] = {name: list(map(float, values)) for name, values in scores.items()}
    content["intervals"] = {
        name: [float(np.mean(values)) - 0.06, min(float(np.mean(values)) + 0.05, 1.0)]
        for name, values in scores.items()
    }
    content |= {
        "confusion": confusion.tolist(),
        "predictions": predictions.tolist(),
        "fault_protocol_known": True,
        "update_s": 60.0 * skill,
        "generate_s": 3.0,
        "generated": 3600,
        "train_s": 21.5,
        "predict_s": 0.0004,
    }
    return content, {"probabilities": probabilities.astype(np.float32)}


def _comparison(sources: dict[str, Any], a: str, b: str, metric: str) -> dict[str, Any]:
    difference = float(np.mean(sources[a][metric]) - np.mean(sources[b][metric]))
    few = len(sources[a][metric]) < 5
    width = 0.02 if metric == "auroc" else 0.08
    family = metric in ("macro_f1", "balanced_accuracy", "auroc")
    return {
        "a": a,
        "b": b,
        "metric": metric,
        "mean_diff": difference,
        "t": 7.86,
        "df": 16.55,
        "p": 0.0000123,
        "p_holm": 0.0000369 if family else None,
        "bootstrap_ci95": [difference - width, difference + width],
        "p_bootstrap": 0.0002,
        "p_verdict": None if few else 0.0006,
        "no_verdict": "few runs" if few else "",
    }


def _discrepancy(rng: np.random.Generator) -> dict[str, NDArray]:
    def draw(count: int) -> NDArray:
        slow = rng.random(count) < 0.3
        delay = np.where(slow, rng.normal(24, 4, count), rng.normal(11, 3, count))
        offset = rng.multivariate_normal([0.002, -0.001, -0.004], 1e-5 * np.eye(3), count)
        noise = 0.0003 * rng.gamma(4, 0.25, (count, 3))
        return np.column_stack([delay, offset, noise])

    observed = draw(240)
    observed[:9, 0], observed[:9, 1:4] = 180.0, 0.2  # missed segments
    observed[200:, 0] = np.nan  # not identified
    return {"z/ibg_rg/observed": observed, "z/ibg_rg/predicted": draw(4000)}


def _bands(rng: np.random.Generator) -> dict[str, NDArray]:
    """Two trajectories of 20 samples, one of them never measured at the end."""
    nominal = np.repeat(np.linspace(0, 0.2, 20)[None, :, None], 2, axis=0) * np.ones(3)
    spread = 0.004 * np.array([-1.64, -0.67, 0, 0.67, 1.64])[:, None, None]
    seen = np.ones((2, 20), dtype=bool)
    seen[1, 15:] = False
    shares = rng.dirichlet(np.full(20, 50))
    return {
        "pit/ibg_rg": np.stack([shares, np.full(20, 0.03), np.full(20, 0.07)]),
        "bands/ibg_rg/nominal": nominal,
        "bands/ibg_rg/observed": nominal + 0.004 * rng.standard_normal(nominal.shape),
        "bands/ibg_rg/seen": seen,
        "bands/ibg_rg/quantiles": nominal[:, None] + spread,
        "bands/ibg_rg/ids": np.array(["real_a/000", "real_a/001"]),
        "bands/ibg_rg/rate": np.array(10.0),
    }


def _fidelity() -> dict[str, Any]:
    def figure(value: float, low: float, high: float, p: float | None = None) -> dict[str, Any]:
        return {"value": value, "interval": [low, high], "p": p}

    figures = {
        "energy": figure(0.0112, 0.0091, 0.0144),
        "energy/mean_only": figure(0.0151, 0.0122, 0.0188),
        "energy_below/mean_only": figure(0.258, 0.191, 0.334),
        "coverage50": figure(0.482, 0.411, 0.553),
        "coverage90": figure(0.874, 0.822, 0.913),
        "coverage90_widened": figure(0.903, 0.861, 0.937),
        "pit": figure(0.061, 0.031, 0.112, 0.17),
        "auroc": figure(0.83, 0.71, 0.94),
        "ks/delay": figure(0.112, 0.052, 0.231, 0.41),
        "coverage90/delay": figure(0.873, 0.792, 0.941),
        "ks/noise_x": {"value": 0.98, "interval": None, "p": 0.05},
        "crps_below/mean_only": figure(0.237, 0.162, 0.318),
    }
    for name, crps in (("x", 0.0041), ("y", 0.0033), ("z", 0.0018)):
        figures[f"crps/{name}"] = figure(crps, 0.8 * crps, 1.3 * crps)
        figures[f"crps/{name}/mean_only"] = figure(1.3 * crps, crps, 1.7 * crps)
        figures[f"crps_below/{name}/mean_only"] = figure(0.231, 0.154, 0.312)
    return {
        "trajectories": 10,
        "draws": 200,
        "rate": 10.0,
        "outputs": ["x", "y", "z"],
        "units": ["m", "m", "m"],
        "movement": [
            "delay",
            *(f"{kind}_{axis}" for kind in ("offset", "noise") for axis in "xyz"),
        ],
        "movement_units": ["ms", *["m"] * 6],
        "movements": 48,
        "rivals": ["mean_only"],
        "widening": 1.31,
        "figures": figures,
    }


def _overlay(rng: np.random.Generator, n: int) -> dict[str, NDArray]:
    """n trajectories of 21 samples in 2 s with two segments; the last one was hardly measured."""
    nominal = np.linspace(0, 0.2, 21)[:, None] * np.array([1.0, -1.0, 0.5])
    observed = nominal + 0.004 * rng.standard_normal((n, 21, 3))
    observed[-1, 5:] = np.nan
    spread = 0.004 * np.array([-1.64, -0.67, 0, 0.67, 1.64])[:, None, None]
    times = np.array([[0.1, 0.7, 1.0], [1.0, 1.6, 2.0]])
    z = rng.normal(size=(n, 2, 2))
    z[0, 1, 0] = np.nan
    found = {
        "commands": np.linspace(400, 600, 21)[:, None] * np.ones((n, 1, 4)),
        "nominal": np.tile(nominal, (n, 1, 1)),
        "observed": observed,
        "bands": np.tile(nominal + spread, (n, 1, 1, 1)),
        "times": np.tile(times, (n, 1, 1)),
        "z": z,
        "deviation": np.where(np.isnan(z), np.nan, 0.25),
        "rate": np.array(10.0),
    }
    return {f"portrait/{name}": each.astype(np.float32) for name, each in found.items()}


def _poses(n: int) -> dict[str, NDArray]:
    """A chain of four points that bends for 2 s; every second one's tip is 10 mm off."""
    angle = np.linspace(0, 1, 21)[:, None] * np.arange(4)
    chain = 0.1 * np.stack([np.sin(angle), 0 * angle, np.cumsum(np.cos(angle), axis=1)], axis=2)
    nominal = np.tile(chain, (n, 1, 1, 1))
    observed = nominal.copy()
    observed[1::2, :, -1, 1] += 0.01
    return {
        "pose/nominal": nominal.astype(np.float32),
        "pose/observed": observed.astype(np.float32),
    }


def synthetic(*, runs: int = 10, per_class: int = 10) -> Study:
    """results.json and the arrays of a synthetic study."""
    rng = np.random.default_rng(7)
    truth = np.repeat(np.arange(len(CLASSES)), per_class)
    sources: dict[str, Any] = {}
    arrays = _discrepancy(rng) | _bands(rng)
    seen = {"dt": "none", "ibg": "timing", "ibg_rg": "healthy"}
    for name, skill in SKILL.items():
        content, made = _source(rng, truth, skill, runs)
        sources[name] = {**content, "real_data": seen[name], "twin_runs": 3600}
        arrays[f"probabilities/{name}"] = made["probabilities"]
    metrics = ("macro_f1", "balanced_accuracy", "auroc", "healthy_recall")
    pairs = (("ibg_rg", "dt"), ("ibg_rg", "ibg"), ("ibg", "dt"))
    results = {
        "schema": 1,
        "case": "armpi",
        "title": "ArmPi FPV robot arm",
        "preset": "quick",
        "classifier": "cnn",
        "runs": runs,
        "classes": CLASSES,
        "emulated": False,
        "data": {
            "twin": {"name": "sim.mat", "sha256": "a1" * 32, "n": 3600},
            "calibration": {
                "name": "real_a.mat",
                "sha256": "b2" * 32,
                "n": 90,
                "used": [f"real_a/{i:03d}" for i in range(10)],
            },
            "test": {
                "name": "real_a.mat",
                "sha256": "b2" * 32,
                "n": len(truth),
                "rate": 100.0,
                "ids": [f"real_a/{i:03d}" for i in range(len(truth))],
                "labels": [CLASSES[label] for label in truth],
            },
            "protocol": "3 folds: every trajectory is tested once",
        },
        "sources": sources,
        "published": PUBLISHED,
        "comparisons": [_comparison(sources, a, b, m) for a, b in pairs for m in metrics],
        "surrogate": {
            "rmse": {"x": 0.00042, "y": 0.00051, "z": 0.00038},
            "unit": "m",
            "nrmse": {"x": 0.004, "y": 0.0042, "z": 0.0051},
        },
        "fidelity": {"ibg_rg": _fidelity()},
        "inputs": {"names": [f"motor_{i}" for i in MOTORS], "units": ["0.24 deg"] * 4},
        "outputs": {"names": ["x", "y", "z"], "units": ["m"] * 3},
        "portrait": {
            "source": "ibg_rg",
            "movement": ["delay", "offset_motor_1"],
            "movement_units": ["ms", "0.24 deg"],
        },
        "learning_curve": [
            {
                "source": "ibg_rg",
                "healthy": count,
                "macro_f1": [score] * runs,
                "macro_f1_interval": [score - 0.1, score + 0.05],
                "healthy_recall": [score - 0.2] * runs,
                "healthy_recall_interval": None,
                "coverage90": score + 0.05,
                "coverage90_interval": [score - 0.1, score + 0.1],
            }
            for count, score in ((1, 0.612), (2, 0.704), (4, 0.771))
        ],
        "timing": {
            "seconds": {"surrogate": 48.2, "residual output": 33.0, "diagnosis ibg_rg": 412.5},
            "total_s": 1511.0,
        },
        "provenance": {
            "command": "retwin study armpi --twin-data sim.mat --real real_a.mat --folds 3 "
            "--sources dt,ibg,ibg_rg --classifier cnn --runs 10 --seed 0 --out runs/a",
            "retwin": "0.1.0",
            "python": "3.11.7",
            "torch": "2.13.0",
            "numpy": "2.4.6",
            "seed": 0,
            "date": "2026-01-01",
            "machine": "2 cores",
        },
    }
    arrays |= _overlay(rng, len(truth)) | _poses(len(truth))
    return results, arrays
