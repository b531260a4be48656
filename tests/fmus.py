"""FMUs for the tests: one compiled from C (FMI 3), one exported with pythonfmu (FMI 2)."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import fmpy

HEADERS = Path(fmpy.__file__).parent / "c-code"
COMPILER = os.environ.get("CC", "cc")

# A first-order lag, tau x' = gain u - x, exact for an input that is held; and troubles on request.
SOURCE = r"""
#include "fmi3Functions.h"
#include <fenv.h>
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>
#ifdef __SSE__
#include <xmmintrin.h>
#endif

typedef struct {
    double u, gain, tau, x, pair[2], sums[2], fixed;
    int trouble, seen;
    long long mode;
    bool on;
    fmi3LogMessageCallback log;
} Lag;

static double left_over; /* x of the last run of any instance, which RESET == 3 begins with */

static void begin(Lag *s) {
    s->u = 0; s->gain = 1; s->tau = 0.1; s->x = RESET == 3 ? left_over : 0; s->trouble = 0;
    s->seen = 0; s->on = true; s->pair[0] = 0; s->pair[1] = 5; s->mode = 1; s->fixed = 3;
    s->sums[0] = 0; s->sums[1] = 0;
}

/* Counts instances (i) and runs (r) in the file that LAG_LOG names. */
static void count(char kind) {
    char *name = getenv("LAG_LOG");
    FILE *file = name ? fopen(name, "a") : NULL;
    if (file) { fputc(kind, file); fclose(file); }
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String a, fmi3String b, fmi3String c, fmi3Boolean d,
        fmi3Boolean e, fmi3Boolean f, fmi3Boolean g, const fmi3ValueReference h[], size_t i,
        fmi3InstanceEnvironment j, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback k) {
    if (LOAD == 1) return NULL;
    if (LOAD == 2) raise(SIGSEGV);
    Lag *s = calloc(1, sizeof(Lag));
    begin(s);
    s->log = log;
    count('i');
    return s;
}

void fmi3FreeInstance(fmi3Instance p) { free(p); }

fmi3Status fmi3Reset(fmi3Instance p) {
    if (RESET == 1) return fmi3Error;
    if (RESET == 4) raise(SIGSEGV);
    if (RESET != 2) begin(p);
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance p, fmi3Boolean a, fmi3Float64 b, fmi3Float64 c,
        fmi3Boolean d, fmi3Float64 e) { return fmi3OK; }

fmi3Status fmi3ExitInitializationMode(fmi3Instance p) { count('r'); return fmi3OK; }

static double *real(Lag *s, fmi3ValueReference r) {
    return r == 1 ? &s->u : r == 2 ? &s->gain : r == 3 ? &s->tau : r == 4 ? &s->x
        : r == 8 ? s->pair : r == 10 ? s->sums : r == 12 ? &s->fixed : NULL;
}

static int *whole(Lag *s, fmi3ValueReference r) {
    return r == 5 ? &s->trouble : r == 6 ? &s->seen : NULL;
}

static long long *choice(Lag *s, fmi3ValueReference r) { return r == 11 ? &s->mode : NULL; }

#define ACCESS(VERB, TYPE, T, PLACE, CONST, LEFT, RIGHT)                                        \
    fmi3Status fmi3##VERB##TYPE(fmi3Instance p, const fmi3ValueReference r[], size_t n,         \
                                CONST T v[], size_t m) {                                        \
        size_t k = 0;                                                                           \
        for (size_t i = 0; i < n; i++) {                                                        \
            if (!PLACE(p, r[i])) return fmi3Error;                                              \
            for (int j = 0; j < (r[i] == 8 || r[i] == 10 ? 2 : 1); j++, k++) LEFT = RIGHT;      \
        }                                                                                       \
        return k == m ? fmi3OK : fmi3Error;                                                     \
    }
ACCESS(Get, Float64, fmi3Float64, real, , v[k], real(p, r[i])[j])
ACCESS(Set, Float64, fmi3Float64, real, const, real(p, r[i])[j], v[k])
ACCESS(Get, Int32, fmi3Int32, whole, , v[k], *whole(p, r[i]))
ACCESS(Set, Int32, fmi3Int32, whole, const, *whole(p, r[i]), v[k])
ACCESS(Get, Int64, fmi3Int64, choice, , v[k], *choice(p, r[i]))
ACCESS(Set, Int64, fmi3Int64, choice, const, *choice(p, r[i]), v[k])

