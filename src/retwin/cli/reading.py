"""Cases and trajectories from the names and files of a command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from retwin.checks import existing, given
from retwin.cli.terminal import bar, note, table
from retwin.data.io import DataCase, load
from retwin.data.logs.reading import is_log
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import read_json
from retwin.serialisation.models import kind_of

if TYPE_CHECKING:
    from rich.console import RenderableType

    from retwin.cases import LogReader
    from retwin.cases.case import Case
    from retwin.data.quality.check import Checked
    from retwin.deploy.bundle.bundle import Bundle
    from retwin.deploy.onnx.portable import Portable
    from retwin.twins.twin import Twin
    from retwin.update import CorrectedTwin, DynamicsTwin

Part = Literal["all", "calibration", "test"]
"""Which of the records that a case states of a table."""


def case_named(name: str | None) -> Case | None:
    """The case of that name, if one is given; it needs torch."""
    from retwin import cases

    return None if name is None else cases.get(name)


def stored_name(name: str) -> str:
    """The name of a case as a model keeps it: a path is absolute, to be read from other folders."""
    return str(Path(name).resolve()) if Path(name).suffix.lower() == ".toml" else name


def data_case(name: str | None) -> DataCase | None:
    """What the files of the case of that name need of it, if one is given."""
    from retwin import cases

    return None if name is None else cases.data_case(name)


def saved(folder: Path) -> Path:
    """The folder of a saved model or bundle, which must be there."""
    existing("path", folder, folder.is_dir(), "the folder of a saved model")
    return folder


def system_of(twin: Any, folder: Path, name: str | None) -> Case:
    """The case of that name, else the one that a twin of that folder was fitted for."""
    from retwin import cases

    got, remedy = f"none, and {folder} was saved without one", "give --case"
    found = name or twin.case or None
    return cases.get(given("case", found, "the name of a case", got=got, remedy=remedy))


def updated_twin(folder: Path) -> CorrectedTwin | DynamicsTwin:
    """The updated twin in the folder of a saved model.

    Raises InputError for any other kind.
    """
    from retwin.update import load_twin

    return load_twin(saved(folder))


def is_sealed(folder: Path) -> bool:
    """Whether the folder is a bundle, or the ONNX export of one."""
    from retwin.deploy.bundle.seal import SCHEMAS, SUMS

    return kind_of(folder) in SCHEMAS or (folder / SUMS).exists()


def open_sealed(folder: Path) -> Bundle | Portable:
    """The bundle, or its export, for which torch is not imported."""
    from retwin.deploy.bundle.seal import read_sealed

    if read_sealed(folder, "bundle", "portable")["kind"] == "portable":
        from retwin.deploy.onnx.portable import Portable

        return Portable.load(folder)
    from retwin.deploy.bundle.bundle import Bundle

    return Bundle.load(folder)


def source_of(folder: Path, name: str | None) -> tuple[CorrectedTwin | DynamicsTwin, Case]:
    """The updated twin of a saved model or bundle, and its case or the one of that name."""
    if not is_sealed(saved(folder)):
        updated = updated_twin(folder)
        return updated, system_of(updated, folder, name)
    from retwin import cases
    from retwin.deploy.bundle.bundle import Bundle

    bundle = Bundle.load(folder)
    # Only built-in names: code that a file names is not run, so other cases are given by --case.
    if name is None and bundle.facts.sampler is None and bundle.facts.case.isidentifier():
        name = bundle.facts.case
    return bundle.twin, bundle.case if name is None else cases.get(name)


def read(
    files: Path | Sequence[Path],
    case: DataCase | str | None = None,
    rate: float | None = None,
    *,
    part: Part = "all",
    max_bytes: int | None = None,
    mapping: Path | None = None,
) -> Trajectories:
    """The trajectories of files together, with a bar while they are read.

    The one way from files to trajectories. Logs are read by their mapping, else by what the case
    states of its records, else by columns with the names of the channels of its twin.

    Parameters
    ----------
    files : path or sequence of path
        Files or folders.
    case : DataCase or str, optional
        The case, or anything with its `twin`, or its name.
    rate : float, optional
        Sample rate in Hz, if a file has none.
    part : {"all", "calibration", "test"}
        Of tables that the case divides into records of calibration and test.
    max_bytes, mapping
        See `rt.load`.

    """
    options: Any = {"max_bytes": max_bytes, "mapping": mapping}
    if not isinstance(files, Path):
        sets = [read(file, case, rate, part=part, **options) for file in files]
        return sets[0] if len(sets) == 1 else Trajectories.concatenate(sets)
    file = files
    log = mapping is None and file.exists() and (is_log(file) or file.is_dir())
    if isinstance(case, str):  # a built-in case without torch has no twin to read logs by
        case = case_named(case) if log and not file.is_dir() else data_case(case)
    divided = log and getattr(case, "records", None) is not None
    twin: Any = getattr(case, "twin", None)
    if divided or (log and is_log(file) and twin is not None):
        reader = log_reader(file, case, twin, max_bytes)
        if divided and is_log(file):  # one with the names of the channels is read by these
            divided = not _names_channels(file, twin, max_bytes)
        own = case if divided else None
        found = reader.trajectories([file], twin, case=own)
        for text in found.notes:
            note(text)
        if found.test is None or part == "calibration":
            return found.trajectories
        both = [found.trajectories, found.test]
        return found.test if part == "test" else Trajectories.concatenate(both)
    with bar("read") as show:
        report = partial(show, file.name)
        return load(file, case=case, rate=rate, progress=report, **options)


def log_reader(file: Path, case: Any, twin: Twin, max_bytes: int | None = None) -> LogReader:
    """A reader of a log by the names of the channels, else by the columns that the case states."""
    from retwin.cases import Columns, LogReader

    stated = getattr(case, "logs", Columns())
    if not is_log(file) or _names_channels(file, twin, max_bytes):
        stated = Columns(transient=stated.transient)
    return LogReader(stated.of_channels(twin.inputs, twin.outputs), max_bytes)


def _names_channels(file: Path, twin: Twin, max_bytes: int | None) -> bool:
    """Whether a log has signals with the names of all commands and of an output."""
    from retwin.cases import LogReader

    reader = LogReader(max_bytes=max_bytes)
    try:
        commands = set(twin.inputs.names) <= set(reader.signals(file))
        return commands and bool(reader.measured_outputs([file], twin))
    except InputError:  # of a log that only a mapping can read, or none
        return False


def read_signals(files: Sequence[Path], max_bytes: int | None = None) -> Trajectories:
    """The signals of tables as outputs, without commands; one that never changes is left out."""
    from retwin.cases import LogReader
    from retwin.data.trajectories import Channels
    from retwin.twins import FunctionTwin

    reader = LogReader(max_bytes=max_bytes)
    names = reader.signals(files[0])
    rate = given("rate", reader.rate(files[0], names), "a column of times", remedy="add one")
    while True:
        channels = Channels(names, ("1",) * len(names))
        nothing = np.zeros(len(names))
        # Its outputs stand for those of no model: only the names of its channels are read.
        zeros = partial(lambda row, u: np.tile(row, (*u.shape[:2], 1)), nothing)
        twin = FunctionTwin(zeros, rate=rate, inputs=Channels((), ()), outputs=channels)
        found = reader.trajectories(files, twin).trajectories
        seen = found.measured
        low, high = np.nanmin(seen, axis=(0, 1)), np.nanmax(seen, axis=(0, 1))
        fixed = [n for n, least, most in zip(names, low, high, strict=True) if least == most]
        if not fixed or len(fixed) == len(names):
            return found
        note(f"Left out, since they never change: {', '.join(fixed)}")
        names = tuple(name for name in names if name not in fixed)


def read_commands(file: Path, case: Case, *, mapping: Path | None = None) -> Trajectories:
    """The same to be simulated: a table may hold the commands alone."""
    from retwin.twins import FunctionTwin

    twin, table = case.twin, mapping is None and file.is_file() and is_log(file)
    if not table or log_reader(file, case, twin).measured_outputs([file], twin):
        return read(file, case, mapping=mapping)
    # A twin whose outputs are its commands, so that no output is missing.
    alone = FunctionTwin(lambda u: u, rate=twin.rate, inputs=twin.inputs, outputs=twin.inputs)
    found = read(file, replace(case, twin=alone))
    if found.outputs == twin.outputs:  # the records that the case states of the table
        return found
    nothing = np.zeros((*found.commands.shape[:2], len(twin.outputs)))
    unseen = np.zeros(nothing.shape, dtype=bool)
    outputs = {"outputs": twin.outputs, "nominal": nothing, "observed": nothing, "mask": unseen}
    return found.replace(**outputs)


def shown_records(checked: Checked) -> list[RenderableType]:
    """What records look like: how much their twin explains, and a table of what was found."""
    from retwin.report.records import HEADS, TITLE, finding_rows

    shown: list[RenderableType] = list(checked.sentences)
    if checked.findings:
        shown += ["", f"{TITLE}:", table(HEADS, finding_rows(checked.findings)), ""]
    return shown


def _read_choice(model: Path | None) -> dict[str, Any]:
    """What `rt.fit` wrote beside a model about how it was chosen; nothing of another one."""
    from retwin.evaluation.choice.fitted import FILE

    file = model / FILE if model else None
    return read_json(file) if file and file.is_file() else {}


def unstable_remarks(model: Path) -> list[str]:
    """What `rt.fit` said where it found that free simulations of a model are of no use."""
    from retwin.evaluation.choice.fitting import UNSTABLE

    return [each for each in _read_choice(model).get("remarks", []) if each.startswith(UNSTABLE)]


def fitted_remarks(model: Path | None, records: Trajectories, therefore: str) -> list[str]:
    """Which records a model was fitted to, and what follows from that; none where it is not known.

    `rt.fit` writes their fingerprints beside the model.
    """
    from retwin.data.quality.copies import fingerprints

    known = _read_choice(model).get("fitted_to", [])
    own = sum(each in known for each in fingerprints(records)) if known else 0
    if not own:
        return []
    which = "these records" if own == len(records) else f"{own} of these {len(records)} records"
    return [f"The model was fitted to {which}, where its errors are smaller: {therefore}."]
