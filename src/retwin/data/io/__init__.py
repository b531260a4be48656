"""File formats of trajectories: MAT, folders of CSV or MAT, NPZ and Zarr.

Belongs here: one file per format, validated while it is read. Not here: fitted models (see
`serialisation`). Pickle is used nowhere.
"""

from __future__ import annotations

import os
from numbers import Real
from pathlib import Path

import numpy as np

from retwin.data.io.assembly import DataCase, settle
from retwin.data.io.class_folders import read_class_folders
from retwin.data.io.mat import read_mat
from retwin.data.io.npz import read_npz, write_npz
from retwin.data.io.zarr_folder import read_zarr, write_zarr
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically

__all__ = ["DataCase", "check_target", "load", "save"]

WRITERS = {".npz": write_npz, ".zarr": write_zarr}


def load(
    path: str | os.PathLike[str],
    *,
    case: DataCase | None = None,
    rate: float | None = None,
    progress: Progress | None = None,
) -> Trajectories:
    """Trajectories from a file or folder; what the path is decides how it is read.

    | path | holds |
    |---|---|
    | `*.mat` | `X_array`, `y_array` or `X_test_array`, `y_test_array`: cells of (T, 2 d_y) |
    | folder with `ClassName/*.csv` | rows of nominal and observed, no header |
    | folder with `ClassName/dataset_*.mat` | the layout of the arm's authors |
    | `*.npz`, `*.zarr` | what `save` wrote |

    With a case, channels and rate are the case's and the labels must be classes of it; commands
    that the file does not hold are then completed by `case.complete`. Without a case, files that
    do not tell their sample rate need `rate` (Hz), and missing commands have width 0. Arrays keep
    their dtype; shorter trajectories are padded with mask False. NPZ and Zarr keep the provenance
    that was saved with them; the others get the file's name and SHA-256. `progress` is called with
    the share that is done.

    Raises
    ------
    InputError: anything about the data that is not as described, in one line.

    """
    path = Path(path)
    if rate is not None and not (isinstance(rate, Real) and np.isfinite(rate) and rate > 0):
        raise InputError(
            "rate",
            expected="a positive number of samples per second",
            got=repr(rate),
            remedy="give the sample rate in Hz",
        )
    if not path.exists():
        raise InputError(
            "path",
            expected="an existing file or folder",
            got=f"{path}, where there is none",
            remedy="check the name",
        )
    return settle(_read(path, case, rate, progress), case, progress)


def save(trajectories: Trajectories, path: str | os.PathLike[str]) -> None:
    """Write `trajectories` to a file `*.npz` or a folder `*.zarr`, whole or not at all.

    The same trajectories give the same bytes.

    Raises
    ------
    InputError: another suffix, a place that cannot be written, or Zarr without the extra `scale`.

    """
    write = WRITERS[check_target(path)]
    with write_atomically(path) as part:
        write(trajectories, part)


def check_target(path: str | os.PathLike[str]) -> str:
    """The suffix of `path` if `save` can write it, else an InputError: to ask before long work."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise InputError(
            "path",
            expected=f"a name that ends in {' or '.join(WRITERS)}",
            got=str(path),
            remedy="choose one of these formats by the name",
        )
    return suffix


def _read(
    path: Path, case: DataCase | None, rate: float | None, progress: Progress | None
) -> Trajectories:
    suffix = path.suffix.lower()
    if path.is_dir() and suffix != ".zarr" and not (path / "zarr.json").exists():
        return read_class_folders(path, case=case, rate=rate, progress=progress)
    if path.is_file() and suffix == ".mat":
        return read_mat(path, case=case, rate=rate)
    if path.is_dir():
        trajectories = read_zarr(path)
    elif suffix == ".npz":
        trajectories = read_npz(path)
    else:
        raise InputError(
            "path",
            expected="a file *.mat or *.npz, a folder *.zarr or one with a folder per class",
            got=str(path),
            remedy="convert the data to one of these",
        )
    if rate is not None and rate != trajectories.rate:
        raise InputError(
            "rate",
            expected=f"{trajectories.rate:g} Hz, as the file says",
            got=f"{rate:g} Hz",
            remedy="leave rate out",
        )
    return trajectories
