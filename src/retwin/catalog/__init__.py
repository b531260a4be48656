"""Everything that is chosen by name, declared once: cases, twins, sources, metrics, formats, …

An entry states a name, a title and where the implementation is, as `package.module:object`. The
implementation is imported when it is resolved, so that the command line, its completion, the
report and the documentation read this module without waiting for torch. To add an implementation,
write its module and add one entry here.

Belongs here: names, titles, the kinds of entries, and how modules are found by their names. Not
here: implementations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from retwin.catalog.entries import (
    CaseEntry,
    Entry,
    Extra,
    FormatEntry,
    LogEntry,
    Metric,
    Need,
    PublicFile,
    SourceEntry,
)
from retwin.catalog.modules import import_beside
from retwin.checks import one_of

T = TypeVar("T")

OPENED_CASE = "retwin.cases:get"
"""The function from the name of a case to the case, for models that name the case of their twin."""
CASES: Mapping[str, CaseEntry] = {
    name: CaseEntry(
        f"retwin.cases.{room}.case:{name}", title, f"retwin.cases.{room}.{recorded}:RECORDED"
    )
    for name, room, recorded, title in (
        ("armpi", "armpi_fpv", "recovery", "ArmPi FPV robot arm"),
        ("tanks", "cascaded_tanks", "twin", "two cascaded tanks, without overflow"),
        ("tanks_overflow", "cascaded_tanks", "twin", "two cascaded tanks that overflow"),
        ("silverbox", "silver_box", "twin", "Silverbox, a linear twin of a cubic spring"),
        ("incubator", "styrofoam_incubator", "twin", "incubator, a heater in a box of styrofoam"),
    )
}
"""The built-in cases, by the names that `retwin.cases.get` and the command line take."""

TWINS: Mapping[str, Entry] = {
    "armpi": Entry(
        "retwin.cases.armpi_fpv.twin:ArmPiTwin", "ArmPi FPV robot arm, simulated by MuJoCo"
    ),
    "armpi-kinematic": Entry(
        "retwin.cases.armpi_fpv.twin:KINEMATIC",
        "the same arm in closed form: kinematics behind a servo lag",
    ),
    "armpi-emulated": Entry(
        "retwin.cases.armpi_fpv.emulator:EmulatedArmPi",
        "emulation of the real arm: delays, backlash, missed segments, polling",
    ),
    "incubator": Entry(
        "retwin.cases.styrofoam_incubator.twin:INCUBATOR",
        "incubator, a heater and the air in a box",
    ),
    "silverbox": Entry("retwin.cases.silver_box.twin:SILVERBOX", "Silverbox, a linear oscillator"),
    "tanks": Entry(
        "retwin.cases.cascaded_tanks.twin:TANKS", "two cascaded tanks, the upper level hidden"
    ),
}
"""Targets are twins, or make one when they are called without arguments."""

IDENTIFICATIONS: Mapping[str, Entry] = {
    "least_squares": Entry(
        "retwin.update.identification:LeastSquares", "least squares from several starts (Eq. 2)"
    ),
    "evolution": Entry(
        "retwin.update.identification:Evolution", "differential evolution, then least squares"
    ),
    "bayes": Entry(
        "retwin.update.identification:MCMC", "posterior by Markov chains, for fast twins (Eq. 3)"
    ),
    "npe": Entry(
        "retwin.update.identification:NPE", "posterior by a network, from few simulations (Eq. 3)"
    ),
}
"""Methods by which a twin's own parameters are identified."""

CORRECTIONS: Mapping[str, Entry] = {
    "additive": Entry("retwin.update.corrections:Additive", "a residual of each output sample"),
    "delay_offset": Entry(
        "retwin.update.corrections:DelayOffset",
        "a delay and an output offset per segment (the paper's)",
    ),
    "command_space": Entry(
        "retwin.update.corrections:command_space",
        "effective commands per segment and actuator, behind a sampled sensor",
        kinds=(
            "retwin.update.corrections:CommandSpace",
            "retwin.update.corrections:SampledSensor",
            "retwin.update.corrections:Chain",
        ),
    ),
}
"""Correction operators g, by the names that case files and `--correction` take."""

