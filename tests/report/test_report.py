"""The report on synthetic studies: complete, self-contained, honest, and safe to open."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.report import write_report
from retwin.report.page import DOCS, FIGURES, render
from retwin.report.sections import sections_of
from retwin.report.study import read_study

Study = tuple[dict[str, Any], dict[str, NDArray]]
Write = Callable[[Study], Path]
LOADING = {"src", "href", "srcset", "action", "poster", "data", "xlink:href"}
PNG = b"\x89PNG\r\n\x1a\n"


class Reader(HTMLParser):
    """Visible text, elements and addresses of a page; scripts and styles are no text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text, self.ids, self.addresses, self.tags = "", [], [], []
        self.inside: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.inside.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in LOADING:
                self.addresses.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        while self.inside and self.inside.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if not {"script", "style"} & set(self.inside[-1:]):
            self.text += data


def page_of(folder: Path) -> str:
    study = read_study(folder)
    return render(study, sections_of(study))


def read(folder: Path) -> Reader:
    reader = Reader(page_of(folder))
    reader.text = re.sub(r"\s+", " ", reader.text)
    return reader


@pytest.mark.slow
def test_page_is_self_contained_and_figures_are_beside_it(study: Study, write: Write) -> None:
    folder = write(study)
    page = write_report(folder, figures=True)
    assert page.name == "report.html"
    assert page.stat().st_size <= 3e6
    text = page.read_text(encoding="utf-8")
    reader = Reader(text)
    assert reader.addresses
    assert all(each.startswith(("#", "data:", DOCS)) for each in reader.addresses)
    assert not {"link", "iframe", "object", "embed", "base"} & set(reader.tags)
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style
    assert "default-src 'none'" in text
    made = {path.stem: path.read_bytes() for path in (folder / "figures").glob("*.png")}
    simulated = {"simulation", "autocorrelation", "crosscorrelation", "spectra", "amplitude"}
    assert set(made) == set(FIGURES) - simulated - {"overtime", "delta", "z", "records"}
    assert all(each.startswith(PNG) for each in made.values())


@pytest.mark.slow
def test_same_results_give_same_bytes(study: Study, write: Write) -> None:
    folder = write(study)
    first = write_report(folder).read_bytes()
    assert write_report(folder).read_bytes() == first


def test_numbers(study: Study, write: Write) -> None:
    results, _ = study
    text = read(write(study)).text
    for name in ("dt", "ibg", "ibg_rg"):
        runs = np.array(results["sources"][name]["macro_f1"])
        assert f"{runs.mean():.3f} ± {runs.std(ddof=1):.3f}" in text
    assert "0.753 ± 0.026" in text  # the paper's
    assert "4–5 min" in text
    assert "7.86 (16.6)" in text
    assert "< 0.001" in text
    assert "0.420" in text  # surrogate RMSE in mm
    assert "Outside: 9 of 200;" in text  # unidentified delays are no observations
    assert "Outside: 9 of 240;" in text
    assert "real data: healthy only; fault protocol known" in text
    assert results["provenance"]["command"] in text
    assert "a1" * 32 in text
    for count in np.diag(results["sources"]["ibg_rg"]["confusion"]):
        assert str(count) in text
    assert "M4 bias" in text
    counts = np.array(results["sources"]["ibg_rg"]["confusion"])
    worst = (counts * (1 - np.eye(9, dtype=int))).max()
    assert f"{np.trace(counts)} of {counts.sum()} diagnoses are correct; the most" in text
    assert re.search(rf"the most frequent error is \S.* as \S.* \({worst}\)", text)


def test_every_section_begins_with_its_answer_in_figures(study: Study, write: Write) -> None:
    page = page_of(write(study))
    sections = re.findall(r'<section id="(\w+)">(.*?)</section>', page, re.DOTALL)
    assert len(sections) > 12
    for name, text in sections:
        first = re.match(
            r'.*?</h2><span>(.*?)</span></summary>|.*?<div class="verdict">\s*<p>(.*?)</p>',
            text,
            re.S,
        )
        assert first is not None, name
        plain = re.sub(r"<[^>]+>", "", first[1] or first[2])
        assert re.search(r"\d", plain), (name, plain)
        assert not plain.strip()[:1].islower(), (name, plain)


