"""File formats of trajectories: MAT, folders of CSV or MAT, NPZ and Zarr.

Belongs here: one file per format, whose contents are validated while they are read. Not here:
fitted models (see `serialisation`). Pickle is used nowhere. To add a format, write a module with a
function that takes the arguments of `load` and add one entry to `catalog.FORMATS`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from retwin.catalog import FORMATS, LOGS, FormatEntry, resolve
from retwin.checks import ends_in, existing, instance
from retwin.data.io.assembly import DataCase, settle
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import recover, write_atomically
from retwin.serialisation.places import check_place
from retwin.times import sample_rate

if TYPE_CHECKING:
    from retwin.data.logs.mapping import Mapping

__all__ = ["DataCase", "check_target", "load", "save"]


def load(
    path: str | os.PathLike[str],
    *,
    case: DataCase | None = None,
    rate: float | None = None,
    progress: Progress | None = None,
    max_bytes: int | None = None,
    mapping: Mapping | str | os.PathLike[str] | None = None,
) -> Trajectories:
    """Trajectories from a file or folder, whose name decides how it is read.

    | path | holds |
    |---|---|
    | `*.mat` | `X_array`, `y_array` or `X_test_array`, `y_test_array`: cells of (T, 2 d_y) |
    | folder with `ClassName/*.csv` | rows of nominal and observed, no header |
    | folder with `ClassName/dataset_*.mat` | the layout of the arm's authors |
    | `*.npz`, `*.zarr` | what `save` wrote |
    | a log (`catalog.LOGS`), with a mapping | signals with times of their own: ROS bags, MCAP, \
    Parquet, Arrow, TDMS, MDF, CSV |

    Parameters
    ----------
    path : path
        A file or folder of one of the formats in `catalog.FORMATS`.
    case : DataCase
        Sets channels and sample rate, restricts the labels to its classes, and completes commands
        that the file does not hold. Without a case, missing commands have width 0.
    rate : float
        Sample rate in Hz, needed without a case if the file does not hold it.
    progress : callable
        Called with the share that is done, from 0 to 1.
    max_bytes : int
        The largest size of all that is read, as the file declares it; by default half of the free
        memory, and for Zarr nine tenths of the free disk, to which its arrays are copied.
    mapping : Mapping or path
        For a log: its signals as channels, their resampling, and what starts a trajectory; a
        `data.Mapping`, or a file mapping.toml, which `retwin data map` writes.

    Returns
    -------
    Trajectories
        Arrays keep their dtype. Shorter trajectories are padded with mask False. NPZ and Zarr keep
        the provenance that was saved with them; other formats get the file's name and SHA-256. That
        of a log also says how each channel was resampled and how much of it is missing.

    Raises
    ------
    InputError
        There is no such file, its contents are not as described, or they are too large.

    """
    path = recover(path)
    if rate is not None:
        rate = sample_rate("rate", rate)
    existing("path", path, os.path.exists(path))
    if mapping is not None:
        from retwin.data.logs.mapped import read_mapped

        found = read_mapped(
            path, mapping, case=case, rate=rate, progress=progress, max_bytes=max_bytes
        )
        return settle(found, case, None, progress)
    read = resolve(_format(path).reader)
    found = read(path, case=case, rate=rate, progress=progress, max_bytes=max_bytes)
    return settle(found, case, rate, progress)


def save(trajectories: Trajectories, path: str | os.PathLike[str]) -> None:
    """Write `trajectories` to a file `*.npz` or a folder `*.zarr`, whole or not at all.

    The same trajectories give the same bytes.

    Raises
    ------
    InputError
        No trajectories, another suffix, the place cannot be written, or the extra `scale`, which
        Zarr needs, is missing.

    """
    instance("trajectories", trajectories, Trajectories, remedy="models have a method save")
    write = resolve(FORMATS[check_target(path)].writer)
    with write_atomically(path) as part:
        write(trajectories, part)


def check_target(path: str | os.PathLike[str]) -> str:
    """The suffix of `path`, to be checked before long work.

    Raises
    ------
    InputError
        `save` cannot write a file of that suffix, or not there.

    """
    suffix = Path(path).suffix.lower()
    writable = [name for name, entry in FORMATS.items() if entry.writer]
    ends_in("path", path, writable, remedy="choose one of these formats by the name")
    folder = FORMATS[suffix].folder
    replaced = folder and (Path(path) / "zarr.json").is_file()
    check_place(path, folder=folder, holds=None if replaced else ())
    return suffix


def _format(path: Path) -> FormatEntry:
    """The format of what is at `path`; a Zarr folder may have any name."""
    folder = path.is_dir()
    entry = FORMATS.get(path.suffix.lower())
    regular = folder or path.is_file()  # a pipe may never end
    if entry is not None and entry.folder == folder and path.suffix and regular:
        return entry
    if (folder and (path / "metadata.yaml").is_file()) or (
        regular and not folder and path.suffix and path.suffix.lower() in LOGS
    ):
        expected = f"what the signals of {path.name}, a log, stand for"
        remedy = f"make one: retwin data map {path.name} --out mapping.toml; then give mapping "
        remedy += "(--mapping)"
        raise InputError("mapping", expected=expected, got="none", remedy=remedy)
    if folder:
        return FORMATS[".zarr" if (path / "zarr.json").exists() else ""]
    files, folders = (
        " or ".join(f"*{name}" for name, each in FORMATS.items() if name and each.folder is kind)
        for kind in (False, True)
    )
    expected = f"a file {files}, a folder {folders} or one with a folder per class"
    got = str(path) if regular else f"{path}, a pipe or a device"
    raise InputError("path", expected=expected, got=got, remedy="convert the data to one of these")