DENSITIES: Mapping[str, Entry] = {
    "mixture": Entry("retwin.update.residual:Mixture", "Gaussian mixture per segment (Eq. 6)"),
    "flow": Entry("retwin.update.residual:Flow", "normalising flow per segment", "flows"),
    "sequence_mixture": Entry(
        "retwin.update.residual:SequenceMixture", "autoregressive mixture per sample"
    ),
    "stationary": Entry(
        "retwin.update.residual:StationaryNoise", "errors of the twin as noise, nothing corrected"
    ),
}
"""Families of distributions of z, by the names that case files and `--density` take."""

SURROGATE_MODES: Mapping[str, str] = {
    "auto": "a surrogate for a slow twin",
    "on": "a surrogate always",
    "off": "the twin itself",
}
"""Whether corrections are fitted to a surrogate of a twin."""

CANDIDATES: Mapping[str, str] = {
    "none": "the twin as it is",
    "parameters": "identified parameters",
    "delay_offset": "a delay and an offset per segment",
    "dynamics": "corrected state equations",
    "segments": "a correction per segment of the case",
    "output": "a residual of each output sample",
    "dynamics_output": "corrected state equations, then a residual of each output sample",
    "arx": "linear model without the twin",
    "narx": "polynomial model without the twin",
    "neural_ss": "neural state-space model without the twin",
    "lstm": "recurrent network without the twin",
}
"""Models that `rt.fit` compares, the simplest first, and those without the twin."""

NETWORKS: Mapping[str, Entry] = {
    "mlp": Entry("retwin.nets.networks:MLP", "multi-layer perceptron, without memory"),
    "lstm": Entry("retwin.nets.networks:LSTM", "recurrent network"),
    "tcn": Entry("retwin.nets.networks:TCN", "causal convolutions"),
    "state_space": Entry("retwin.nets.networks:StateSpace", "neural state-space model"),
}
"""Networks of a surrogate."""

CLASSIFIERS: Mapping[str, Entry] = {
    "cnn": Entry("retwin.nets.networks:CNN", "convolutional network"),
    "lstm": Entry("retwin.nets.networks:LSTMClassifier", "LSTM, last step (the paper's)"),
    "rocket": Entry("retwin.diagnosis.trained.rocket:Rocket", "MiniRocket and a ridge", "rocket"),
}
"""Classifiers that are trained on generated trajectories."""

DIAGNOSERS: Mapping[str, Entry] = {
    "diagnoser": Entry("retwin.diagnosis.trained.network:NetworkDiagnoser", "neural network"),
    "inversion": Entry(
        "retwin.diagnosis.inversion.trajectories:InversionDiagnoser", "fault inversion"
    ),
    "state inversion": Entry(
        "retwin.diagnosis.inversion.states:StateInversionDiagnoser", "fault inversion with states"
    ),
    "rocket": Entry(
        "retwin.diagnosis.trained.rocket:RocketDiagnoser", "MiniRocket and a ridge", "rocket"
    ),
}
"""By the kind in the model.json of a saved diagnoser: the class whose `load` reads it."""

FORMATS: Mapping[str, FormatEntry] = {
    ".mat": FormatEntry(
        "X_array, y_array or X_test_array, y_test_array: cells of (T, 2 d_y)",
        "retwin.data.io.mat:read_mat",
    ),
    ".npz": FormatEntry(
        "one file, as `save` wrote it",
        "retwin.data.io.npz:read_npz",
        "retwin.data.io.npz:write_npz",
    ),
    ".zarr": FormatEntry(
        "a folder in chunks, as `save` or `simulate_to` wrote it",
        "retwin.data.io.zarr_folder:read_zarr",
        "retwin.data.io.zarr_folder:write_zarr",
        extra="scale",
        folder=True,
    ),
    "": FormatEntry(
        "a folder per class of *.csv or dataset_*.mat",
        "retwin.data.io.class_folders:read_class_folders",
        folder=True,
    ),
}
"""By the suffix of the name; "" is any other folder."""

