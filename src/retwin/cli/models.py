"""`retwin generate` and `evaluate`: trajectories, predictions and scores of an updated twin."""

from __future__ import annotations

import csv
from dataclasses import asdict
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from retwin.checks import require
from retwin.cli import options, reading
from retwin.cli.options import argument, leave_out, option
from retwin.cli.plans import Workers, carry_out
from retwin.cli.terminal import answer, bar, note, table
from retwin.data.io import check_target
from retwin.data.trajectories import Trajectories
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from retwin.evaluation.choice.scoring import ModelScore, ScoredPrediction
    from retwin.twins.twin import Twin


def generate(
    model: Annotated[Path, argument("MODEL", "Folder of a corrected twin, or of a bundle.")],
    out: Annotated[Path, option("FILE", "New *.npz, or *.zarr of any size; *.csv of bands.")],
    commands: Annotated[
        Path | None, option("FILE", "Simulate these commands, in place of drawn ones.")
    ] = None,
    bands: Annotated[
        bool, option("", "Write mean and 90 % band of --commands, also as *.png.", "--bands")
    ] = False,
    per_class: Annotated[int, option("N", "Trajectories per class.")] = 400,
    case: options.OtherCase = None,
    seed: options.Seed = 0,
    workers: Workers = None,
    warm_up: options.WarmUp = "",
    mapping: options.LogMapping = None,
) -> None:
    """Generate trajectories, or predictions of commands.

    A *.npz holds one class after the other; a *.zarr holds the classes in turn, with other draws,
    and is resumed after an interruption.
    """
    import retwin as rt

    possible = not bands or (commands is not None and out.suffix.lower() == ".csv")
    expected = "--commands FILE and --out FILE.csv"
    got = f"--commands {commands}, --out {out}"
    remedy = "bands are those of given commands"
    require(possible, "--bands", expected=expected, got=got, remedy=remedy)
    for text in reading.unstable_remarks(model):
        note(text)
    if bands:
        check_place(out)
        check_place(out.with_suffix(".png"))
        begin = options.seconds_of("--warm-up", warm_up or "free") or 0.0
        _write_bands(model, commands, out, case, seed, mapping, begin)  # type: ignore[arg-type]
        return
    leave_out({"--warm-up": warm_up or None}, "without --bands")
    kind = check_target(out)
    updated, system = reading.source_of(model, case)
    if commands is not None:
        records = reading.read_commands(commands, system, mapping=mapping)
        rt.save(updated.simulate(records.commands.astype(float), seed=seed), out)
        note(f"Wrote {len(records)} trajectories to {out}")
        return
    if kind == ".zarr" or workers is not None:
        n = per_class * len(system.faults)
        plan = rt.deploy.SimulationPlan(updated, system.sampler, seed, n, system.faults)
        carry_out(plan, out, "generate", workers=workers)
        return
    with bar("generate") as show:
        made = rt.generate(
            updated, system, per_class=per_class, seed=seed, progress=lambda s: show("", s)
        )
    rt.save(made, out)
    note(f"Wrote {len(made)} trajectories to {out}")


def _write_bands(
    model: Path,
    commands: Path,
    out: Path,
    case: str | None,
    seed: int,
    mapping: Path | None,
    begin: float,
) -> None:
    """Mean and quantiles of every sample of given commands, as a table and of one as a picture."""
    from retwin.evaluation import predict_records
    from retwin.report.choice.page import draw_prediction
    from retwin.report.figures.png import png

    updated, system = reading.source_of(model, case)
    records = reading.read_commands(commands, system, mapping=mapping)
    _note_start(updated, records, begin)
    found = predict_records(updated, records, started=begin, seed=seed)
    write_predictions(found, records, out)
    picture = png(draw_prediction(records, found.mean, found.deviation), emulated=records.emulated)
    with write_atomically(out.with_suffix(".png")) as part:
        part.write_bytes(picture)
    note(f"Wrote mean and 90 % bands of {len(records)} records to {out}")
    note(f"Wrote {out.with_suffix('.png')}, the first of them")


def write_predictions(found: ScoredPrediction, records: Trajectories, out: Path) -> None:
    """Write record, time, and of each output what was measured, mean, 5 % and 95 % quantile."""
    from retwin.update.forecast_errors import USUAL

    names = records.outputs.names
    heads = ("measured", "mean", "q05", "q95")
    low, high = (found.mean + sign * USUAL * found.deviation for sign in (-1, 1))
    measured = np.where(records.mask, records.observed.astype(float), np.nan)
    columns = np.stack([measured, found.mean, low, high], axis=3)
    with write_atomically(out) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["record", "time", *(f"{n}_{head}" for n in names for head in heads)])
        for i, identifier in enumerate(records.ids):
            for t in range(int(records.lengths[i])):
                cells = ["" if np.isnan(x) else f"{x:.9g}" for x in columns[i, t].ravel()]
                writer.writerow([identifier, f"{t / records.rate:.9g}", *cells])


