"""`InputError`: bad input as one line of four parts; and where in a user's code an error arose."""

from __future__ import annotations

import sysconfig
import traceback
from pathlib import Path

LONGEST = 2000
"""Characters of each part of a message, at most."""


class InputError(ValueError):
    """Bad input: the argument, what was expected, what came, and the remedy, in one line.

    The command line turns it into exit code 2.

    Parameters
    ----------
    argument : str
        The name of the argument, the key or the file.
    expected, got : str
        What it should be, and what came.
    remedy : str
        What to do.

    """

    def __init__(self, argument: str, *, expected: str, got: str, remedy: str) -> None:
        parts = [str(each) for each in (argument, expected, got, remedy)]
        # What came may be a header of a hundred thousand characters.
        parts = [each if len(each) <= LONGEST else f"{each[: LONGEST - 1]}…" for each in parts]
        super().__init__("{}: expected {}, got {}; {}".format(*parts))
        self.argument = argument
        self.expected = expected
        self.got = got
        self.remedy = remedy

    def with_parts(self, *, got: str = "", remedy: str = "") -> InputError:
        """The same error with another part."""
        return rebuild(self.argument, self.expected, got or self.got, remedy or self.remedy)

    def __reduce__(self) -> tuple:
        """Keep the parts when the error is sent to another process."""
        return rebuild, (self.argument, self.expected, self.got, self.remedy)


def rebuild(argument: str, expected: str, got: str, remedy: str) -> InputError:
    """The error of these parts, which another process has sent."""
    return InputError(argument, expected=expected, got=got, remedy=remedy)


def place_of(error: BaseException) -> str:
    """The innermost line of the user's own code in a traceback, as "FILE:LINE"; "" if none is.

    Own code is what belongs neither to retwin, nor to Python, nor to an installed package.
    """
    others = [sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")]
    others.append(str(Path(__file__).parent))
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = Path(frame.filename)
        if file.is_file() and not any(file.is_relative_to(other) for other in others):
            return f"{file}:{frame.lineno}"
    return ""


def brief(error: BaseException) -> str:
    """The message of a library's exception on one line of at most 160 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else f"{text[:159]}…"
