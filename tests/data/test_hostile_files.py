"""Files that declare, or inflate to, more than there is memory or disk; and what is no file."""

from __future__ import annotations

import io
import json
import os
import resource
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from retwin import cases
from retwin.data.io import load, save
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import read_json
from retwin.serialisation.models import read_model
from retwin.serialisation.sizes import Budget, memory

FREE = 2**27
"""The free memory, or disk, that the tests pretend: 128 MiB, of which a share may be taken."""


@pytest.fixture(autouse=True)
def _little_room(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = "retwin.serialisation.sizes"
    monkeypatch.setattr(f"{sizes}.memory", lambda: (FREE, FREE))
    usage = type("Usage", (), {"free": FREE})
    monkeypatch.setattr(f"{sizes}.shutil.disk_usage", lambda _: usage)


@contextmanager
def little_memory() -> Iterator[None]:
    """At most 64 MiB more of memory for what the block allocates."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_DATA, (used + 2**26, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def refused(path: Path, match: str, **options) -> None:
    with little_memory(), pytest.raises(InputError, match=match) as caught:
        load(path, **options)
    assert "too little memory" not in str(caught.value), "it was allocated first"
    assert "\n" not in str(caught.value)


def element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def variable(kind: int, sizes: tuple[int, ...], *parts: bytes, name: bytes = b"X_array") -> bytes:
    head = element(6, struct.pack("<II", kind, 0)) + element(5, np.array(sizes, "<i4").tobytes())
    return element(14, head + element(1, name) + b"".join(parts))


def packed(variable: bytes) -> bytes:
    data = zlib.compress(variable, 9)
    return struct.pack("<II", 15, len(data)) + data


MAT = b"MATLAB".ljust(124) + b"\x00\x01IM"
ZEROS = 2**27
MATS: dict[str, Callable[[], bytes]] = {
    "inflates": lambda: packed(variable(6, (ZEROS // 8, 1), element(9, bytes(ZEROS)))),
    # One byte is stored of each number.
    "widens": lambda: variable(6, (2**24, 1), element(2, bytes(2**24))),
    "empty structs": lambda: variable(2, (10**9, 1), element(5, b"\1\0\0\0"), element(1, b"")),
    "letters": lambda: variable(4, (2**23, 1), element(16, b"a" * 2**23)),
    "cells": lambda: packed(variable(1, (2**20, 1), element(14, b"") * 2**20)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MATS)
def test_mat_files_that_grow(tmp_path: Path, name: str) -> None:
    file = tmp_path / "a.mat"
    file.write_bytes(MAT + MATS[name]())
    assert file.stat().st_size < 2**25
    refused(file, "a.mat: expected contents of at most 67.1 MB, 50% of the free memory", rate=1)


def test_a_compressed_variable_that_declares_less_than_it_holds(tmp_path: Path) -> None:
    file = tmp_path / "a.mat"
    file.write_bytes(MAT + packed(variable(6, (1, 1), element(9, bytes(8))) + bytes(ZEROS)))
    refused(file, "a.mat: expected (X_array with y_array|a readable MAT file)", rate=1)


def test_trajectories_that_are_padded_to_the_longest(tmp_path: Path) -> None:
    """All of them, which takes the product of the number and the greatest length."""
    cells = np.empty((1, 2000), object)
    cells[0, :] = [np.ones((2, 2))] * 1999 + [np.ones((10_000, 2))]
    names = np.empty((1, 2000), object)
    names[0, :] = ["a"] * 2000
    savemat(tmp_path / "a.mat", {"X_array": cells, "y_array": names})
    refused(tmp_path / "a.mat", "a.mat: expected contents of at most 67.1 MB", rate=1)


def some(n: int = 4) -> Trajectories:
    outputs = np.arange(n * 60.0).reshape(n, 20, 3)
    return Trajectories(np.zeros((n, 20, 2)), outputs, outputs, 10.0)


def npz(path: Path, name: str, entry: bytes, how: int = zipfile.ZIP_DEFLATED) -> None:
    """A sound file with another entry of that name."""
    save(some(), path)
    with zipfile.ZipFile(path) as archive:
        members = {each: archive.read(each) for each in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for each, data in (members | {name: entry}).items():
            archive.writestr(each, data, how)


def array_header(shape: tuple[int, ...]) -> bytes:
    buffer = io.BytesIO()
    about = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, about)
    return buffer.getvalue()


def test_npz_files_that_grow(tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    npz(file, "nominal.npy", array_header((4, 2**22, 1)) + bytes(2**27))
    assert file.stat().st_size < 2**20
    refused(file, "a.npz: expected contents of at most 67.1 MB")
    npz(file, "nominal.npy", array_header((10**9, 20, 3)))
    refused(file, "a.npz.*nominal of shape .*1000000000")
    # Of this kind a few bytes inflate to a megabyte before the first is read.
    npz(file, "nominal.npy", array_header((4, 20, 3)) + bytes(480), zipfile.ZIP_BZIP2)
    refused(file, "has no limit")
    npz(file, "header.npy", array_header((10**8,)) + b"[" * 10**5)
    refused(file, "a.npz")


def test_an_npz_file_with_a_hundred_thousand_entries(tmp_path: Path) -> None:
    """Of 5 MB; the list of its entries alone takes more memory than is free."""
    head = struct.pack("<4s6H3L5H2L", b"PK\1\2", 20, 20, *[0] * 3, 33, *[0] * 3, 1, *[0] * 6)
    entries = (head + b"a") * 10**5
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, len(entries), 0, 0)
    (tmp_path / "a.npz").write_bytes(entries + end)
    refused(tmp_path / "a.npz", "a.npz: expected contents of at most 67.1 MB")


def test_files_with_holes_that_are_larger_than_the_memory(tmp_path: Path) -> None:
    """They take no place on the disk, and one line of them is a whole file."""
    (tmp_path / "Healthy").mkdir()
    for name in ("Healthy/1.csv", "a.mat", "case.toml", "model.json"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(2**28)
    refused(tmp_path, "expected contents of at most 67.1 MB", rate=1)
    refused(tmp_path / "a.mat", "a.mat: expected contents of at most 67.1 MB", rate=1)
    for read, name in ((cases.get, "case.toml"), (read_json, "model.json")):
        with pytest.raises(InputError, match=r"contents of at most 67\.1 MB"):
            read(str(tmp_path / name))


def test_a_header_of_deep_json(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.frombuffer(b"[" * 10**5, np.uint8))
    npz(tmp_path / "a.npz", "header.npy", buffer.getvalue())
    refused(tmp_path / "a.npz", "nested too deeply")


def rewritten(file: Path, change: Callable[[dict], None]) -> None:
    stored = json.loads(file.read_text())
    change(stored)
    file.write_text(json.dumps(stored))


def test_a_zarr_folder_that_declares_more_than_the_disk_has(tmp_path: Path) -> None:
    folder = tmp_path / "a.zarr"
    save(some(), folder)
    for name in ("commands", "nominal", "observed", "mask"):
        width = 2 if name == "commands" else 3
        rewritten(folder / name / "zarr.json", lambda about, w=width: about.update(
            shape=[10**8, 20, w],
            chunk_grid={"name": "regular", "configuration": {"chunk_shape": [128, 20, w]}},
        ))  # fmt: skip
        rewritten(folder / "zarr.json", lambda about, n=name, w=width: about["attributes"][
            "retwin"]["arrays"][n].update(shape=[10**8, 20, w]))  # fmt: skip
    refused(folder, "a.zarr: expected contents of at most 121 MB, 90% of the free disk")


def test_a_zarr_folder_with_a_chunk_larger_than_the_memory(tmp_path: Path) -> None:
    folder = tmp_path / "a.zarr"
    save(some(), folder)
    shape = [4, 10**7, 3]
    rewritten(folder / "zarr.json", lambda about: about["attributes"]["retwin"]["arrays"][
        "nominal"].update(shape=shape))  # fmt: skip
    rewritten(folder / "nominal" / "zarr.json", lambda about: about.update(
        shape=shape, chunk_grid={"name": "regular", "configuration": {"chunk_shape": shape}},
    ))  # fmt: skip
    refused(folder, "a.zarr: nominal: expected contents of at most 67.1 MB")


def endless_frame(blocks: int) -> bytes:
    """A Zstandard frame without its size: blocks of 128 KiB of which one byte is stored."""
    block = ((2**17 << 3) | 2).to_bytes(3, "little") + b"\0"
    last = ((2**17 << 3) | 3).to_bytes(3, "little") + b"\0"
    return bytes.fromhex("28b52ffd0038") + block * (blocks - 1) + last


@pytest.mark.parametrize("frame", [endless_frame(4096), b"", b"\x28\xb5\x2f\xfd" + b"\xff" * 14])
def test_a_chunk_of_zarr_that_inflates(tmp_path: Path, frame: bytes) -> None:
    folder = tmp_path / "a.zarr"
    save(some(), folder)
    (chunk,) = [file for file in (folder / "nominal" / "c").rglob("*") if file.is_file()]
    chunk.write_bytes(frame)
    refused(folder, "a.zarr.*not one frame of 61440 bytes")


def test_a_chunk_of_zarr_by_another_codec(tmp_path: Path) -> None:
    folder = tmp_path / "a.zarr"
    save(some(), folder)
    packed = {"name": "gzip", "configuration": {"level": 9}}
    rewritten(folder / "nominal" / "zarr.json", lambda about: about["codecs"].append(packed))
    refused(folder, "packed by BytesCodec and ZstdCodec")


@pytest.mark.slow
def test_csv_files_that_are_too_large(tmp_path: Path) -> None:
    (tmp_path / "Healthy").mkdir()
    for name in ("1.csv", "2.csv"):
        (tmp_path / "Healthy" / name).write_bytes(b"1,2\n" * 2**21)
    # One of them alone is small enough.
    refused(tmp_path, "expected contents of at most 67.1 MB", rate=1)


def test_what_is_given_replaces_what_is_free(tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    save(some(), file)
    with pytest.raises(InputError, match=r"at most 1 kB, as given.*--max-bytes"):
        load(file, max_bytes=1000)
    assert len(load(file, max_bytes=100_000)) == 4
    for bad in (0, -1, 1.5):
        with pytest.raises(InputError, match="max_bytes: expected a whole number of at least 1"):
            load(file, max_bytes=bad)


@pytest.mark.parametrize("name", ["a.mat", "a.npz", "Healthy/a.csv", "Healthy/dataset_1.mat"])
def test_a_pipe_in_place_of_a_file_does_not_hang(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    os.mkfifo(file)
    with pytest.raises(InputError, match=r"a pipe|regular file"):
        load(tmp_path if "/" in name else file, rate=1)


@pytest.mark.parametrize("name", ["zarr.json", "nominal/zarr.json", "nominal/c/0/0/0"])
def test_a_pipe_in_a_zarr_folder_does_not_hang(tmp_path: Path, name: str) -> None:
    save(some(), tmp_path / "a.zarr")
    (tmp_path / "a.zarr" / name).unlink()
    os.mkfifo(tmp_path / "a.zarr" / name)
    with pytest.raises(InputError, match="regular file"):
        load(tmp_path / "a.zarr")


@pytest.mark.parametrize("name", ["model.json", "weights.safetensors"])
def test_a_pipe_in_a_model_folder_does_not_hang(tmp_path: Path, name: str) -> None:
    (tmp_path / "model.json").write_text('{"schema": 1, "kind": "surrogate"}')
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="regular file"):
        read_model(tmp_path, "surrogate")


def test_names_with_digits_that_are_no_numbers(tmp_path: Path) -> None:
    (tmp_path / "Healthy").mkdir()
    for name in ("²1.csv", "2.csv", "a٣.csv", "10.csv", "a.csv"):
        (tmp_path / "Healthy" / name).write_text("1,2\n3,4\n")
    ids = load(tmp_path, rate=1).ids.tolist()
    assert ids.index("Healthy/2") < ids.index("Healthy/10")
    assert len(ids) == 5


def test_json_that_is_too_deep_or_too_large(tmp_path: Path) -> None:
    (tmp_path / "model.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="nested too deeply"):
        read_json(tmp_path / "model.json")
    with pytest.raises(InputError, match="nested too deeply"):
        read_model(tmp_path, "surrogate")
    (tmp_path / "model.json").write_bytes(b" " * FREE)
    with pytest.raises(InputError, match=r"at most 67\.1 MB"):
        read_model(tmp_path, "surrogate")
    with (tmp_path / "weights.safetensors").open("wb") as file:
        file.truncate(2**40)
    (tmp_path / "model.json").write_text('{"schema": 1, "kind": "surrogate"}')
    with pytest.raises(InputError, match=r"weights\.safetensors: expected contents of at most"):
        read_model(tmp_path, "surrogate")


def test_a_budget_counts_all_that_is_taken(tmp_path: Path) -> None:
    budget = Budget("a")
    budget.take(FREE // 4)
    budget.take(FREE // 4)
    assert budget.left == 0
    with pytest.raises(InputError, match=r"a: expected contents of at most 67\.1 MB"):
        budget.take(1)
    Budget("a", disk=tmp_path / "not" / "yet").take(FREE * 8 // 10)


def test_the_memory_of_this_machine_is_known() -> None:
    total, free = memory()
    assert 0 < free <= total
