"""`export_fmu`: an updated twin as an FMU, with C99 source code inside."""

from __future__ import annotations

import os
import re
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import NDArray

from retwin.checks import ends_in, given, needs_extra, one_of
from retwin.compiler import build, c_source, try_compilers
from retwin.deploy.fmu.description import build_description, description, token_of
from retwin.deploy.fmu.states import states_text
from retwin.deploy.fmu.surrogates import surrogate_text
from retwin.deploy.fmu.text import Text
from retwin.errors import InputError
from retwin.serialisation.files import write_atomically
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.corrected import CorrectedTwin
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.unknowns import state_names
from retwin.update.residual.stationary import StationaryResidual
from retwin.update.surrogate import Surrogate

VERSIONS = ("2.0", "3.0")
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""As the compiled twin of Python, whose results it must have."""
HEADERS = {
    "2.0": ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    "3.0": ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
DATE = (1980, 1, 1, 0, 0, 0)
"""The date of the files in an FMU: the same twin gives the same bytes."""


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
    omitted : tuple of str
        Operators of the correction that it lacks: a sensor behind delays and offsets.

    """

    path: Path
    variables: tuple[str, ...]
    delay: float
    compiled: bool
    omitted: tuple[str, ...] = ()


def export_fmu(
    twin: StateTwin | DynamicsTwin | Surrogate | CorrectedTwin,
    path: str | Path,
    *,
    version: str = "2.0",
    compiled: bool = True,
    commands: NDArray | None = None,
) -> ExportedFMU:
    """Write a twin as an FMU for co-simulation.

    Its inputs are the commands, its outputs those of the twin, each with its mean and the 5 % and
    95 % quantiles. Parameters and starts of the twin are parameters of the FMU, beside `seed` and
    `noise` and faults of commands and sensors. With `noise`, outputs are drawn from the
    distribution of the twin; instances with the same seed draw the same. It has the twin's sample
    period as its internal step, whatever the communication step is.

    Parameters
    ----------
    twin : StateTwin, DynamicsTwin, Surrogate or CorrectedTwin
        A twin with state equations, also with its errors as noise, which is white in the FMU,
        corrected dynamics, or a surrogate, alone, with a residual at each sample (`Additive`), or
        with delays and offsets (`CommandSpace`, `DelayOffset`), of which one z is drawn for a whole
        simulation.
    path : path
        The file, *.fmu.
    version : str
        Of FMI, "2.0" or "3.0".
    compiled : bool
        Whether it also has a binary for this machine. Others are compiled from its source code, as
        by `fmpy compile`.
    commands : NDArray, optional
        (n, T, d_u), commands like those of the task, at the rate of the twin: with delays and
        offsets z is drawn at the poses of their segments.

    Raises
    ------
    InputError
        Another twin; one whose outputs depend on later samples, as with commands that are splines
        between samples, segments that are found in the path, or a sensor that is sampled; a file of
        another kind, or no C compiler that succeeds.

    """
    fmpy = needs_extra("fmpy", "fmu", "holds the headers of FMI")
    one_of("version", version, VERSIONS)
    path = Path(path)
    ends_in("path", path, (".fmu",), remedy="give a name that ends with .fmu")
    text = _text(twin, commands)
    identifier = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"twin_{identifier}"
    token = token_of(text.source + version)
    fmi = f"fmi{version[0]}"
    head = f'#include "{fmi}Functions.h"\n#define TOKEN "{token}"\ntypedef {fmi}Boolean Boolean;'
    source = "\n".join([text.source, head, c_source(__package__, "interface.c", f"{fmi}.c")])
    headers = Path(str(fmpy.__file__)).parent / "c-code"
    # A twin knows its case by the path of its file, which concerns nobody else.
    about = Path(text.about).stem if os.path.isabs(text.about) else text.about or path.stem
    described = description(version, identifier, token, about, text.variables, 1 / text.rate)
    content: dict[str, bytes] = {
        "modelDescription.xml": described,
        f"sources/{identifier}.c": source.encode(),
        **{f"sources/{name}": (headers / name).read_bytes() for name in HEADERS[version]},
    }
    if version == "3.0":
        content["sources/buildDescription.xml"] = build_description(identifier)
    if compiled:
        _add_binary(content, version, identifier)
    with write_atomically(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, data in content.items():
            entry = zipfile.ZipInfo(name, DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data)
    names = tuple(each.name for each in text.variables)
    return ExportedFMU(path, names, text.delay, compiled, text.omitted)


def _text(twin: object, commands: NDArray | None) -> Text:
    """The C text of a twin of any kind that has one."""
    stationary = isinstance(getattr(twin, "residual", None), StationaryResidual)
    noisy = stationary and state_names(getattr(getattr(twin, "surrogate", None), "twin", None))
    if isinstance(twin, StateTwin | DynamicsTwin) or noisy:
        return states_text(twin)  # type: ignore[arg-type]
    if isinstance(twin, Surrogate | CorrectedTwin):
        return surrogate_text(twin, commands)
    expected = "a twin with state equations, corrected dynamics, or a surrogate"
    remedy = "learn state equations for it: fit_state_surrogate"
    raise InputError("twin", expected=expected, got=type(twin).__name__, remedy=remedy)


def _add_binary(content: dict[str, bytes], version: str, identifier: str) -> None:
    """Compile the source code for this machine, and add the binary where it belongs."""
    from fmpy import platform, platform_tuple, sharedLibraryExtension

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        for name, data in content.items():
            file = Path(folder, name)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)
        source, library = Path(folder, "sources", f"{identifier}.c"), Path(folder, "library")

        def compile_with(command: Sequence[str]) -> bytes:
            build(command, source, library)
            return library.read_bytes()

        made, reasons = try_compilers(compile_with, FLAGS)
    remedy = "install one, or retwin[compiled], or give compiled=False"
    binary = given("compiled", made, "a C compiler", got=reasons or "none", remedy=remedy)
    place = platform if version == "2.0" else platform_tuple
    content[f"binaries/{place}/{identifier}{sharedLibraryExtension}"] = binary
