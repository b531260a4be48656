"""The one way to say that an input is bad: what was expected, what came, and what to do."""

from __future__ import annotations

__all__ = ["InputError"]


class InputError(ValueError):
    """Bad input, told in one line: the argument, what was expected, what came, the remedy.

    The command line turns it into exit code 2.
    """

    def __init__(self, argument: str, *, expected: str, got: str, remedy: str) -> None:
        super().__init__(f"{argument}: expected {expected}, got {got}; {remedy}")
        self.argument = argument
        self.expected = expected
        self.got = got
        self.remedy = remedy

    def __reduce__(self) -> tuple:
        """Keep the parts when the error crosses a process border."""
        return _rebuild, (self.argument, self.expected, self.got, self.remedy)


def _rebuild(argument: str, expected: str, got: str, remedy: str) -> InputError:
    return InputError(argument, expected=expected, got=got, remedy=remedy)