def evaluate(
    model: options.Model,
    real: Annotated[list[Path], option("FILE", "Records it was not fitted to; may be repeated.")],
    horizon: options.Horizon = "free",
    warm_up: options.WarmUp = "",
    out: Annotated[Path | None, option("FILE", "CSV file of predictions with bands.")] = None,
    case: options.OtherCase = None,
    seed: options.Seed = 0,
    mapping: options.LogMapping = None,
    max_bytes: options.MaxBytes = None,
    as_json: options.Json = False,
) -> None:
    """Score an updated twin on other records."""
    from retwin.evaluation import predict_records, score_model

    ahead = options.seconds_of("--horizon", horizon)
    begin = options.seconds_of("--warm-up", warm_up or "free") or 0.0
    if out is not None:
        check_place(out)
    updated = reading.updated_twin(model)
    system = reading.system_of(updated, model, case)
    records = reading.read(real, system, part="test", max_bytes=max_bytes, mapping=mapping)
    if begin:
        _note_start(updated, records, begin)
    unstable = [] if ahead else reading.unstable_remarks(model)
    scores = score_model(
        updated, records, horizon=ahead, warm_up=begin, started=begin, twin=system.twin, seed=seed
    )
    if out is not None:
        found = predict_records(updated, records, horizon=ahead, started=begin, seed=seed)
        write_predictions(found, records, out)
    units = dict(zip(records.outputs.names, records.outputs.units, strict=True))
    rows = [
        (
            each.output,
            each.who if ahead is None or each.who != "twin" else "twin + last error",
            f"{each.rmse:.4g}",
            f"{each.crps:.4g}",
            f"{each.coverage:.0%}" if isfinite(each.coverage) else "–",
            f"{each.width:.4g}" if isfinite(each.width) else "–",
            units[each.output] if units[each.output] != "1" else "",
        )
        for each in sorted(scores, key=lambda each: records.outputs.names.index(each.output))
    ]
    known = ahead or begin or unstable
    begins = [] if known else _start_remarks(updated, records, scores, units, seed)
    heads = ("output", "who", "RMSE", "CRPS", "90 % band holds", "its width", "unit")
    how = "free simulation" if ahead is None else f"predictions {ahead:g} s ahead"
    count = f"{len(records)} record{'s' if len(records) > 1 else ''}"
    answer(
        {"scores": [asdict(each) for each in scores], "records": len(records)},
        f"{count}, {how}:",
        table(heads, rows, numbers=heads[2:6]),
        *unstable,
        *_verdict(scores, started=bool(begin)),
        *reading.fitted_remarks(model, records, "these are no scores of new ones"),
        *begins,
        as_json=as_json,
    )
    if out is not None:
        note(f"Wrote predictions to {out}")


def _note_start(model: Twin, records: Trajectories, begin: float) -> None:
    """Note where the simulations of a model begin that is not asked to infer that, or cannot."""
    from retwin.update.forecasts import unknown_starts

    if begin and not unknown_starts(model):
        note("Not inferred by --warm-up: this model starts alike in each record.")
    elif not begin and unknown_starts(model) and records.mask.any():
        note(
            "The model starts at the mean of its calibration records; --warm-up "
            f"{_begin_of(records):g}s infers the start of each record from its first measurements"
        )


def _begin_of(records: Trajectories) -> float:
    """A round time in s at the begin of records that is long enough to infer their starts."""
    from retwin.update.forecasts import BEGIN

    return float(f"{records.lengths.max() / records.rate / BEGIN:.1g}")


def _start_remarks(
    model: Twin, records: Trajectories, usual: list[ModelScore], units: dict[str, str], seed: int
) -> list[str]:
    """Outputs that are predicted much better from starts that the records themselves give."""
    from retwin.evaluation import score_model
    from retwin.update.forecasts import unknown_starts

    if not unknown_starts(model) or _foreign(usual):
        return []
    begin = _begin_of(records)
    if not records.mask[:, : round(begin * records.rate)].any(axis=(1, 2)).all():
        return []  # of some nothing was measured there
    better = score_model(model, records, warm_up=begin, started=begin, seed=seed)
    # Ratio of errors from which starts of records are named.
    found = [
        f"{b.rmse:.4g} in place of {a.rmse:.4g} {units[a.output]} ({a.output})"
        for a, b in zip((each for each in usual if each.who == "model"), better, strict=False)
        if b.rmse < 0.8 * a.rmse
    ]
    if not found:
        return []
    return [
        "Records begin in other states than the model, which starts at the mean of its calibration "
        f"records: with starts that their first {begin:g} s give, the RMSE after that time is "
        f"{', '.join(found)}. --warm-up {begin:g}s does so."
    ]


