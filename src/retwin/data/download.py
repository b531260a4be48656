"""Public data files: fetched once, checked against their SHA-256, kept in a cache."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from retwin.catalog import DOWNLOADS, PublicFile
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import sha256 as sha256_of

__all__ = ["cache_folder", "fetch"]

CACHE_VARIABLE = "RETWIN_CACHE"
# Seconds without an answer until a download is given up.
TIMEOUT = 30.0
CHUNK = 64 * 1024


def fetch(
    name: str,
    *,
    folder: str | os.PathLike[str] | None = None,
    url: str | None = None,
    sha256: str | None = None,
    progress: Progress | None = None,
) -> Path:
    """The path of a public file, downloaded when it is not in the cache yet.

    The cache is `folder`, else the environment variable RETWIN_CACHE, else the user's cache folder.
    The file lies there under the name that the catalog states, so that the cache can serve as
    RETWIN_DATA. `url` names another address; the SHA-256 stays the known one. A name that is not
    in `catalog.DOWNLOADS` needs both `url` and `sha256`. A cached file whose SHA-256 is wrong is
    fetched again. `progress` is called with the share that is done.

    Raises
    ------
    InputError: an unknown name without `url` and `sha256`, or an address that is not http(s).
    OSError: no network, no such file there, or a folder that cannot be written.
    RuntimeError: what came has another SHA-256; nothing of it is kept.

    """
    known = _known(name, url, sha256)
    if not known.url.startswith(("http://", "https://")):
        raise InputError(
            "url",
            expected="an address that begins with https:// or http://",
            got=known.url,
            remedy="give the address of the file",
        )
    place = Path(folder) if folder else cache_folder()
    target = place / known.file
    if target.is_file() and sha256_of(target) == known.sha256:
        return target
    import pooch

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
    """Where fetched files are kept: RETWIN_CACHE, else the user's cache folder."""
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given)
    # It takes half a second to import, and only downloads need it.
    import pooch

    return Path(pooch.os_cache("retwin"))


def _known(name: str, url: str | None, sha256: str | None) -> PublicFile:
    """The registered file with what the caller overrides, or a file that only the caller knows."""
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
    """Remove the folder below the cache that was made for a file which did not come."""
    if folder != place:
        with suppress(OSError):  # it holds something, or was never made
            folder.rmdir()


def _downloader(progress: Progress | None) -> Callable[[str, str, Any], None]:
    """What pooch calls to bring `url` to a file. Its own leaves the connection open on errors."""

    def bring(url: str, output: str, _: Any) -> None:
        import requests

        with requests.get(url, stream=True, timeout=TIMEOUT) as answer, open(output, "wb") as file:
            answer.raise_for_status()
            # A server may not say how much will come.
            size = int(answer.headers.get("content-length", 0))
            for chunk in answer.iter_content(CHUNK):
                file.write(chunk)
                if progress is not None and size:
                    progress(min(1.0, file.tell() / size))

    return bring


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    """Keep pooch's own lines off the screen, for this download only."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