LOGS: Mapping[str, LogEntry] = {
    ".mcap": LogEntry("MCAP", "retwin.data.logs.formats.mcap_files:read", "logs"),
    "": LogEntry("the folder of a ROS 2 bag", "retwin.data.logs.formats.bags:read", "logs"),
    ".db3": LogEntry("a file of a ROS 2 bag", "retwin.data.logs.formats.bags:read", "logs"),
    ".bag": LogEntry("ROS 1 bag", "retwin.data.logs.formats.bags:read", "logs"),
    ".parquet": LogEntry("Parquet", "retwin.data.logs.formats.arrow_tables:read", "logs"),
    ".arrow": LogEntry("Arrow IPC", "retwin.data.logs.formats.arrow_tables:read", "logs"),
    ".feather": LogEntry("Feather", "retwin.data.logs.formats.arrow_tables:read", "logs"),
    ".tdms": LogEntry("TDMS of LabVIEW", "retwin.data.logs.formats.tdms:read", "logs"),
    ".mf4": LogEntry("MDF 4", "retwin.data.logs.formats.mdf:read", "logs"),
    ".mdf": LogEntry("MDF 3", "retwin.data.logs.formats.mdf:read", "logs"),
    ".csv": LogEntry("CSV", "retwin.data.tables:read"),
    ".tsv": LogEntry("CSV with tabulators", "retwin.data.tables:read"),
    ".txt": LogEntry("CSV with any separator", "retwin.data.tables:read"),
}
"""By the suffix of the name; "" is a folder. They need a mapping to become trajectories."""

EXTRAS: Mapping[str, Extra] = {
    "bayes": Extra("Bayesian updating, the source pi_bayes", "sbi"),
    "compiled": Extra("a C compiler for StateTwin, where the system has none", "ziglang"),
    "fetch": Extra("downloads of public data", "pooch"),
    "flows": Extra("normalising flows as the distribution of the discrepancy", "zuko"),
    "fmu": Extra("twins that are FMUs", "fmpy"),
    "logs": Extra("logs: ROS bags, MCAP, Parquet, TDMS, MDF; conversion of units", "rosbags"),
    "monitor": Extra("the live monitor: its store, its streams and its page", "sqlalchemy"),
    "onnx": Extra("bundles that need no torch", "onnxruntime"),
    "parquet": Extra("Parquet files as a source of the monitor", "pyarrow"),
    "postgres": Extra("PostgreSQL as the store of the monitor", "psycopg"),
    "render": Extra("films drawn by MuJoCo, and MP4", "imageio_ffmpeg"),
    "rocket": Extra("the classifier rocket", "sktime"),
    "scale": Extra("Zarr folders, and Dask", "zarr"),
}
"""The extras that users may need."""

DOWNLOADS: Mapping[str, PublicFile] = {
    "armpi": PublicFile(
        url="https://raw.githubusercontent.com/JialingRichard/Digital-Twin-Fault-Diagnosis/"
        "HEAD/mydataset/my_dataset_test.mat",
        sha256="5d87fcdba86f6000dee5b7ec31a6e9a72276a9c4ff0b3a67d39a821cc5931b67",
        file="armpi/my_dataset_test.mat",
    )
}
"""Public files by the names of their cases, which `retwin.data.fetch` takes."""

_SURROGATE = ("surrogate", "")
_OUTPUT = ("residual", "output")
_COMMAND = ("residual", "command")
_LEAST_SQUARES = ("update", "pi_ls")
_BAYES = ("update", "pi_bayes")
_DYNAMICS = ("update", "dynamics")
_IDENTIFIED = ("surrogate", "pi_ls")
_IDENTIFIED_OUTPUT = ("residual", "pi_ls")

