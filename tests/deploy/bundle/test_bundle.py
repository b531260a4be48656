"""What is saved is what is loaded, or it is refused in one line, whatever was put in its place."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import retwin as rt
from retwin.deploy.bundle.bundle import Bundle
from retwin.deploy.bundle.facts import Facts
from retwin.deploy.bundle.seal import SUMS, read_sealed, seal, verify_seal
from retwin.serialisation.files import sha256
from retwin.twins.commands.samplers import RampSampler

pytestmark = pytest.mark.slow

Call = Callable[..., tuple[int, str, str]]

BRIEF = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def files_of(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file())


@pytest.fixture
def copy(saved: Path, tmp_path: Path):
    """A fresh copy of the bundle at every call."""
    names = iter(range(10_000))

    def fresh() -> Path:
        return Path(shutil.copytree(saved, tmp_path / str(next(names))))

    return fresh


def test_a_loaded_bundle_says_and_does_the_same(
    bundle: Bundle, saved: Path, emulated: rt.Trajectories, case: rt.Case
) -> None:
    loaded = Bundle.load(saved)
    before, after = bundle.predict(emulated), loaded.predict(emulated)
    np.testing.assert_array_equal(before.probabilities, after.probabilities)
    np.testing.assert_array_equal(before.verdicts.scores, after.verdicts.scores)
    made, again = (each.generate(case, per_class=2, seed=3) for each in (bundle, loaded))
    np.testing.assert_array_equal(made.observed, again.observed)
    assert loaded.facts == bundle.facts
    assert loaded.facts.classes == case.classes
    assert loaded.provenance == bundle.provenance
    assert loaded.provenance["retwin"] == rt.__version__


def test_the_same_bundle_gives_the_same_bytes(bundle: Bundle, saved: Path, tmp_path: Path) -> None:
    bundle.save(tmp_path / "again")
    assert sha256(tmp_path / "again") == sha256(saved)


def test_it_is_small_and_holds_nothing_but_weights_and_json(saved: Path) -> None:
    files = files_of(saved)
    assert {file.name for file in files} == {"model.json", "weights.safetensors", SUMS}
    assert sum(file.stat().st_size for file in files) < 5e6


def test_the_seal_is_the_one_of_sha256sum(saved: Path) -> None:
    verify_seal(saved)
    subprocess.run(["sha256sum", "--check", "--strict", "--quiet", SUMS], cwd=saved, check=True)


def test_a_changed_byte_is_refused(copy, saved: Path) -> None:
    for file in files_of(saved):
        folder = copy()
        changed = folder / file.relative_to(saved)
        data = bytearray(changed.read_bytes())
        data[len(data) // 2] ^= 1
        changed.write_bytes(data)
        for use in (verify_seal, Bundle.load):
            with pytest.raises(rt.InputError, match=SUMS):
                use(folder)


def test_a_file_more_or_less_or_a_link_is_refused(copy) -> None:
    folder = copy()
    (folder / "more.json").write_text("{}")
    with pytest.raises(rt.InputError, match=r"more\.json.*not of the bundle"):
        verify_seal(folder)
    folder = copy()
    (folder / "twin" / "model.json").unlink()
    with pytest.raises(rt.InputError, match=r"twin/model\.json.*missing"):
        verify_seal(folder)
    folder = copy()
    (folder / "guard" / "model.json").rename(folder / ".elsewhere")
    (folder / "guard" / "model.json").symlink_to(folder / ".elsewhere")
    with pytest.raises(rt.InputError, match="a link"):
        verify_seal(folder)
    with pytest.raises(rt.InputError, match=SUMS):
        verify_seal(folder / "nowhere")


@pytest.mark.parametrize(("key", "value"), [("schema", 0), ("schema", 2), ("kind", "surrogate")])
def test_another_schema_or_kind_is_refused(copy, key: str, value: object) -> None:
    folder = copy()
    about = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps(about | {key: value}))
    seal(folder)
    with pytest.raises(rt.InputError, match="expected a bundle of schema 1"):
        Bundle.load(folder)


def refused_or_loaded(folder: Path) -> None:
    """Any folder at all: a bundle, or one line that says what is wrong."""
    try:
        assert isinstance(Bundle.load(folder), Bundle)
    except rt.InputError as error:
        assert "\n" not in str(error)


@BRIEF
@given(
    which=st.integers(0, 100),
    data=st.binary(max_size=200),
    begin=st.floats(0, 1),
    resealed=st.booleans(),
)
def test_overwritten_files(copy, which: int, data: bytes, begin: float, resealed: bool) -> None:
    folder = copy()
    files = files_of(folder)
    file = files[which % len(files)]
    whole = file.read_bytes()
    at = int(begin * len(whole))
    file.write_bytes(whole[:at] + data)  # cut short, with anything behind
    if resealed:
        seal(folder)
    refused_or_loaded(folder)


@BRIEF
@given(one=st.integers(0, 100), other=st.integers(0, 100))
def test_swapped_files(copy, one: int, other: int) -> None:
    folder = copy()
    files = [file for file in files_of(folder) if file.name != SUMS]
    a, b = files[one % len(files)], files[other % len(files)]
    kept = a.read_bytes()
    a.write_bytes(b.read_bytes())
    b.write_bytes(kept)
    seal(folder)
    refused_or_loaded(folder)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 99) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=5,
)


@BRIEF
@given(
    which=st.integers(0, 100),
    path=st.lists(st.integers(0, 100), min_size=1, max_size=4),
    value=VALUES,
)
def test_descriptions_that_say_anything(copy, which: int, path: list[int], value: object) -> None:
    """A value of a description, or of what is in it, replaced by another one."""
    folder = copy()
    files = sorted(folder.rglob("model.json"))
    file = files[which % len(files)]
    about = json.loads(file.read_text())
    holder, name = {"all": about}, "all"
    for step in path:
        inside = holder[name]
        if not (isinstance(inside, dict) and inside):
            break
        holder, name = inside, list(inside)[step % len(inside)]
    holder[name] = value
    file.write_text(json.dumps(about))
    seal(folder)
    refused_or_loaded(folder)


def test_what_it_names_is_not_run(
    copy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    """A case and a fault that are code: neither loading nor generating imports them."""
    (tmp_path / "evil.py").write_text("raise SystemExit('it ran')")
    monkeypatch.syspath_prepend(tmp_path)
    folder = copy()
    about = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps(about | {"case": "evil:case"}))
    seal(folder)
    assert Bundle.load(folder).facts.case == "evil:case"
    code, _, err = call("generate", folder, "--out", tmp_path / "made.npz")
    assert code == 2
    assert "give the case" in err
    faults = about["faults"] | {"Healthy": {"kind": "evil:Fault"}}
    (folder / "model.json").write_text(json.dumps(about | {"faults": faults}))
    seal(folder)
    with pytest.raises(rt.InputError, match="one of Stuck, ActuatorBias"):
        Bundle.load(folder)


def test_a_bundle_generates_without_its_case_where_it_can(bundle: Bundle) -> None:
    with pytest.raises(rt.InputError, match="give the case"):
        bundle.generate(per_class=1, seed=0)
    facts = Facts(
        case="mine",
        faults=bundle.facts.faults,
        sensor_rate=10.0,
        steps=200,
        max_segments=2,
        sampler=RampSampler((400.0,) * 4, (600.0,) * 4, 100.0, 2.0, 2, (0.6, 0.8, 1.0)),
    )
    about = json.loads(json.dumps(facts.about()))
    assert Facts.of(about) == facts
    alone = Bundle(bundle.twin, bundle.guard, Facts.of(about))
    assert len(alone.generate(per_class=1, seed=0)) == 9
    with pytest.raises(rt.InputError, match="one with a diagnoser"):
        alone.predict(rt.generate(bundle.twin, alone.case, per_class=1, seed=0))


def test_a_diagnoser_of_other_classes_is_refused(bundle: Bundle, case: rt.Case) -> None:
    kept = bundle.diagnoser.classes
    for other in (("a", "b"), kept[:1] * len(kept)):
        bundle.diagnoser.classes = other
        try:
            with pytest.raises(rt.InputError, match="one of the classes of armpi"):
                Bundle.of(case, bundle.twin, bundle.guard, bundle.diagnoser)
        finally:
            bundle.diagnoser.classes = kept


def test_a_diagnoser_that_returns_texts_is_refused(
    bundle: Bundle, emulated: rt.Trajectories, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = np.full((3, len(bundle.diagnoser.classes)), "Healthy")
    monkeypatch.setattr(bundle.diagnoser, "predict_proba", lambda some: texts[: len(some)])
    with pytest.raises(rt.InputError, match="expected probabilities of 9 classes, got <U7"):
        bundle.predict(emulated[:3])


def test_a_description_without_end_is_refused(copy) -> None:
    folder = copy()
    (folder / "model.json").write_text("[" * 100_000)
    seal(folder)
    with pytest.raises(rt.InputError, match=SUMS):
        read_sealed(folder, "bundle")


def test_the_commands(call: Call, bundle: Bundle, saved: Path, tmp_path: Path) -> None:
    code, out, err = call("bundle", "verify", saved)
    assert (code, err) == (0, "")
    assert "is whole" in out
    assert "armpi" in out
    printed = json.loads(call("bundle", "verify", saved, "--json")[1])
    assert printed.keys() == {
        *("folder", "kind", "bytes", "case", "schema", "steps", "movements", "sensor_rate"),
        "provenance",
    }
    code, out, err = call("generate", saved, "--per-class", 2, "--out", tmp_path / "made.npz")
    assert code == 0, err
    made = rt.load(tmp_path / "made.npz")
    rt.save(made.replace(observed=1.5 * made.observed), tmp_path / "scaled.npz")
    code, out, err = call(
        "diagnose", "predict", saved, tmp_path / "scaled.npz", "--out", tmp_path / "found.csv"
    )
    assert code == 0, err
    assert "outside" in out
    code, out, _ = call("diagnose", "predict", saved, tmp_path / "scaled.npz", "--json")
    printed = json.loads(out)
    assert printed.keys() == {"emulated", "remark", "trajectories", "scores"}
    assert len(printed["trajectories"]) == len(made)
    assert printed["trajectories"][0].keys() == {
        *("id", "diagnosis", "probability", "probabilities", "guard", "reason")
    }
    rows = (tmp_path / "found.csv").read_text().splitlines()
    assert rows[0].split(",")[:4] == ["trajectory", "diagnosis", "guard", "reason"]
    assert len(rows) == 1 + len(made)


def test_a_diagnoser_alone_names_what_it_cannot_diagnose(
    call: Call, bundle: Bundle, emulated: rt.Trajectories, tmp_path: Path
) -> None:
    rt.save(emulated[:7], tmp_path / "real.npz")
    broken = deepcopy(bundle.diagnoser)
    with torch.no_grad():
        next(broken.network.parameters()).fill_(np.nan)
    broken.save(tmp_path / "broken")
    words = ("diagnose", "predict", tmp_path / "broken", tmp_path / "real.npz")
    code, out, err = call(*words, "--out", tmp_path / "found.csv")
    assert (code, out) == (2, "")
    assert f"NaN for {emulated.ids[0]}, {emulated.ids[1]}" in " ".join(err.split())
    assert "and 2 more" in " ".join(err.split())
    assert not (tmp_path / "found.csv").exists()


@pytest.mark.slow
def test_a_bundle_is_made_of_what_was_fitted(
    call: Call, bundle: Bundle, emulated: rt.Trajectories, tmp_path: Path
) -> None:
    bundle.twin.save(tmp_path / "model")
    rt.save(emulated, tmp_path / "real.npz")
    words = ("bundle", "save", tmp_path / "model", tmp_path / "real.npz", "--seed", 3)
    code, _, err = call(*words, "--out", tmp_path / "bundle")
    assert code == 0, err
    made = Bundle.load(tmp_path / "bundle")
    assert made.diagnoser is None
    assert made.provenance["seed"] == 3
    assert made.provenance["data"][0]["name"].startswith("EmulatedArmPi")
    assert (
        made.guard.assess(made.twin.surrogate, emulated.with_label("Healthy")).max_score.max() <= 1
    )