fmi3Status fmi3SetBoolean(fmi3Instance p, const fmi3ValueReference r[], size_t n,
        const fmi3Boolean v[], size_t m) {
    ((Lag *)p)->on = v[0];
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance p, fmi3Float64 t, fmi3Float64 h, fmi3Boolean a,
        fmi3Boolean *event, fmi3Boolean *end, fmi3Boolean *early, fmi3Float64 *last) {
    Lag *s = p;
    *event = *end = *early = false;
    *last = t + h;
    s->seen = s->trouble;
    if (s->trouble == 1) for (;;) pause();
    if (s->trouble == 2) raise(SIGSEGV);
    if (s->trouble == 3) {
        s->log(NULL, fmi3Error, "status", "trouble was requested");
        return fmi3Error;
    }
    if (s->trouble == 4) s->x = NAN;
    if (s->trouble == 5) return fmi3Fatal;
    if (s->trouble == 6) _exit(3);
    if (s->trouble == 7) *end = true;
    if (s->trouble == 111) exit(75);
    if (s->trouble == 112) exit(0);
    if (s->trouble == 113) return -1;
    if (s->trouble == 114) {
        fesetround(FE_UPWARD);
#ifdef __SSE__
        _mm_setcsr(_mm_getcsr() | 0x8040); /* flush tiny numbers to zero */
#endif
    }
    if (s->trouble == 115) for (int i = 0; i < 1024; i++) if (write(i, "hello\n", 6)) continue;
    if (s->trouble == 116) for (int i = 3; i < 1024; i++) close(i);
    if (s->trouble == 117) for (int i = 3; i < 64; i++) {
        char zeros[4096] = {0}, numbers[4] = {0, 0, 1, 0};
        if (write(i, i % 2 ? zeros : numbers, i % 2 ? 4096 : 4)) continue;
    }
    if (s->trouble == 118) for (int i = 0; i < 4; i++) {
        pid_t child = fork();
        if (!child) for (;;) pause();
        FILE *file = fopen(getenv("LAG_FORKS"), "a");
        if (file) { fprintf(file, "%d\n", (int)child); fclose(file); }
    }
    if (s->trouble == 119) s->x = 1e308;
    double target = s->on ? s->gain * s->u : 0;
    s->x = target + (s->x - target) * exp(-h / s->tau);
    s->sums[0] += s->pair[0] * s->fixed;
    s->sums[1] += s->pair[1] * s->mode * s->gain;
    left_over = s->x;
    return fmi3OK;
}
"""

BY_MACRO = [
    f"fmi3{verb}{kind}" for verb in ("Get", "Set") for kind in ("Float64", "Int32", "Int64")
]

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Lag" instantiationToken="{lag}">
  <CoSimulation modelIdentifier="Lag" canHandleVariableCommunicationStepSize="true"/>
  <UnitDefinitions><Unit name="V"/><Unit name="m"/><Unit name="s"/></UnitDefinitions>
  <TypeDefinitions>
    <Float64Type name="Length" unit="m"/>
    <EnumerationType name="Mode"><Item name="slow" value="1"/><Item name="fast" value="4"/>
    </EnumerationType>
  </TypeDefinitions>
  <ModelVariables>
    <Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>
    <Float64 name="u" valueReference="1" causality="input" unit="V" min="-10" max="10" start="0"/>
    <Float64 name="gain" valueReference="2" causality="parameter" variability="fixed" start="1"/>
    <Float64 name="tau" valueReference="3" causality="parameter" variability="fixed" unit="s"
             start="0.1"/>
    <Float64 name="x" valueReference="4" causality="output" declaredType="Length"/>
    <Int32 name="trouble" valueReference="5" causality="input" variability="discrete" start="0"/>
    <Int32 name="seen" valueReference="6" causality="output" variability="discrete"/>
    <Boolean name="on" valueReference="7" causality="input" variability="discrete" start="true"/>
    <Float64 name="pair" valueReference="8" causality="input" start="0 5"><Dimension start="2"/>
    </Float64>
    <Float64 name="sums" valueReference="10" causality="local"><Dimension start="2"/></Float64>
    <Enumeration name="mode" valueReference="11" causality="input" declaredType="Mode" start="1"/>
    <Float64 name="fixed" valueReference="12" causality="input" min="3" max="3" start="3"/>
  </ModelVariables>
  <ModelStructure>
    <Output valueReference="4"/><Output valueReference="6"/>
  </ModelStructure>
</fmiModelDescription>
"""

