"""Public data files: downloaded once, checked against their SHA-256, kept in a cache."""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from pathlib import Path

from retwin.catalog import DOWNLOADS, PublicFile
from retwin.checks import needs_extra, require
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import sha256 as sha256_of
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place
from retwin.serialisation.sizes import Budget

CACHE_VARIABLE = "RETWIN_CACHE"
"""The environment variable that names the cache folder."""
MAX_SECONDS = 3600.0
"""Seconds after which a download fails that is not complete, however slowly it goes on."""
MAX_BYTES = 2**32
"""The largest size of a file, unless another is given: no server can fill the disk."""
BYTES_PER_BLOCK = 64 * 1024
"""Bytes that are received and written together."""


def fetch(
    name: str,
    *,
    folder: str | os.PathLike[str] | None = None,
    url: str | None = None,
    sha256: str | None = None,
    progress: Progress | None = None,
    max_bytes: int = MAX_BYTES,
) -> Path:
    """The path of a public file, downloaded if it is not in the cache.

    The file is in the cache under the name that the catalog states, so that the cache can serve as
    RETWIN_DATA. A cached file whose SHA-256 is wrong is downloaded again.

    Parameters
    ----------
    name : str
        A name of `catalog.DOWNLOADS`, or any file name if `url` and `sha256` are given.
    folder : path
        The cache; by default the environment variable RETWIN_CACHE, else the user's cache folder.
    url : str
        Another address of the file; its SHA-256 stays that of the catalog.
    sha256 : str
        Another SHA-256, in hexadecimal.
    progress : callable
        Called with the share that is done, from 0 to 1.
    max_bytes : int
        The largest size of the file; by default 4 GiB.

    Raises
    ------
    InputError
        The name is unknown and has no `url` and `sha256`, the address is not http(s), the file is
        larger than `max_bytes`, or the extra `fetch` is missing.
    OSError
        There is no network or no such file, it did not come within an hour, or the folder cannot
        be written.
    RuntimeError
        The downloaded file has another SHA-256; nothing of it is kept.

    """
    known = _find_file(name, url, sha256)
    fits = known.url.startswith(("http://", "https://"))
    expected = "an address that begins with https:// or http://"
    require(fits, "url", expected=expected, got=known.url, remedy="give the address of the file")
    place = Path(folder) if folder else cache_folder()
    target = place / known.file
    if os.path.isfile(target) and sha256_of(target) == known.sha256:
        return target
    check_place(target)
    needs_extra("requests", "fetch", "downloads public files")
    try:
        with write_atomically(target) as part:
            _download(Transfer(known.url, part, Budget(name, max_bytes)), progress)
            if sha256_of(part) != known.sha256:
                raise RuntimeError(
                    f"fetch {name}: what {known.url} gave does not have the SHA-256 "
                    f"{known.sha256}, so it was thrown away; try again, or give another url"
                )
    except OSError as error:
        reason = " ".join(str(error).split())[:200]
        raise OSError(
            f"fetch {name}: cannot get {known.url} into {place} ({reason}); check the network, or "
            f"put the file there by hand as {known.file}"
        ) from None
    finally:
        if target.parent != place:  # the folder of one file below the cache
            with suppress(OSError):  # it is not empty, or does not exist
                target.parent.rmdir()
    return target


def cache_folder() -> Path:
    """The folder of downloaded files: RETWIN_CACHE, else the user's cache folder."""
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given)
    # Imported late: it takes half a second, and only downloads need it.
    pooch = needs_extra("pooch", "fetch", "downloads public files")
    return Path(pooch.os_cache("retwin"))


def _find_file(name: str, url: str | None, sha256: str | None) -> PublicFile:
    """The entry of the catalog with the caller's changes, or an entry of the caller's own."""
    known = DOWNLOADS.get(name)
    if known is not None:
        return PublicFile(url or known.url, sha256 or known.sha256, known.file)
    plain = Path(name).name == name and name not in ("", ".", "..")
    if url is None or sha256 is None or not plain:
        expected = f"one of {', '.join(sorted(DOWNLOADS))}"
        remedy = "choose one of these, or give a file name with its url and sha256"
        raise InputError("name", expected=expected, got=repr(name), remedy=remedy)
    return PublicFile(url, sha256, name)


def _download(transfer: Transfer, progress: Progress | None) -> None:
    """Wait for a transfer, for `MAX_SECONDS` at most."""
    deadline = time.monotonic() + MAX_SECONDS
    transfer.start()
    try:
        while transfer.is_alive():
            # Time between two looks at the transfer.
            transfer.join(0.1)
            if progress is not None and transfer.share:
                progress(transfer.share)
            if time.monotonic() > deadline:
                raise OSError(f"not complete after {MAX_SECONDS:g} s")
    finally:
        transfer.abandoned = True
    if transfer.error is not None:
        raise transfer.error
    if progress is not None:
        progress(1.0)


class Transfer(threading.Thread):
    """A download in a thread of its own, which may wait for a server longer than it is waited for.

    Parameters
    ----------
    url : str
        The address.
    output : path
        The file to write.
    budget : Budget
        The largest size.

    Attributes
    ----------
    share : float
        The share that is done; 0 if the server does not state the size.
    error : Exception or None
        What ended it.
    abandoned : bool
        Whether it is to end at the next block.

    """

    def __init__(self, url: str, output: str | os.PathLike[str], budget: Budget) -> None:
        super().__init__(daemon=True)
        self._url, self._output, self._budget = url, output, budget
        self.share = 0.0
        self.error: Exception | None = None
        self.abandoned = False

    def run(self) -> None:
        """Download."""
        try:
            self._download()
        except Exception as error:
            self.error = error

    def _download(self) -> None:
        import requests
        from urllib3.exceptions import HTTPError

        # Packed contents could inflate to any size, and would have another SHA-256.
        plain = {"Accept-Encoding": "identity"}
        # Seconds without an answer after which a download fails.
        with (
            requests.get(self._url, stream=True, timeout=30.0, headers=plain) as answer,
            open(self._output, "wb") as file,
        ):
            answer.raise_for_status()
            stated = answer.headers.get("content-length", "")
            size = int(stated) if stated.isdecimal() else 0
            self._budget.take(size)
            try:
                for block in answer.raw.stream(BYTES_PER_BLOCK, decode_content=False):
                    if self.abandoned:
                        return
                    self._budget.take(0 if size else len(block))
                    file.write(block)
                    self.share = min(1.0, file.tell() / size) if size else 0.0
            except HTTPError as error:
                raise OSError(str(error)) from None
