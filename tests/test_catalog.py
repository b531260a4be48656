"""The catalog: an entry is all that an implementation needs beside its own module."""

from __future__ import annotations

import json
import sys
from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from retwin.catalog import (
    CLASSIFIERS,
    CORRECTIONS,
    DENSITIES,
    DIAGNOSERS,
    DOWNLOADS,
    FORMATS,
    NETWORKS,
    SOURCES,
    Entry,
    FormatEntry,
    classes,
    lookup,
    make,
    resolve,
)
from retwin.data.io import load, save
from retwin.data.trajectories import Trajectories
from retwin.diagnosis import fit_diagnoser, load_diagnoser
from retwin.diagnosis.diagnoser import TrainingTask
from retwin.errors import InputError
from retwin.nets.networks import Network
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model


def example() -> Trajectories:
    values = np.arange(12.0).reshape(2, 3, 2)
    return Trajectories(values, values, values + 1, rate=10.0)


@pytest.fixture
def text_format(monkeypatch: pytest.MonkeyPatch) -> None:
    """A format of text files, in a module and an entry of its own."""

    def read(path: Path, *, rate: float | None, **_: Any) -> Trajectories:
        values = np.loadtxt(path, ndmin=2)[None]
        return Trajectories(values[..., :0], values, values, rate=rate or 1.0)

    def write(trajectories: Trajectories, path: Path) -> None:
        np.savetxt(path, trajectories.observed[0])

    module = ModuleType("text_format")
    module.read, module.write = read, write  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "text_format", module)
    entry = FormatEntry("numbers as text", "text_format:read", "text_format:write")
    monkeypatch.setitem(FORMATS, ".txt", entry)  # type: ignore[arg-type]


@pytest.mark.usefixtures("text_format")
def test_a_new_format_is_one_module_and_one_entry(tmp_path: Path) -> None:
    save(example(), tmp_path / "a.txt")
    again = load(tmp_path / "a.txt", rate=5.0)
    np.testing.assert_array_equal(again.observed[0], example().observed[0])
    assert again.rate == 5.0
    with pytest.raises(InputError, match=r"ends in \.npz or \.zarr or \.txt"):
        save(example(), tmp_path / "a.csv")
    (tmp_path / "a.dat").touch()
    with pytest.raises(InputError, match=r"a file \*\.mat or \*\.npz or \*\.txt, a folder"):
        load(tmp_path / "a.dat")


@pytest.mark.parametrize(
    ("entries", "name"),
    [
        *((CORRECTIONS, name) for name in CORRECTIONS),
        *((DENSITIES, name) for name in DENSITIES),
        *((NETWORKS, name) for name in NETWORKS),
        *((CLASSIFIERS, name) for name in CLASSIFIERS),
    ],
)
def test_what_an_entry_makes_survives_a_saved_model(
    entries: Mapping[str, Entry], name: str
) -> None:
    kinds = (*classes(entries), *classes(NETWORKS))
    made = make(entries, name, "name")
    assert from_config(json.loads(json.dumps(to_config(made, kinds))), kinds) == made


def test_a_new_correction_is_one_class_and_one_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class Scaled:
        factor: float = 1.0

    module = ModuleType("scaled")
    module.Scaled = Scaled  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "scaled", module)
    monkeypatch.setitem(CORRECTIONS, "scaled", Entry("scaled:Scaled", "a factor"))  # type: ignore[arg-type]
    assert classes(CORRECTIONS)[-1] is Scaled
    assert classes(CORRECTIONS, ABC) == ()


@dataclass(frozen=True)
class Frequencies:
    """A kind of diagnoser: the shares of the classes in the training set."""

    adapts: ClassVar[bool] = False

    def fit(self, task: TrainingTask) -> Prior:
        classes, counts = np.unique(task.trajectories.labels, return_counts=True)
        return Prior(tuple(classes.tolist()), tuple((counts / counts.sum()).tolist()))


@dataclass(frozen=True)
class Prior:
    classes: tuple[str, ...]
    shares: tuple[float, ...]
    fitted: None = None

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        return np.tile(self.shares, (len(trajectories), 1))

    def save(self, folder: Path) -> None:
        with write_model(folder, "prior", {"classes": self.classes, "shares": self.shares}, {}):
            pass

    @classmethod
    def load(cls, folder: Path) -> Prior:
        about, _ = read_model(folder, "prior")
        return cls(tuple(about["classes"]), tuple(about["shares"]))


def test_a_new_kind_of_diagnoser_is_one_module_and_one_entry(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    entry = Entry(f"{__name__}:Prior", "shares of classes")
    monkeypatch.setitem(DIAGNOSERS, "prior", entry)  # type: ignore[arg-type]
    made = example().replace(labels=np.array(["a", "b"]))
    diagnoser = fit_diagnoser(made, Frequencies(), seed=0)
    diagnoser.save(tmp_path / "prior")
    assert load_diagnoser(tmp_path / "prior") == diagnoser == Prior(("a", "b"), (0.5, 0.5))
    with pytest.raises(InputError, match="target: expected none for Frequencies"):
        fit_diagnoser(made, Frequencies(), target=made, seed=0)


def test_a_classifier_without_a_network_is_no_network() -> None:
    names = [kind.__name__ for kind in classes(CLASSIFIERS, Network)]
    assert names == ["CNN", "LSTMClassifier"]


def test_an_entry_is_found_by_its_name() -> None:
    assert lookup(CORRECTIONS, "additive", "correction") is CORRECTIONS["additive"]
    with pytest.raises(InputError, match=r"correction: expected one of additive, .* got 'warped'"):
        lookup(CORRECTIONS, "warped", "correction")
    with pytest.raises(InputError, match="got 3"):
        make(CORRECTIONS, 3, "correction")  # type: ignore[arg-type]


def test_a_target_is_imported_when_it_is_resolved() -> None:
    assert resolve("math:pi") == pytest.approx(np.pi)
    assert make({"empty": Entry("builtins:dict", "an empty table")}, "empty", "kind") == {}
    with pytest.raises(ImportError):
        resolve("no_such_module:thing")
    with pytest.raises(AttributeError):
        resolve("math:no_such_number")


def test_every_source_has_one_implementation_and_known_parts() -> None:
    for name, source in SOURCES.items():
        given = [source.twin, source.diagnoser, *[" ".join(source.pool)]]
        assert sum(map(bool, given)) == 1, name
        assert set(source.pool) <= set(SOURCES), name


def test_every_download_states_address_and_digest() -> None:
    for public in DOWNLOADS.values():
        assert public.url.startswith("https://")
        assert len(bytes.fromhex(public.sha256)) == 32


def test_a_format_without_a_writer_is_only_read() -> None:
    with pytest.raises(InputError, match=r"ends in \.npz or \.zarr, got .*\.mat"):
        save(example(), "a.mat")