SCRIPT = '''"""A first-order lag, exact for an input that is held."""

import math

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real


class PyLag(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u, self.gain, self.x, self.level, self.on, self.sum = 0.0, 1.0, 0.0, 0, True, 0
        output, command = Fmi2Causality.output, Fmi2Causality.input
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.tunable}
        held = {"causality": command, "variability": Fmi2Variability.discrete}
        self.register_variable(Real("u", causality=command, start=0.0))
        self.register_variable(Real("gain", start=1.0, **fixed))
        self.register_variable(Integer("level", start=0, **held))
        self.register_variable(Boolean("on", start=True, **held))
        self.register_variable(Real("x", causality=output))
        self.register_variable(
            Integer("sum", causality=output, variability=Fmi2Variability.discrete)
        )

    def do_step(self, current_time, step_size):
        target = self.gain * self.u if self.on else 0.0
        self.x = target + (self.x - target) * math.exp(-step_size / 0.1)
        self.sum += self.level
        return True
'''


def c_fmu(folder: Path, *, reset: int = 0, load: int = 0, name: str = "Lag") -> Path:
    """An FMI 3 FMU compiled from C, `name`.fmu in `folder`.

    Parameters
    ----------
    folder: where to.
    reset: 0 works, 1 gives an error, 2 reports success but changes nothing, 3 restores all but a
        variable that new instances begin with as well, 4 crashes.
    load: 0 works, 1 gives no instance, 2 crashes.
    name: of the file.

    """
    header = (HEADERS / "fmi3Functions.h").read_text("utf-8")
    every = re.findall(r"FMI3_Export fmi3\w+TYPE\s+(fmi3\w+);", header)
    missing = [f for f in every if f"{f}(" not in SOURCE and f not in BY_MACRO]
    stubs = "".join(f"int {function}(void) {{ return 3; }}\n" for function in missing)
    build = folder / f"build-{name}"
    build.mkdir(parents=True)
    (build / "lag.c").write_text(SOURCE, encoding="utf-8")
    (build / "stubs.c").write_text(stubs, encoding="utf-8")
    library = build / f"Lag{fmpy.sharedLibraryExtension}"
    macros = [f"-DRESET={reset}", f"-DLOAD={load}"]
    sources = [str(build / "lag.c"), str(build / "stubs.c")]
    flags = ["-shared", "-fPIC", "-O1", "-fno-builtin", *macros, f"-I{HEADERS}"]
    subprocess.run([COMPILER, *flags, *sources, "-o", str(library), "-lm"], check=True)
    path = folder / f"{name}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", DESCRIPTION)
        archive.write(library, f"binaries/{fmpy.platform_tuple}/{library.name}")
    return path


def python_fmu(folder: Path) -> Path:
    """An FMI 2 FMU that runs Python, PyLag.fmu in `folder`."""
    script = folder / "pylag.py"
    script.write_text(SCRIPT, encoding="utf-8")
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", str(script), "-d", str(folder)]
    subprocess.run(command, check=True, capture_output=True)
    return folder / "PyLag.fmu"


def changed(path: Path, name: str, edit: Callable[[str, bytes], tuple[str, bytes] | None]) -> Path:
    """A copy of an FMU, `name`.fmu beside it, whose members went through `edit`; None drops one."""
    copy = path.with_name(f"{name}.fmu")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(copy, "w") as new:
        for member in old.namelist():
            kept = edit(member, old.read(member))
            if kept is not None:
                new.writestr(*kept)
    return copy


def described(path: Path, name: str, old: str, new: str) -> Path:
    """A copy of an FMU whose description has `new` instead of `old`."""

    def edit(member: str, content: bytes) -> tuple[str, bytes]:
        if member == "modelDescription.xml":
            text = content.decode("utf-8")
            assert old in text
            content = text.replace(old, new).encode("utf-8")
        return member, content

    return changed(path, name, edit)