def test_many_sources_are_summarised(study: Study, write: Write) -> None:
    """Who beats whom as one table, and pairs with the plain and the updated twin only."""
    results, arrays = study
    for name in ("randomised", "pi_ls", "dann", "ibg_rg_command", "inversion"):
        results["sources"][name] = results["sources"]["ibg_rg"]
        arrays[f"probabilities/{name}"] = arrays["probabilities/ibg_rg"]
    given = results["comparisons"][0]
    interval = {"bootstrap_ci95": [0.1, 0.2], "mean_diff": 0.15, "metric": "macro_f1"}
    results["comparisons"] += [
        {**given, **interval, "a": "inversion", "b": "dann"},
        {**given, **interval, "a": "ibg_rg_command", "b": "dann"},
        {**given, **interval, "a": "ibg_rg_command", "b": "dt"},
    ]
    text = read(write(study)).text
    assert "Updated twin (command space) minus Domain-adversarial network" in text
    assert "Physics inversion minus Domain-adversarial network" not in text
    assert "Pairwise differences in macro-F1" in text
    assert text.count("On 90 test trajectories, training on the updated twin (command space)") == 1


def test_fidelity(study: Study, write: Write) -> None:
    reader = read(write(study))
    for given in (
        "4.10[3.28 to 5.33]",  # CRPS of x in mm
        "26[19 to 33]",  # the energy score, in percent below the mean alone
        "0.87 0.82 to 0.91",  # coverage of the 90 % band
        "widened × 1.31",
        "10 held-out healthy trajectories",
        "x, typical (real_a/000)",
        "z, worst (real_a/001)",
    ):
        assert given in reader.text.replace(" [", "["), given
    figures = study[0]["fidelity"]["ibg_rg"]["figures"]
    for name in ("auroc", "coverage90_widened"):
        del figures[name]
    text = read(write(study)).text
    assert "Too few trajectories to train a classifier" in text
    assert "widened" not in text


def test_delays_at_the_end_of_their_range_are_said(study: Study, write: Write) -> None:
    fidelity = study[0]["fidelity"]["ibg_rg"]
    for share, said in ((None, False), (0.0, False), (0.31, True)):
        fidelity["at_bound"] = share
        text = read(write(study)).text
        assert ("31 % of the delays inferred in calibration are at a bound" in text) == said


def test_two_sources_with_a_residual_model_have_figures_of_their_own(
    study: Study, write: Write
) -> None:
    results, arrays = study
    for part in ("sources", "fidelity"):
        results[part]["ibg_rg_command"] = results[part]["ibg_rg"]
    arrays |= {
        name.replace("ibg_rg", "ibg_rg_command"): each
        for name, each in arrays.items()
        if "/ibg_rg" in name
    }
    reader = read(write(study))
    names = ("tde", "tpe", "noise", "pit", "bands")
    assert {f"figure-{name}{more}" for name in names for more in ("", "-2")} <= set(reader.ids)
    assert len(reader.ids) == len(set(reader.ids))
    assert "Updated twin (command space)." in reader.text


def test_the_paper_item_by_item(study: Study, write: Write) -> None:
    """Table 1 and the figures, ours beside the paper's; each leads to a section that is there."""
    reader = read(write(study))
    for given in (
        "Table 1: macro-F1",
        "Figure 5: delay, KS distance – – – 0.11 (p 0.41)",
        "Section 5: 3600 trajectories in 8.5 h 4–5 min",
        "Figure 2 is repeated in the section",
    ):
        assert given in reader.text, given
    inside = [each[1:] for each in reader.addresses if each.startswith("#") and "=" not in each]
    assert set(inside) <= set(reader.ids)
    (write(study) / "arrays.npz").unlink()
    reader = read(write((study[0], {})))
    assert "Figure 4" in reader.text
    assert "#roc" not in reader.addresses


def test_the_model_card_knows_what_went_wrong(study: Study, write: Write) -> None:
    results, arrays = study
    answers = np.tile(np.eye(9)[np.repeat(np.arange(9), 10)], (2, 1, 1))
    answers[:, 3] = np.eye(9)[1]
    arrays["probabilities/ibg_rg"] = answers
    results["sources"]["ibg_rg"]["confusion"][8] = [60, 0, 0, 0, 0, 0, 0, 0, 40]
    results["sources"]["ibg_rg"]["notes"] = ["one chain did not mix"]
    results["sources"]["dt"]["notes"] = ["a command outside", "one chain did not mix"]
    reader = read(write(study))
    for given in (
        "motor_1 (deg)",
        "x (mm)",
        "2 s at 100 Hz; bands and plots at 10 Hz",
        "10 Healthy",
        "10 real trajectories",
        "Healthy M1 stuck real_a/003",
        "M4 bias recognised in 40% of the diagnoses of all runs",
        "Noise x generated and observed differ: KS distance 0.98, p 0.05",
        "Original twin; Updated twin (outputs): one chain did not mix",
        "Original twin: a command outside",
        "onset and sizes, unknown in the field",
    ):
        assert given in reader.text, given
    assert "#trajectory=real_a%2F003" in reader.addresses
    for name in [each for each in arrays if each.startswith("portrait/")]:
        del arrays[name]
    reader = read(write(study))
    assert "Healthy M1 stuck real_a/003" in reader.text
    assert "#trajectory=real_a%2F003" not in reader.addresses