"""Ratio of errors from which starts of records are named."""
FOREIGN, NOTHING = 2.0, 0.05
"""Ratio of the error to the spread of a record from which, and share inside the band below which, a
record may be of another channel or machine."""
START = ", or begin in other states, which --warm-up infers"
"""What else may be the reason where starts are not inferred."""


def _foreign(scores: list[ModelScore]) -> list[str]:
    """Outputs that the model has nothing in common with."""
    spread = {each.output: each.rmse for each in scores if each.who == "mean"}
    return [
        each.output
        for each in scores
        if each.who == "model"
        and each.rmse > FOREIGN * spread.get(each.output, inf)
        and each.coverage < NOTHING
    ]


def _verdict(scores: list[ModelScore], *, started: bool = False, hardly: float = 0.02) -> list[str]:
    """What is better than the model, and whether its bands hold, in sentences.

    Parameters
    ----------
    hardly : float, default 0.02
        Part of an error by which an update must lower it, not to be called one of bands alone.

    """
    from retwin.scores.uses import COVERAGE
    from retwin.update.forecast_errors import LEVEL, USUAL

    own, foreign = {each.output: each for each in scores if each.who == "model"}, _foreign(scores)
    made = [
        f"{name}: the RMSE is over {FOREIGN:g} times the standard deviation of this record, and "
        "hardly a sample is in the band. Look first for another unit, another column, or another "
        "machine than that of the calibration; judge one that integrates some time ahead, by "
        "--horizon."
        for name in foreign
    ]
    words = {"twin": "the twin before its update", "mean": "the mean of the record itself"}
    words["hold"] = "the first sample" if scores[0].horizon is None else "the last measured sample"
    for each in (one for one in scores if one.output not in foreign):
        if each.who != "model":
            model = own[each.output]
            # A hundredth of an error by which another predictor must be better to be mentioned.
            if each.rmse < 0.99 * model.rmse:
                made.append(
                    f"{each.output}: {words[each.who]} is a better prediction, by RMSE: "
                    f"{each.rmse:.3g} in place of {model.rmse:.3g}."
                )
            elif each.who == "twin" and model.rmse > (1 - hardly) * each.rmse and not each.horizon:
                made.append(
                    f"{each.output}: the RMSE is that of {words['twin']} within {hardly:.0%}: the "
                    "update adds bands alone there."
                )
        elif each.coverage < COVERAGE[0]:
            text = f"{each.output}: the 90 % band holds {each.coverage:.0%} of these samples"
            ratio = each.rmse / max(each.width / 2 / USUAL, 1e-300)
            # Ratio of the error to that of the band from which on a machine differs from the
            # calibration.
            if ratio > 3.0:
                made.append(
                    f"{text}, and the RMSE is {ratio:.2g} times what it allows for: this is no "
                    "chance. The machine has changed, as by a fault, or works where the model "
                    f"does not hold{START * (not started)}."
                )
                continue
            if each.interval is None or each.interval[1] >= LEVEL:
                made.append(f"{text}{_describe_records(each)}")
                continue
            other = START * (not started)
            made.append(
                f"{text}: do not rely on it here. These records may be of another day{other}."
            )
    return made


def _describe_records(score: ModelScore) -> str:
    """In how many records a band holds too little where that may be chance, and what to do."""
    from retwin.report.labels import counted
    from retwin.update.forecast_errors import LEVEL

    shares = [each for each in score.shares if each is not None]
    few, rest = score.interval is None, len(score.shares) - len(shares)
    text = f": under {LEVEL:.0%} in {sum(each < LEVEL for each in shares)} of "
    text += f"{counted(len(shares), 'record')}, {min(shares):.0%} in the worst. "
    if rest:
        text += f"{rest} more had no band, outside of the range of the calibration or longer. "
    text += "Fewer than five records" if few else "Records that differ so much"
    return (
        f"{text} cannot show whether that is chance: give fit more records, of other days, and "
        "evaluate others again."
    )