NEEDS: Mapping[Need, Sequence[Need]] = {
    _OUTPUT: (_SURROGATE,),
    _COMMAND: (_SURROGATE,),
    _IDENTIFIED: (_LEAST_SQUARES,),
    _IDENTIFIED_OUTPUT: (_IDENTIFIED,),
}
"""The jobs that must be done before those that sources need."""


def _source(
    title: str,
    real_data: str,
    *needs: Need,
    twin: str = "",
    diagnoser: str = "",
    marks: str = "",
    **others: Any,
) -> SourceEntry:
    """A source that a function of `retwin.study.sources` makes; `marks` are its true fields."""
    made = {"twin": twin, "diagnoser": diagnoser}
    others |= {kind: f"retwin.study.sources:{name}" for kind, name in made.items() if name}
    others |= dict.fromkeys(marks.split(), True)
    return SourceEntry(title, real_data, needs, **others)


SOURCES: Mapping[str, SourceEntry] = {
    "dt": _source(
        "Original twin", "none", diagnoser="recorded_twin", marks="recorded", role="plain"
    ),
    "twin": _source("Original twin", "none", twin="plain_twin", marks="simulates", role="plain"),
    "randomised": _source("Randomised twin", "none", twin="randomised_twin", marks="parametric"),
    "ibg": _source(
        "Surrogate only", "timing", _SURROGATE, twin="surrogate_alone", role="surrogate"
    ),
    "dt_noise": _source(
        "Surrogate with output noise", "healthy", _SURROGATE, twin="noisy_surrogate"
    ),
    "pi_ls": _source(
        "Identified twin (least squares)",
        "healthy",
        _LEAST_SQUARES,
        twin="updated",
        marks="parametric",
    ),
    "pi_bayes": _source(
        "Identified twin (Bayesian)",
        "healthy",
        _BAYES,
        twin="updated",
        marks="parametric",
        extra="bayes",
    ),
    "dann": _source(
        "Domain-adversarial network",
        "unlabelled",
        diagnoser="adversarial",
        marks="recorded network",
    ),
    "dann_transductive": _source(
        "Domain-adversarial network (uses test outputs)",
        "transductive",
        diagnoser="adversarial_transductive",
        marks="recorded network",
    ),
    "mean_corrected": _source(
        "Updated twin (mean only)", "healthy", _SURROGATE, _OUTPUT, twin="mean_corrected"
    ),
    "ibg_rg": _source(
        "Updated twin (outputs)",
        "healthy",
        _SURROGATE,
        _OUTPUT,
        twin="output_corrected",
        role="updated",
    ),
    "pi_ls_rg": _source(
        "Identified, then updated twin (outputs)",
        "healthy",
        _IDENTIFIED,
        _IDENTIFIED_OUTPUT,
        twin="identified_corrected",
        marks="parametric simulates",
    ),
    "dynamics": _source("Updated twin (dynamics)", "healthy", _DYNAMICS, twin="updated"),
    **{
        name: _source(title, "healthy", ("update", name), twin="updated", marks="simulates")
        for name, title in (
            ("fit", "Updated twin (chosen by its calibration)"),
            ("arx", "Linear model (ARX)"),
            ("narx", "Polynomial model (NARX)"),
            ("neural_ss", "Neural state-space model"),
            ("lstm", "LSTM"),
        )
    },
    "ibg_rg_command": _source(
        "Updated twin (command space)",
        "healthy",
        _SURROGATE,
        _COMMAND,
        twin="command_corrected",
        role="updated",
    ),
    "fine_tuned": _source(
        "Classifier fine-tuned on labelled faults",
        "labelled",
        *(_SURROGATE, _COMMAND, ("diagnosis", "ibg_rg_command")),
        diagnoser="fine_tuned",
        marks="network",
    ),
    "inversion": _source(
        "Physics inversion", "healthy", _SURROGATE, _COMMAND, diagnoser="inversion"
    ),
    "inversion_dynamics": _source(
        "Physics inversion (dynamics)", "healthy", _DYNAMICS, diagnoser="inversion_dynamics"
    ),
    "inversion_cnn": _source(
        "Physics inversion with classifier", "healthy", pool=("inversion", "ibg_rg_command")
    ),
}
"""In the order in which they are reported."""