def test_verdict_better(study: Study, write: Write) -> None:
    text = read(write(study)).text
    assert "training on the updated twin (outputs) is better than on the original twin" in text
    assert "so the residual model itself helps" in text


def test_verdict_follows_the_interval_and_not_the_sign(study: Study, write: Write) -> None:
    for each in study[0]["comparisons"]:
        each["bootstrap_ci95"] = [-0.01, each["mean_diff"] + 0.1]
    text = read(write(study)).text
    assert "cannot be distinguished from" in text
    assert "it is not shown that the residual model itself helps" in text
    assert "is better than" not in text
    assert "undecided" in text


def test_verdict_worse_whichever_way_the_pair_is_given(study: Study, write: Write) -> None:
    for each in study[0]["comparisons"]:
        # dt minus ibg_rg above zero: ibg_rg is worse
        each["a"], each["b"] = each["b"], each["a"]
        each["mean_diff"], each["bootstrap_ci95"] = 0.1, [0.05, 0.15]
    text = read(write(study)).text
    assert "training on the updated twin (outputs) is worse than on the original twin" in text
    assert "−0.150 to −0.050" in text


def test_better_needs_the_p_value_over_all_pairs(study: Study, write: Write) -> None:
    for each in study[0]["comparisons"]:
        each["p_verdict"] = 0.06
    text = read(write(study)).text
    assert "is better than" not in text
    assert "cannot be distinguished from" in text


def test_few_runs_get_no_verdict(single: Study, write: Write) -> None:
    text = read(write(single)).text
    assert "No verdict, since a verdict needs at least 5 runs." in text
    assert "which does not contain the randomness of training" in text
    assert "is better than" not in text


def test_intervals_without_runs_of_older_files_get_no_verdict(study: Study, write: Write) -> None:
    for each in study[0]["comparisons"]:
        for name in ("p_bootstrap", "p_verdict", "no_verdict"):
            del each[name]
    text = read(write(study)).text
    assert "a version whose intervals do not contain the runs" in text
    assert "is better than" not in text


@pytest.mark.parametrize("kind", ["transductive", "labelled"])
def test_a_source_on_other_data_is_not_called_ahead(study: Study, write: Write, kind: str) -> None:
    """The best source is named only among those that see the same kind of real data."""
    sources = study[0]["sources"]
    sources["ibg"]["macro_f1"] = [0.99] * 10
    row = next(
        each
        for each in study[0]["comparisons"]
        if (each["a"], each["b"], each["metric"]) == ("ibg_rg", "ibg", "macro_f1")
    )
    row["mean_diff"], row["bootstrap_ci95"] = -0.2, [-0.3, -0.1]
    assert "the surrogate alone is better than" in read(write(study)).text.replace(
        "Of the sources", ""
    )
    sources["ibg"]["real_data"] = kind
    assert "Of the sources that use comparable data" not in read(write(study)).text


def test_no_verdict_without_intervals(study: Study, write: Write) -> None:
    for each in study[0]["comparisons"]:
        each["bootstrap_ci95"] = None
    text = read(write(study)).text
    assert "is better than" not in text
    assert "Comparisons" in text


def test_emulated(study: Study, write: Write) -> None:
    folder = write(study)
    assert "emulated" not in read(folder).text.lower()
    study[0]["emulated"] = True
    text = read(write(study)).text
    assert "EMULATED data: no real measurements" in text
    assert text.count("EMULATED") == 1, "once, where it stays in sight"
    assert "none of these is an answer for a real machine" in text


def test_no_paper_columns_without_a_paper(study: Study, write: Write) -> None:
    study[0]["published"] = {}
    reader = read(write(study))
    assert "paper’s" not in reader.text
    assert "this study" not in reader.text
    assert "numeric paper" not in page_of(write(study))


