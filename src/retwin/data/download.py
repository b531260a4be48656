"""Public data files: downloaded once, checked against their SHA-256, kept in a cache."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from retwin.catalog import DOWNLOADS, PublicFile
from retwin.checks import needs_extra, require
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import sha256 as sha256_of
from retwin.serialisation.places import check_place

__all__ = ["cache_folder", "fetch"]

CACHE_VARIABLE = "RETWIN_CACHE"
"""The environment variable that names the cache folder."""
TIMEOUT = 30.0
"""Seconds without an answer after which a download fails."""
BYTES_PER_BLOCK = 64 * 1024
"""Bytes that are received between two reports of progress."""


def fetch(
    name: str,
    *,
    folder: str | os.PathLike[str] | None = None,
    url: str | None = None,
    sha256: str | None = None,
    progress: Progress | None = None,
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

    Raises
    ------
    InputError
        The name is unknown and has no `url` and `sha256`, the address is not http(s), or the extra
        `fetch` is missing.
    OSError
        There is no network or no such file, or the folder cannot be written.
    RuntimeError
        The downloaded file has another SHA-256; nothing of it is kept.

    """
    known = _known(name, url, sha256)
    require(
        known.url.startswith(("http://", "https://")),
        "url",
        expected="an address that begins with https:// or http://",
        got=known.url,
        remedy="give the address of the file",
    )
    place = Path(folder) if folder else cache_folder()
    target = place / known.file
    if os.path.isfile(target) and sha256_of(target) == known.sha256:
        return target
    check_place(target)
    pooch = needs_extra("pooch", "fetch", "downloads public files")
    try:
        with _quiet(pooch.get_logger()):
            pooch.retrieve(
                known.url,
                known_hash=f"sha256:{known.sha256}",
                fname=target.name,
                path=target.parent,
                downloader=_downloader(progress),
            )
    except OSError as error:
        _tidy(target.parent, place)
        reason = " ".join(str(error).split())[:200]
        raise OSError(
            f"fetch {name}: cannot get {known.url} into {place} ({reason}); check the network, or "
            f"put the file there by hand as {known.file}"
        ) from None
    except ValueError:
        _tidy(target.parent, place)
        raise RuntimeError(
            f"fetch {name}: what {known.url} gave does not have the SHA-256 {known.sha256}, so it "
            "was thrown away; try again, or give another url"
        ) from None
    return target


def cache_folder() -> Path:
    """The folder of downloaded files: RETWIN_CACHE, else the user's cache folder."""
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given)
    # Imported late: it takes half a second, and only downloads need it.
    pooch = needs_extra("pooch", "fetch", "downloads public files")
    return Path(pooch.os_cache("retwin"))


def _known(name: str, url: str | None, sha256: str | None) -> PublicFile:
    """The entry of the catalog with the caller's changes, or an entry of the caller's own."""
    known = DOWNLOADS.get(name)
    if known is not None:
        return PublicFile(url or known.url, sha256 or known.sha256, known.file)
    plain = Path(name).name == name and name not in ("", ".", "..")
    if url is None or sha256 is None or not plain:
        raise InputError(
            "name",
            expected=f"one of {', '.join(sorted(DOWNLOADS))}",
            got=repr(name),
            remedy="choose one of these, or give a file name with its url and sha256",
        )
    return PublicFile(url, sha256, name)


def _tidy(folder: Path, place: Path) -> None:
    """Remove the empty folder below the cache of a file that could not be downloaded."""
    if folder != place:
        with suppress(OSError):  # it is not empty, or does not exist
            folder.rmdir()


def _downloader(progress: Progress | None) -> Callable[[str, str, Any], None]:
    """A downloader for pooch, whose own one leaves the connection open on errors."""

    def download(url: str, output: str, _: Any) -> None:
        import requests

        with requests.get(url, stream=True, timeout=TIMEOUT) as answer, open(output, "wb") as file:
            answer.raise_for_status()
            # A server need not state the size.
            size = int(answer.headers.get("content-length", 0))
            for chunk in answer.iter_content(BYTES_PER_BLOCK):
                file.write(chunk)
                if progress is not None and size:
                    progress(min(1.0, file.tell() / size))

    return download


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    """Silence pooch's log during this download."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
