"""The checks of arguments: what passes, what is refused, and the four parts of the message."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from fractions import Fraction
from math import inf, nan
from typing import Any

import numpy as np
import pytest

from retwin.checks import (
    at_least,
    at_most,
    ends_in,
    existing,
    finite,
    given,
    instance,
    needs_extra,
    nothing,
    one_of,
    one_per,
    positive,
    require,
    same_names,
    whole,
)
from retwin.errors import InputError

NO_NUMBERS = [nan, inf, -inf, True, False, "1", None, [1.0], 1j, np.float64("nan"), np.float32(inf)]
NO_NUMBERS += [np.bool_(True), np.array([1.0, 2.0])]


def refused(check: Callable[..., Any], *arguments: Any, **options: Any) -> InputError:
    """The error, whose message is its four parts in one line."""
    with pytest.raises(InputError) as caught:
        check(*arguments, **options)
    error = caught.value
    parts = (error.argument, error.expected, error.got, error.remedy)
    assert all(parts)
    assert str(error) == "{}: expected {}, got {}; {}".format(*parts)
    assert "\n" not in str(error)
    return error


@pytest.mark.parametrize("value", NO_NUMBERS)
@pytest.mark.parametrize("check", [finite, positive, whole])
def test_what_is_no_finite_number_is_refused(check: Callable[..., Any], value: Any) -> None:
    assert refused(check, "gain", value).got == repr(value).replace("\n", " ")


@pytest.mark.parametrize("check", [finite, positive, whole])
@pytest.mark.parametrize("value", [2, np.int8(2), np.uint64(2)])
def test_whole_numbers_of_numpy_are_numbers(check: Callable[..., Any], value: Any) -> None:
    assert check("gain", value) == 2
    assert type(check("gain", value)) in (int, float)


@pytest.mark.parametrize("value", [0.5, np.float32(0.5), np.float64(0.5), Fraction(1, 2)])
def test_real_numbers_come_back_as_floats(value: Any) -> None:
    for check in (finite, positive):
        assert type(check("gain", value)) is float
        assert check("gain", value) == 0.5
    assert refused(whole, "count", value).expected == "a whole number of at least 0"


def test_bounds_include_their_ends() -> None:
    assert finite("share", 0, at_least=0, at_most=1) == 0
    assert finite("share", 1, at_least=0, at_most=1) == 1
    assert finite("share", -5) == -5
    for value in (-1e-9, 1 + 1e-9):
        error = refused(
            finite, "share", value, at_least=0, at_most=1, unit="s", remedy="give a share"
        )
        assert error.expected == "a finite number from 0 to 1 in s"
        assert error.remedy == "give a share"
    assert refused(finite, "low", 2, at_most=1).expected == "a finite number of at most 1"


def test_positive_excludes_zero() -> None:
    assert positive("rate", 1e-300) == 1e-300
    for value in (0, -0.0, -1, np.float32(0)):
        error = refused(positive, "rate", value, unit="Hz")
        assert error.expected == "a positive number of Hz"
        assert error.remedy == "give it in Hz"
    assert refused(positive, "gain", 0).expected == "a positive number"
    assert refused(positive, "gain", 0, remedy="leave it out").remedy == "leave it out"


def test_whole_numbers_have_bounds() -> None:
    assert whole("folds", 2, at_least=2, at_most=2) == 2
    assert (
        refused(whole, "folds", 1, at_least=2, at_most=5).expected == "a whole number from 2 to 5"
    )
    assert refused(whole, "folds", 6, at_least=2, at_most=5).got == "6"
    assert refused(whole, "steps", -1).expected == "a whole number of at least 0"
    assert refused(whole, "steps", 2.0).got == "2.0"


def test_a_choice_has_the_type_of_the_choices() -> None:
    assert one_of("kind", "lstm", {"cnn": 0, "lstm": 1}) == "lstm"
    assert one_of("sign", -1, (-1, 1)) == -1
    for value in ("LSTM", "", None, 1, ["lstm"], nan):
        error = refused(one_of, "kind", value, ("cnn", "lstm"))
        assert (error.expected, error.remedy) == ("one of cnn, lstm", "check the spelling")
    assert refused(one_of, "sign", True, (-1, 1), remedy="give a sign").remedy == "give a sign"


def test_collections_are_counted() -> None:
    at_least("sets", [1, 2], 2, "sets", remedy="give more")
    assert refused(at_least, "sets", [1], 2, "sets", remedy="give more").expected == (
        "at least 2 sets"
    )
    one_per("names", "ab", 2, "channel")
    error = refused(one_per, "names", "abc", 2, "channel")
    assert (error.expected, error.got) == ("one per channel, 2", "3")
    assert error.remedy == "give one for each channel"


def test_a_number_of_things_has_a_limit() -> None:
    at_most("signals", 3, 3, "signals", remedy="name those that are wanted")
    error = refused(at_most, "signals", 4, 3, "signals", remedy="name those that are wanted")
    assert (error.expected, error.got) == ("at most 3 signals", "4")


def test_what_must_not_be_there_is_listed() -> None:
    nothing("parameters", [], "some of gain, leak", remedy="check the spelling")
    error = refused(nothing, "parameters", ["a", "b"], "some of gain", remedy="check the spelling")
    assert (error.expected, error.got) == ("some of gain", "a, b")


def test_names_are_those_that_are_wanted() -> None:
    same_names("columns", {"b": 1, "a": 2}, ("a", "b"), "a column for each of", remedy="name all")
    for names, got in (((), "none"), (("a",), "a"), (("a", "b", "b"), "a, b, b")):
        error = refused(same_names, "columns", names, "ab", "a column for each of", remedy="do")
        assert (error.expected, error.got) == ("a column for each of a, b", got)


def test_the_name_of_a_file_has_a_suffix() -> None:
    ends_in("path", "film.GIF", (".mp4", ".gif"), remedy="choose one of these")
    error = refused(ends_in, "path", "film.avi", (".mp4", ".gif"), remedy="choose one of these")
    assert (error.expected, error.got) == ("a name that ends in .mp4 or .gif", "film.avi")


def test_a_missing_file_is_named() -> None:
    existing("log", "run.csv", True)
    error = refused(existing, "log", "run.csv", False, "a log")
    assert (error.expected, error.got) == ("a log", "run.csv, where there is none")


def test_a_value_that_is_needed() -> None:
    assert given("rate", 0.0, "a rate in Hz", remedy="give it") == 0.0
    error = refused(given, "rate", None, "a rate in Hz", remedy="give it")
    assert (error.expected, error.got, error.remedy) == ("a rate in Hz", "none", "give it")


def test_anything_else_is_a_condition() -> None:
    require(np.bool_(True), "a", expected="b", got="c", remedy="d")
    for condition in (False, np.bool_(False), 0, ""):
        assert refused(require, condition, "a", expected="b", got=3, remedy="d").got == "3"


def test_a_comparison_with_nan_is_no_true_condition() -> None:
    refused(require, nan > 0, "gain", expected="a positive number", got=nan, remedy="give one")


def test_a_missing_package_names_its_extra() -> None:
    assert needs_extra("json", "scale", "reads files").__name__ == "json"
    error = refused(needs_extra, "no_such.package", "scale", "reads files")
    assert error.argument == "the package no_such"
    assert re.search(r'pip install .*\[scale\]"', error.remedy)


def test_an_error_keeps_its_parts_between_processes() -> None:
    error = InputError("rate", expected="a number", got="'x'", remedy="give it in Hz")
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error) == "rate: expected a number, got 'x'; give it in Hz"
    assert again.remedy == error.remedy


def test_an_object_of_another_class_is_refused() -> None:
    assert instance("n", 3, int, remedy="count") == 3
    with pytest.raises(InputError, match=r"^n: expected int, got NoneType; count$"):
        instance("n", None, int, remedy="count")


def test_a_message_is_short_whatever_came() -> None:
    error = InputError("log", expected="a column", got="h" * 100_000, remedy="name it")
    assert len(str(error)) < 3000
    assert str(error).endswith("…; name it")
    assert error.got == "h" * 100_000