def test_everything_is_escaped(study: Study, write: Write) -> None:
    results, arrays = study
    evil = "<script>alert(1)</script><img src=x>&\"'</title>"
    results["title"] = results["provenance"]["machine"] = results["data"]["twin"]["name"] = evil
    results["classes"] = [evil, *results["classes"][1:]]
    test = results["data"]["test"]
    test["labels"] = [evil if each == "Healthy" else each for each in test["labels"]]
    test["ids"][0] = results["data"]["calibration"]["used"][0] = evil
    results["sources"][evil] = results["sources"].pop("ibg")
    arrays[f"probabilities/{evil}".replace("/", "\\")] = arrays.pop("probabilities/ibg")
    results["published"]["dt"]["macro_f1"] = evil
    given = results["fidelity"]["ibg_rg"]
    given["movement"][0] = given["outputs"][0] = given["rivals"][0] = evil
    given["figures"][f"ks/{evil}"] = given["figures"].pop("ks/delay")
    results["portrait"]["movement"][0] = results["outputs"]["names"][0] = evil
    results["fidelity"][evil] = {**given, "movement": [evil]}
    arrays["bands/ibg_rg/ids"] = np.array([evil, evil])
    for each in results["comparisons"]:
        each["a"], each["b"] = (evil if each[k] == "ibg" else each[k] for k in "ab")
    page = write_report(write(study)).read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert "<img src=x>" not in page
    assert page.count("<script") == page.count("</script") == 5
    specs = re.search(r'<script type="application/json" id="specs">(.*?)</script>', page)
    assert specs is not None
    assert json.loads(specs[1])


@pytest.mark.parametrize(
    ("drop", "section"),
    [
        (["surrogate"], "surrogate"),
        (["comparisons"], "comparisons"),
        (["learning_curve"], "learning"),
    ],
)
def test_sections_without_data_disappear(
    study: Study, write: Write, drop: list[str], section: str
) -> None:
    for name in ("update_s", "generate_s", "twin_runs", "train_s", "predict_s"):
        for source in study[0]["sources"].values():
            del source[name]
    assert section in read(write(study)).ids
    for name in drop:
        del study[0][name]
    reader = read(write(study))
    assert section not in reader.ids
    assert f"#{section}" not in reader.addresses


@pytest.mark.slow
def test_without_arrays_and_stale_figures(study: Study, write: Write) -> None:
    folder = write(study)
    write_report(folder, figures=True)
    (folder / "arrays.npz").unlink()
    for name in ("tde-2", "mine"):
        (folder / "figures" / f"{name}.png").write_bytes(PNG)
    write_report(folder, figures=True)
    reader = read(folder)
    assert "roc" not in reader.ids
    assert "figure-tde" not in reader.ids
    assert "confusion" in reader.ids
    assert {path.stem for path in (folder / "figures").iterdir()} == {
        "scores",
        "confusion",
        "learning",
        "mine",
    }
    write_report(folder)
    assert [path.stem for path in (folder / "figures").iterdir()] == ["mine"]


def test_least_that_a_study_may_hold(write: Write) -> None:
    least = {"schema": 1, "case": "tanks", "runs": 2, "classes": []}
    least["sources"] = {"dt": {"rmse": [0.4, 0.5], "coverage90": [0.8, None]}}
    reader = read(write((least, {})))
    assert "0.450 ± 0.071" in reader.text
    assert "tanks" in reader.text
    assert not any(each and each.startswith("plot-") for each in reader.ids)


def test_one_run_has_no_band_and_no_spread(single: Study, write: Write) -> None:
    text = read(write(single)).text
    assert "no band" in text
    assert "One run; in brackets" in text


def test_unknown_source_and_missing_numbers(study: Study, write: Write) -> None:
    results, _ = study
    results["sources"]["something_new"] = {"macro_f1": [float("nan")] * 10, "intervals": None}
    results["comparisons"][0] |= {"t": float("nan"), "p": None, "bootstrap_ci95": [None, None]}
    text = read(write(study)).text
    assert "something_new" in text
    assert not re.search(r"\b(nan|None)\b", text)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "a folder with results.json"),
        ("{", "JSON"),
        ("[]", "schema None"),
        ('{"schema": 2}', "schema 2"),
        ('{"schema": 1, "case": "armpi", "runs": 1, "sources": {}}', "sources"),
        ('{"schema": 1, "case": "a", "runs": 1, "sources": {"dt": {"auroc": "x"}}}', "auroc"),
    ],
)
def test_bad_results(tmp_path: Path, content: str | None, message: str) -> None:
    if content is not None:
        (tmp_path / "results.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(message)):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_damaged_arrays(study: Study, write: Write) -> None:
    folder = write(study)
    (folder / "arrays.npz").write_bytes(b"PK no zip")
    with pytest.raises(InputError, match=r"arrays\.npz"):
        write_report(folder)


@pytest.mark.parametrize(
    "name",
    [
        "probabilities/dt",
        "z/ibg_rg/observed",
        "z/ibg_rg/predicted",
        "bands/ibg_rg/quantiles",
    ],
)
def test_arrays_that_do_not_fit(study: Study, write: Write, name: str) -> None:
    study[1][name] = study[1][name][..., :-1]
    with pytest.raises(InputError, match=name):
        write_report(write(study))


def test_report_needs_no_torch() -> None:
    code = "import sys, retwin.report.page; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
