"""`export_fmu`: a twin with states as an FMU, with C99 source code inside."""

from __future__ import annotations

import re
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.checks import needs_extra, one_of, require
from retwin.deploy.fmu.description import (
    Variable,
    build_description,
    description,
    token_of,
    variables_of,
)
from retwin.errors import InputError, brief
from retwin.serialisation.files import write_atomically
from retwin.twins.compiled.kernel import compilers
from retwin.twins.state_twin import StateTwin
from retwin.update.dynamics.twin import DynamicsTwin

__all__ = ["ExportedFMU", "export_fmu"]

VERSIONS = ("2.0", "3.0")
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""As the compiled twin of Python, whose results it must have."""
HEADERS = {
    "2.0": ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    "3.0": ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
DATE = (1980, 1, 1, 0, 0, 0)
"""The date of the files in an FMU: the same twin gives the same bytes."""
TIMEOUT = 120
"""Seconds that the compiler may take."""


@dataclass(frozen=True)
class ExportedFMU:
    """What was written.

    Attributes
    ----------
    path : Path
        The file.
    variables : tuple of str
        Names of its variables, in the order of their value references.
    delay : float
        By how much in s its outputs are behind those of the twin: a sample period where commands
        are straight lines between samples, since the command at the end of a step is not known
        when the step begins.
    compiled : bool
        Whether it has a binary for this machine, beside its source code.

    """

    path: Path
    variables: tuple[str, ...]
    delay: float
    compiled: bool


def export_fmu(
    twin: StateTwin | DynamicsTwin, path: str | Path, *, version: str = "2.0", compiled: bool = True
) -> ExportedFMU:
    """Write a twin as an FMU for co-simulation.

    Its inputs are the commands, its outputs those of the twin, each with its mean and the 5 % and
    95 % quantiles. Parameters and starts of the twin are parameters of the FMU, beside `seed` and
    `noise` and faults of commands and sensors. With `noise`, outputs are drawn from the
    distribution of the twin; instances with the same seed draw the same. It has the twin's sample
    period as its internal step, whatever the communication step is.

    Parameters
    ----------
    twin : StateTwin or DynamicsTwin
        A twin with state equations, or corrected dynamics.
    path : path
        The file, *.fmu.
    version : str
        Of FMI, "2.0" or "3.0".
    compiled : bool
        Whether it also has a binary for this machine. Others are compiled from its source code, as
        by `fmpy compile`.

    Raises
    ------
    InputError
        Another twin, one whose commands are splines between samples, which are not known before
        later samples are; a file of another kind, or no C compiler that succeeds.

    """
    fmpy = needs_extra("fmpy", "fmu", "holds the headers of FMI")
    one_of("version", version, VERSIONS)
    path = Path(path)
    require(
        path.suffix == ".fmu",
        "path",
        expected="a file *.fmu",
        got=str(path),
        remedy="give a name that ends with .fmu",
    )
    corrected = _as_corrected(twin)
    equations = corrected.equations
    require(
        equations.interpolation != "spline",
        "twin",
        expected="commands that are held or straight lines between samples",
        got="splines, which depend on commands that an FMU does not know yet",
        remedy='make the twin with interpolation="linear"',
    )
    identifier = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"twin_{identifier}"
    variables, places = _variables(corrected)
    model = _model(corrected, variables, places)
    token = token_of(model + version)
    interface = "fmi2.c" if version == "2.0" else "fmi3.c"
    source = "\n".join([model, _beside("twin.c"), f'#define TOKEN "{token}"', _beside(interface)])
    headers = Path(str(fmpy.__file__)).parent / "c-code"
    content: dict[str, bytes] = {
        "modelDescription.xml": description(
            version,
            identifier,
            token,
            corrected.case or path.stem,
            variables,
            1 / corrected.rate,
        ),
        f"sources/{identifier}.c": source.encode(),
        **{f"sources/{name}": (headers / name).read_bytes() for name in HEADERS[version]},
    }
    if version == "3.0":
        content["sources/buildDescription.xml"] = build_description(identifier)
    if compiled:
        content[_binary(version, identifier)] = _compiled(content, identifier)
    with write_atomically(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, data in content.items():
            entry = zipfile.ZipInfo(name, DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data)
    delay = 1 / corrected.rate if equations.interpolation == "linear" else 0.0
    return ExportedFMU(path, tuple(each.name for each in variables), delay, compiled)


def _as_corrected(twin: StateTwin | DynamicsTwin) -> DynamicsTwin:
    """Corrected dynamics; those of a twin with states alone have no noise."""
    if isinstance(twin, DynamicsTwin):
        return twin
    if not isinstance(twin, StateTwin):
        raise InputError(
            "twin",
            expected="a twin with state equations, or corrected dynamics",
            got=type(twin).__name__,
            remedy="learn state equations for it: fit_state_surrogate",
        )
    from retwin.update.dynamics.domain import Domain

    names = twin.names
    values = twin.values(None, 1)[0]
    states, inputs = len(twin.states), len(twin.inputs)
    limits = twin.limits
    low, high = (
        (np.zeros(inputs), np.zeros(inputs))
        if limits is None
        else (np.array(limits.low, float), np.array(limits.high, float))
    )
    starts = values[len(names) - states :]
    middle = np.clip(0.0, low, high)
    domain = Domain(
        np.concatenate([starts, low]),
        np.concatenate([starts, high]),
        np.concatenate([starts, middle]),
        np.ones(states),
    )
    nothing = np.zeros(states)
    return DynamicsTwin(
        twin,
        values,
        np.zeros((len(values), 0)),
        nothing,
        nothing,
        nothing,
        np.zeros(len(twin.outputs)),
        1.0,
        domain,
        (),
    )


def _variables(twin: DynamicsTwin) -> tuple[list[Variable], list[int]]:
    """The variables, and the value references of parameters and starts; -1 for none."""
    equations = twin.equations
    inputs, outputs = len(equations.inputs), len(equations.outputs)
    states = len(equations.states)
    # Coefficients of the discrepancy have names of several words.
    shown = [each.name.isidentifier() for each in equations.parameters]
    values = twin.values.tolist()
    parameters = [
        (each, value)
        for each, value, own in zip(equations.parameters, values, shown, strict=False)
        if own
    ]
    starts = [
        (each.name, each.unit, value)
        for each, value in zip(equations.states, values[-states:], strict=True)
    ]
    made = variables_of(
        equations.inputs, equations.outputs, twin.domain.mean[states:].tolist(), parameters, starts
    )
    first = 1 + 2 * inputs + 5 * outputs
    places = []
    for own in [*shown, *[True] * states]:
        places.append(first if own else -1)
        first += own
    return made, places


def _model(twin: DynamicsTwin, variables: Sequence[Variable], places: Sequence[int]) -> str:
    """The equations of a twin and its numbers as C."""
    states = len(twin.process)
    low, high = (each[:states] for each in (twin.domain.low, twin.domain.high))
    sizes = {
        "NR": twin.factor.shape[1],
        "NV": len(variables) - 2,
        "SUBSTEPS": twin.equations.substeps,
        "LINEAR": int(twin.equations.interpolation == "linear"),
    }
    numbers = {"PERIOD": 1 / twin.rate, "WIDENING": twin.widening}
    arrays: Mapping[str, NDArray] = {
        "VALUES": twin.values,
        "FACTOR": twin.factor.ravel(),
        "START": twin.start_deviation,
        "PROCESS": twin.process,
        "PROPORTIONAL": twin.proportional,
        "RANGE": high - low,
        "NOISE": twin.noise,
        "FIRST": twin.domain.mean[states:],
    }
    lines = [f"#define {name} {size}" for name, size in sizes.items()]
    lines += [f"#define {name} {value!r}" for name, value in numbers.items()]
    lines += [_array("double", name, [repr(x) for x in a.tolist()]) for name, a in arrays.items()]
    lines.append(_array("int", "PLACE", [str(each) for each in places]))
    return "\n".join([twin.equations.model.steps_source, *lines, ""])


def _array(kind: str, name: str, items: Sequence[str]) -> str:
    """A constant array; C has none without elements."""
    text = ", ".join(items or ["0"])
    return f"static const {kind} {name}[{max(1, len(items))}] = {{{text}}};"


def _beside(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


def _binary(version: str, identifier: str) -> str:
    """Where the binary of this machine belongs."""
    from fmpy import platform, platform_tuple, sharedLibraryExtension

    folder = platform if version == "2.0" else platform_tuple
    return f"binaries/{folder}/{identifier}{sharedLibraryExtension}"


def _compiled(content: Mapping[str, bytes], identifier: str) -> bytes:
    """The binary of the source code."""
    reasons = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        for name, data in content.items():
            file = Path(folder, name)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)
        source, library = Path(folder, "sources", f"{identifier}.c"), Path(folder, "library")
        for command in compilers():
            given = [*command, *FLAGS, str(source), "-o", str(library), "-lm"]
            try:
                subprocess.run(given, check=True, capture_output=True, timeout=TIMEOUT)
                return library.read_bytes()
            except (OSError, subprocess.SubprocessError) as error:
                reasons.append(f"{command[0]}: {brief(error)}")
    raise InputError(
        "compiled",
        expected="a C compiler",
        got="; ".join(reasons) or "none that is installed",
        remedy="install one, or retwin[compiled], or give compiled=False",
    )
