"""The kinds of entries of the catalog."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Need = tuple[str, str]
"""Kind and name of a job of a study whose result is needed."""


@dataclass(frozen=True)
class Entry:
    """An implementation.

    Parameters
    ----------
    target : str
        The object, as "package.module:object".
    title : str
        What it is, in a few words.
    extra : str
        The extra of the package that it needs; "" if it needs none.
    kinds : sequence of str
        The classes of the config objects that a target which is a function makes.

    """

    target: str
    title: str
    extra: str = ""
    kinds: Sequence[str] = ()


@dataclass(frozen=True)
class CaseEntry:
    """A built-in case.

    Parameters
    ----------
    target : str
        A function without arguments that returns the `Case`.
    title : str
        What it is, in a few words.
    recorded : str
        A `data.io.DataCase` for its files, which can be imported without torch.

    """

    target: str
    title: str
    recorded: str


@dataclass(frozen=True)
class SourceEntry:
    """A source of training data in a study: an updated twin, or a method compared with it.

    Exactly one of `twin`, `diagnoser` and `pool` is given.

    Parameters
    ----------
    title : str
        The name in tables and figures.
    real_data : str
        What it may learn from: "none", "timing" (of commands), "healthy", "unlabelled",
        "transductive" (outputs of the test set without labels) or "labelled".
    needs : sequence of Need
        The jobs that must be done first.
    twin : str
        A function of a `Trial` that returns the twin on whose trajectories the study's classifier
        is trained, or that simulates the test records.
    diagnoser : str
        A function of a `Trial` that returns the diagnoser itself.
    pool : sequence of str
        The sources whose probabilities are pooled.
    recorded : bool
        Whether it learns the classes from the given trajectories of the twin.
    network : bool
        Whether the study's classifier must be a neural network.
    parametric : bool
        Whether the case must declare the free parameters of its twin.
    extra : str
        The extra of the package that it needs.
    simulates : bool
        Whether it occurs only in studies of cases without classes.
    role : str
        Its role in what a report states: "plain" (the twin as it is), "surrogate" (the surrogate
        without residual model), "updated" (the surrogate with its residual model) or "".

    """

    title: str
    real_data: str
    needs: Sequence[Need] = ()
    twin: str = ""
    diagnoser: str = ""
    pool: Sequence[str] = ()
    recorded: bool = False
    network: bool = False
    parametric: bool = False
    extra: str = ""
    simulates: bool = False
    role: str = ""

    @property
    def per_fold(self) -> bool:
        """Whether it depends on the calibration set, so that it is made once per fold."""
        return self.real_data != "none"

    @property
    def fidelity(self) -> bool:
        """Whether its trajectories are compared with measured ones."""
        return bool(self.twin) and self.real_data == "healthy"


@dataclass(frozen=True)
class Metric:
    """A score.

    Parameters
    ----------
    title : str
        The name in tables and figures.
    better : int
        1 if larger values are better, -1 if smaller ones are, 0 for a target to be met.
    headline : bool
        Whether a study is summarised by it.
    unit : str
        "output" for the unit of the outputs; "1" for numbers without a unit.
    head : str
        The head of its column in a terminal; "" if it is not shown there.
    selected : bool
        Whether it is shown where there is room for few metrics only, as learning curves are.
    simulated : bool
        Whether it scores simulations, and no diagnoses.
    compared : bool
        Whether sources are compared by it.
    family : bool
        Whether its p-values are adjusted together with those of the others of its kind (Holm).

    """

    title: str
    better: int = 1
    headline: bool = False
    unit: str = "1"
    head: str = ""
    selected: bool = False
    simulated: bool = False
    compared: bool = False
    family: bool = False


@dataclass(frozen=True)
class FormatEntry:
    """A file format of trajectories.

    Parameters
    ----------
    title : str
        What it holds.
    reader : str
        The function that reads it, a `data.io.assembly.Reader`.
    writer : str
        The function of trajectories and a path that writes it; "" if the format is only read.
    extra : str
        The extra of the package that it needs.
    folder : bool
        Whether it is a folder and no file.

    """

    title: str
    reader: str
    writer: str = ""
    extra: str = ""
    folder: bool = False


@dataclass(frozen=True)
class LogEntry:
    """A format of logs, whose signals have times of their own.

    Parameters
    ----------
    title : str
        What it is.
    reader : str
        The function that reads it, a `data.logs.signals.Reader`.
    extra : str
        The extra of the package that it needs.

    """

    title: str
    reader: str
    extra: str = ""


@dataclass(frozen=True)
class Extra:
    """An extra of the package, which installs optional packages.

    Parameters
    ----------
    purpose : str
        What it is needed for.
    module : str
        A module by which its installation is recognised.

    """

    purpose: str
    module: str


@dataclass(frozen=True)
class PublicFile:
    """A public file.

    Parameters
    ----------
    url : str
        Its address.
    sha256 : str
        The SHA-256 of its contents, in hexadecimal.
    file : str
        Its name below the cache folder.

    """

    url: str
    sha256: str
    file: str
