"""Places to write to: refused before the work where the writing would fail after it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import retwin as rt
from retwin.errors import InputError
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place, in_use

LONG = "x" * 300


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    Path("empty").mkdir()
    Path("full").mkdir()
    (Path("full") / "other").touch()


NAMES = ["/", "", "file", "/proc/none", "file/a", LONG, f"a/{LONG}", "a\0b"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("folder", [False, True])
def test_what_cannot_be_written_is_refused_and_nothing_is_made(name: str, folder: bool) -> None:
    free = (name, folder) in (("file", False), ("", True))
    before = sorted(Path().rglob("*"))
    if free:
        check_place(name, folder=folder)
    else:
        with pytest.raises(InputError, match="path: expected a"):
            check_place(name, folder=folder)
    assert sorted(Path().rglob("*")) == before


@pytest.mark.parametrize("name", ["new", "a/new", "empty", "full", "x" * 230])
def test_a_folder_that_passes_is_written(name: str) -> None:
    check_place(name, folder=True, holds=("other", "more"))
    with write_atomically(name) as part:
        part.mkdir()
        (part / "other").touch()
        (part / "more").touch()
    with pytest.raises(InputError, match="also holds other; give another name"):
        check_place(name, folder=True, holds=("more",))


def test_devices_are_not_replaced() -> None:
    with pytest.raises(InputError, match="got /dev/null, which is none"):
        check_place("/dev/null")


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files")
@pytest.mark.parametrize("name", ["full.npz", "full.zarr"])
def test_a_full_disk_is_named(name: str) -> None:
    code = (
        "import resource, numpy as np, retwin as rt\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "noise = np.random.default_rng(0).normal(size=(10, 900, 1))\n"
        f"rt.save(rt.Trajectories(noise, noise, noise, 10.0), '{name}')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    message = done.stderr.strip().rpartition("\n")[2]
    assert (
        f"InputError: path: expected a place that can be written, got {Path(name).resolve()} ("
        in message
    )
    assert not Path(name).exists()


def test_what_another_process_has_made_meanwhile_stays() -> None:
    with (
        pytest.raises(InputError, match="new, which one writes to now"),
        write_atomically("new", folder=True, replace=False) as part,
    ):
        (part / "a").touch()
        Path("new").mkdir()
        (Path("new") / "b").touch()
    assert [each.name for each in Path("new").iterdir()] == ["b"]


def test_a_folder_may_hold_what_the_new_one_lacks_where_that_is_known() -> None:
    check_place("full", folder=True, holds=("new", "other"))
    for holds in ((), ("other",)):
        try:
            with write_atomically("full", folder=True, holds=holds) as part:
                (part / "new").touch()
        except InputError as error:
            assert not holds, error
    assert [each.name for each in Path("full").iterdir()] == ["new"]


def test_fit_may_replace_what_it_wrote(updated: rt.CorrectedTwin) -> None:
    updated.save("model")
    check_place("model", folder=True, holds=("model.json", "surrogate", "residual"))


def test_one_process_uses_a_folder_at_a_time() -> None:
    use = "from retwin.serialisation.places import in_use\nwith in_use('shared'): pass"

    def elsewhere() -> str:
        done = subprocess.run([sys.executable, "-c", use], capture_output=True, text=True)
        return done.stderr.strip().rpartition("\n")[2]

    with in_use("shared"):
        assert "got shared, which one writes to now; wait until it has ended" in elsewhere()
        assert Path("shared").is_dir()
    assert not Path("shared").exists(), "it is empty"
    assert elsewhere() == ""
    with in_use("full"):
        pass
    assert (Path("full") / "other").exists()