CALIBRATE_ON = ("healthy", "all")
"""Which real trajectories a residual model may learn from."""

PRESETS: Mapping[str, Entry] = {
    "quick": Entry("retwin.study.plan:QUICK", "CNN at the sensor's rate, 5 runs"),
    "paper": Entry("retwin.study.plan:PAPER", "LSTM as in the paper, 10 runs"),
}
"""Classifier, training and number of runs of a study."""


def _metric(title: str, marks: str = "", better: int = 1, **others: Any) -> Metric:
    """A score; `marks` are its true fields."""
    others |= dict.fromkeys(marks.split(), True)
    return Metric(title, better, **others)


_ALL = "headline compared family"
METRICS: Mapping[str, Metric] = {
    "macro_f1": _metric("Macro-F1", f"{_ALL} selected", head="macro-F1"),
    "balanced_accuracy": _metric("Balanced accuracy", _ALL, head="balanced\nacc."),
    "auroc": _metric("Macro AUROC", _ALL, head="macro\nAUROC"),
    "healthy_recall": _metric(
        "Healthy recall", "headline selected compared", head="healthy\nrecall"
    ),
    "accuracy": _metric("Accuracy", "compared"),
    "auroc_micro": _metric("Micro AUROC"),
    "ece": _metric("ECE", "", -1),
    "ece_classwise": _metric("Class-wise ECE", "", -1),
    "rmse": _metric("RMSE", f"{_ALL} selected simulated", -1, unit="output", head="RMSE"),
    "nrmse": _metric("NRMSE", "headline simulated compared", -1, head="NRMSE"),
    "crps": _metric("CRPS", f"{_ALL} simulated", -1, unit="output", head="CRPS"),
    "nll": _metric("NLL", "headline simulated", -1, head="NLL"),
    "coverage50": _metric("Coverage of the 50 % band", "simulated", 0),
    "coverage90": _metric(
        "Coverage of the 90 % band", "headline selected simulated", 0, head="in 90 %\nband"
    ),
}
"""Scores of diagnoses, and of simulations, in the order in which they are shown."""


def metrics_with(*marks: str, simulated: bool) -> tuple[str, ...]:
    """The names of the metrics of simulations, or of diagnoses, with all of these fields true."""
    return tuple(
        name
        for name, each in METRICS.items()
        if each.simulated == simulated and all(getattr(each, mark) for mark in marks)
    )


def resolve(target: str) -> Any:
    """The object that "package.module:object" names, installed or in the current folder.

    Raises
    ------
    ImportError, AttributeError
        There is no such module or object; for each entry of the catalog there is one.

    """
    module, _, attribute = target.partition(":")
    return getattr(import_beside(module, Path.cwd()), attribute)


def lookup(entries: Mapping[str, T], name: str, argument: str) -> T:
    """The entry of that name.

    Raises
    ------
    InputError
        There is none; the message names `argument`.

    """
    return entries[one_of(argument, name, entries)]


def make(entries: Mapping[str, Entry], name: str, argument: str) -> Any:
    """The result of the target of that entry, called without arguments.

    Raises
    ------
    InputError
        There is no entry of that name; the message names `argument`.

    """
    return resolve(lookup(entries, name, argument).target)()


def classes(entries: Mapping[str, Entry], base: type = object) -> tuple[type, ...]:
    """The config classes of all entries: the kinds that a saved model may name.

    Parameters
    ----------
    entries : mapping of str to Entry
        Entries whose targets are config classes, or functions with `kinds`.
    base : type
        Only subclasses of this class, or classes with the methods of this protocol, are returned.

    """
    targets = [target for each in entries.values() for target in each.kinds or (each.target,)]
    return tuple(kind for kind in map(resolve, targets) if issubclass(kind, base))
