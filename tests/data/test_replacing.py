"""Replacing files and folders, killed at every step: the old contents or the new are there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from retwin.serialisation import files
from retwin.serialisation.files import recover, write_atomically
from retwin.serialisation.models import kind_of, read_model

SCRIPT = """
import os, signal, sys
from pathlib import Path
from retwin.serialisation import files

target, step, exchange = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "exchange"
if not exchange:
    files._exchange = lambda *_: False
steps = 0


def killed_before(function):
    def call(*given, **options):
        global steps
        steps += 1
        if steps == step:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*given, **options)

    return call


for place, name in (
    (os, "replace"), (files.shutil, "rmtree"), (files, "_exchange"), (files, "_remove"),
):
    setattr(place, name, killed_before(getattr(place, name)))
with files.write_atomically(target) as part:
    if target.suffix:
        part.write_text("new")
    else:
        part.mkdir()
        (part / "model.json").write_text('{"schema": 1, "kind": "new"}')
"""


def replace(target: Path, step: int, how: str) -> int:
    words = [sys.executable, "-c", SCRIPT, str(target), str(step), how]
    return subprocess.run(words, check=False).returncode


@pytest.mark.parametrize("how", ["exchange", "two renames"])
def test_a_folder_that_is_replaced_is_never_gone(tmp_path: Path, how: str) -> None:
    target, seen = tmp_path / "model", set()
    for step in range(1, 9):
        with write_atomically(target) as part:
            part.mkdir()
            (part / "model.json").write_text('{"schema": 1, "kind": "old"}')
        code = replace(target, step, how)
        gone = not target.exists()
        assert not (gone and how == "exchange")
        kind = kind_of(target)  # the first reader puts it back
        assert kind in ("old", "new")
        assert read_model(target, kind)[0]["kind"] == kind
        seen.add((code, gone))
        files._sweep.cache_clear()  # as in a new process
    assert (-signal.SIGKILL, False) in seen
    assert (0, False) in seen
    assert ((-signal.SIGKILL, True) in seen) == (how == "two renames")
    assert os.listdir(tmp_path) == ["model"], "the last writer removes what the others left"


def test_the_next_writer_puts_a_folder_back_too(tmp_path: Path) -> None:
    target = tmp_path / "model"
    for text in ("old", "new"):
        (tmp_path / f"x{text}").mkdir()
        (tmp_path / f"x{text}" / "model.json").write_text(text)
    former = tmp_path / f"{files._beginning(target)}{ended()}-00000000-0{files.FORMER}"
    (tmp_path / "xold").rename(former)
    with pytest.raises(ZeroDivisionError), write_atomically(target) as part:
        part.mkdir()
        raise ZeroDivisionError
    assert (target / "model.json").read_text() == "old"
    assert not former.exists()
    (tmp_path / "xnew").rename(former)  # both are there: the writer had not removed the former
    assert (recover(target) / "model.json").read_text() == "old"
    with write_atomically(target) as part:
        part.mkdir()
        (part / "model.json").write_text("newest")
    assert os.listdir(tmp_path) == ["model"]


def ended() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_leftovers_of_dead_processes_are_swept_and_no_others(tmp_path: Path) -> None:
    target = tmp_path / "c.npz"
    begin, dead = files._beginning(target), ended()
    other = files._beginning(tmp_path / "d")
    gone = [f"{begin}{dead}-0123abcd-0.npz", f"{other}{dead}-0123abcd-7"]
    # This number, but of a process before it, as in a container that began anew.
    gone.append(f"{begin}{os.getpid()}-00000000-0.npz")
    kept = [
        f"{begin}{os.getpid()}-{files.TOKEN}-99999.npz",  # this process, in another thread
        f"{begin}{os.getppid()}-0123abcd-0.npz",
        f"{other}{dead}-0123abcd-7{files.FORMER}",  # the only copy of another folder
        f".c-01234567-{dead}-0123abcd-0.npz",  # of another machine
        ".c-notes.npz",
        "c-1.npz",
    ]
    for name in (*gone, *kept):
        (tmp_path / name).touch()
    files._sweep.cache_clear()
    with write_atomically(target) as part:
        part.write_text("x")
    assert sorted(os.listdir(tmp_path)) == sorted(["c.npz", *kept])


def test_a_long_name_has_room_for_its_temporary_name(tmp_path: Path) -> None:
    target = tmp_path / ("ä" * 120 + ".json")
    with write_atomically(target) as part:
        part.write_text("x")
    assert os.listdir(tmp_path) == [target.name]


def test_what_is_written_has_the_rights_of_the_folder(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from retwin.serialisation.models import write_model

    before = os.umask(0o022)
    try:
        with write_model(tmp_path / "model", "surrogate", {}, {"a": torch.ones(3)}):
            pass
    finally:
        os.umask(before)
    rights = {file.name: file.stat().st_mode & 0o777 for file in (tmp_path / "model").iterdir()}
    assert rights == {"model.json": 0o644, "weights.safetensors": 0o644}
