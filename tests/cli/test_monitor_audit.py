"""`retwin monitor audit`: what was changed in a store or a log is found."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest

from retwin.monitor import Registry, Store, export_log


@pytest.fixture
def store(tmp_path: Path) -> Path:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "model.json").write_text("{}")
    with Store(tmp_path / "store") as made:
        for number in range(5):
            made.commit(entries=[("alarm", {"asset": "line1", "time": number})])
        Registry(made, "tank").propose(tmp_path / "model", "the first one")
        export_log(made.log(), tmp_path / "log.jsonl")
    return tmp_path / "store"


def test_an_intact_store_gives_the_head_that_a_later_audit_finds_again(store, call) -> None:
    code, printed, err = call("monitor", "audit", store, "--json")
    found = json.loads(printed)
    assert (code, found["ok"], found["entries"], err) == (0, True, 6, "")
    with Store(store) as grown:
        grown.commit(entries=[("alarm", {"asset": "line1", "time": 9})])
    code, printed, _ = call("monitor", "audit", store, "--head", found["head"])
    assert (code, "7 entries are intact" in printed) == (0, True)
    code, _, err = call("monitor", "audit", store.parent / "log.jsonl", "--head", found["head"])
    assert (code, err) == (0, "")


def test_a_log_that_was_cut_off_or_edited_is_found(store, call) -> None:
    _, printed, _ = call("monitor", "audit", store, "--json")
    head = json.loads(printed)["head"]
    with sqlite3.connect(store / "monitor.sqlite") as database:
        database.execute("DELETE FROM retwin_log WHERE sequence = 5")
    assert call("monitor", "audit", store)[0] == 0, "only the head shows that"
    code, _, err = call("monitor", "audit", store, "--head", head)
    assert (code, "cut off" in err) == (2, True), err
    with sqlite3.connect(store / "monitor.sqlite") as database:
        database.execute("UPDATE retwin_log SET text = '{}' WHERE sequence = 2")
    code, printed, err = call("monitor", "audit", store, "--json")
    assert (code, json.loads(printed)["entries"]) == (2, 2)
    assert err.count("\n") == 1
    assert "entry 2" in err


def test_a_version_whose_files_were_changed_is_found(store, call) -> None:
    (file,) = (store / "versions").glob("*/model.json")
    file.write_text("[]")
    code, _, err = call("monitor", "audit", store)
    assert (code, "twin tank" in err and "version 1" in err) == (2, True), err


def test_what_is_no_store_and_no_head_is_refused(store, call, tmp_path) -> None:
    for words in ((store, "--head", "abc"), (tmp_path / "none",), (tmp_path / "model",)):
        code, printed, err = call("monitor", "audit", *words)
        assert (code, printed, err.count("\n")) == (2, "", 1), err
