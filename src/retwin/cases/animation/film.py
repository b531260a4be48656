"""Encoding of pictures as MP4 or GIF."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.checks import ends_in, install_command, require
from retwin.serialisation.places import check_place

TICKS = 100
"""Units of time per second in a GIF."""


def check_film(path: str | os.PathLike[str]) -> str:
    """Check that a film can be written.

    Parameters
    ----------
    path : str or path-like
        The film.

    Returns
    -------
    {".mp4", ".gif"}
        Its suffix.

    Raises
    ------
    InputError
        Another suffix, a place that cannot be written, or MP4 without the package that writes it.

    """
    suffix = Path(path).suffix.lower()
    ends_in("path", path, (".mp4", ".gif"), remedy="choose one of these formats by the name")
    fits = suffix == ".gif" or importlib.util.find_spec("imageio_ffmpeg") is not None
    expected = "the package imageio-ffmpeg, which writes MP4"
    remedy = f"install it: {install_command('render')}, or write a *.gif"
    require(fits, "path", expected=expected, got="an installation without it", remedy=remedy)
    check_place(path)
    return suffix


def write_film(
    pictures: Iterable[NDArray], path: Path, suffix: str, *, fps: float, size: tuple[int, int]
) -> None:
    """Encode pictures as they come.

    Parameters
    ----------
    pictures : iterable of ndarray of uint8, shape (height, width, 3)
        The frames.
    path : Path
        The film.
    suffix : {".mp4", ".gif"}
        Its format.
    fps : float
        Frames per second.
    size : (int, int)
        Width and height in pixels.

    """
    if suffix == ".gif":
        _write_gif(pictures, path, fps)
    else:
        _write_mp4(pictures, path, fps, size)


def _write_gif(pictures: Iterable[NDArray], path: Path, fps: float) -> None:
    """Encode a GIF, for which all frames are in memory."""
    from PIL import Image

    frames = [Image.fromarray(picture) for picture in pictures]
    # One palette for all frames: with one palette each, plain areas flicker.
    shown = np.hstack([np.asarray(frames[i]) for i in (0, len(frames) // 2, -1)])
    palette = Image.fromarray(shown).quantize(256, dither=Image.Dither.NONE)
    drawn = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    # Rounded times instead of a rounded duration, so that rounding does not change the speed.
    ends = np.round(np.arange(len(frames) + 1) * TICKS / fps).astype(int)
    milliseconds = (1000 // TICKS * np.diff(ends)).tolist()
    next(drawn).save(
        path, save_all=True, append_images=drawn, duration=milliseconds, loop=0, optimize=False
    )


def _write_mp4(pictures: Iterable[NDArray], path: Path, fps: float, size: tuple[int, int]) -> None:
    """Encode an MP4 by ffmpeg, frame by frame."""
    from imageio_ffmpeg import write_frames

    film = write_frames(
        str(path),
        size,
        fps=fps,
        codec="libx264",
        quality=None,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=["-crf", "20", "-movflags", "+faststart", "-fflags", "+bitexact"],
    )
    film.send(None)
    try:
        for picture in pictures:
            film.send(np.ascontiguousarray(picture))
    finally:
        film.close()
