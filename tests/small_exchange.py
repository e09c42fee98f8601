"""FMUs of FMI 2.0 for model exchange, written by a test as a few lines of C; compiled once a session."""

from __future__ import annotations

import platform
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import pytest

from cosim.fmi.native.compiler import compiler

SOURCE = """
#include <math.h>
#include <stdlib.h>
#include <string.h>
typedef struct {{ double x[16], next, t; int initializing, calls; double seen_t[9999], seen_x[9999]; }} M;
typedef struct {{ int more, end, nominals, changed, defined; double time; }} Event;
#define x m->x
static void derive(M *m) {{ {derive} }}
static int completed(M *m) {{ {completed}; return 0; }}
static int event(M *m) {{ int changed = 0; {event}; return changed; }}
static void indicate(M *m, double *z) {{ {indicate} }}
#undef x
typedef void *C;
const char *fmi2GetTypesPlatform(void) {{ return "default"; }}
const char *fmi2GetVersion(void) {{ return "2.0"; }}
int fmi2SetDebugLogging(C c, int on, size_t n, const char *const k[]) {{ return 0; }}
C fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *f, int v, int l) {{
    static const double start[] = {{ {starts} }};
    M *m = calloc(1, sizeof(M));
    memcpy(m->x, start, sizeof start);
    m->next = 1e300;
    return m;
}}
void fmi2FreeInstance(C c) {{ free(c); }}
int fmi2SetupExperiment(C c, int d, double tol, double s, int e, double stop) {{ ((M *)c)->t = s; return 0; }}
int fmi2EnterInitializationMode(C c) {{ ((M *)c)->initializing = 1; return 0; }}
int fmi2ExitInitializationMode(C c) {{ derive(c); ((M *)c)->initializing = 0; return 0; }}
int fmi2Terminate(C c) {{ return 0; }}
int fmi2Reset(C c) {{ return 0; }}
int fmi2GetReal(C c, const unsigned v[], size_t n, double y[]) {{
    derive(c); while (n--) y[n] = ((M *)c)->x[v[n]]; return 0; }}
int fmi2SetReal(C c, const unsigned v[], size_t n, const double y[]) {{
    while (n--) ((M *)c)->x[v[n]] = y[n]; return 0; }}
int fmi2EnterEventMode(C c) {{ return 0; }}
int fmi2NewDiscreteStates(C c, Event *e) {{
    M *m = c; memset(e, 0, sizeof *e); e->changed = event(m); e->defined = m->next < 1e299;
    e->time = m->next; return 0; }}
int fmi2EnterContinuousTimeMode(C c) {{ return 0; }}
int fmi2CompletedIntegratorStep(C c, int no, int *asks, int *ends) {{
    int wish = completed(c); *asks = wish == 1; *ends = wish == 2; return 0; }}
int fmi2SetTime(C c, double t) {{ ((M *)c)->t = t; return 0; }}
int fmi2SetContinuousStates(C c, const double s[], size_t n) {{
    memcpy(((M *)c)->x, s, n * sizeof *s); return 0; }}
int fmi2GetContinuousStates(C c, double s[], size_t n) {{ memcpy(s, ((M *)c)->x, n * sizeof *s); return 0; }}
int fmi2GetDerivatives(C c, double d[], size_t n) {{
    derive(c); memcpy(d, ((M *)c)->x + n, n * sizeof *d); return 0; }}
int fmi2GetEventIndicators(C c, double z[], size_t n) {{ indicate(c, z); return 0; }}
int fmi2GetNominalsOfContinuousStates(C c, double s[], size_t n) {{ while (n--) s[n] = 1; return 0; }}
int fmi2GetFMUstate(C c, C *s) {{ if (!*s) *s = malloc(sizeof(M)); memcpy(*s, c, sizeof(M)); return 0; }}
int fmi2SetFMUstate(C c, C s) {{ memcpy(c, s, sizeof(M)); return 0; }}
int fmi2FreeFMUstate(C c, C *s) {{ free(*s); *s = NULL; return 0; }}
#define NOT(name) int fmi2##name(C c) {{ return 3; }}
NOT(GetInteger) NOT(GetBoolean) NOT(GetString) NOT(SetInteger) NOT(SetBoolean) NOT(SetString) NOT(CancelStep)
NOT(SerializedFMUstateSize) NOT(SerializeFMUstate) NOT(DeSerializeFMUstate) NOT(GetDirectionalDerivative)
NOT(SetRealInputDerivatives) NOT(GetRealOutputDerivatives) NOT(GetStatus) NOT(GetRealStatus) NOT(GetIntegerStatus)
NOT(GetBooleanStatus) NOT(GetStringStatus)
int fmi2DoStep(C c, double t, double h, int no) {{ ((M *)c)->t = t + h; return 0; }}
"""


@cache
def _library(source: str) -> bytes:
    command = compiler()
    if command is None or platform.system() != "Linux" or platform.machine() != "x86_64":
        pytest.skip("no C compiler for this platform")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "small.c"
        file.write_text(source, encoding="utf-8")
        library = file.with_suffix(".so")
        subprocess.run([*command, "-O1", "-w", "-shared", "-fPIC", "-o", str(library), str(file), "-lm"], check=True)
        return library.read_bytes()


def small_fmu(
    path: Path,
    states: Mapping[str, float],
    others: Sequence[str] = (),
    *,
    derive: str = "",
    indicate: str = "",
    indicators: int = 0,
    event: str = "",
    completed: str = "",
    inputs: Sequence[str] = (),
    dependencies: str | None = None,
    at_start: str | None = None,
    needs_steps: bool = False,
) -> Path:
    """Write an FMU: x[k] are its states, then their derivatives, then the other variables.

    Args:
        derive: C that sets derivatives and other variables, from x[k], m->t and m->initializing.
        completed: C after an accepted step of the solver; it may return 1 to ask for an event and 2 to end.
        dependencies: Declared dependencies of the outputs; None for none declared.
        at_start: Declared dependencies of the outputs at initialization.
    """
    names = [*states, *(f"der({n})" for n in states), *others]
    variables = []
    for k, name in enumerate(names):
        if name in inputs:
            kind, more = 'causality="input"', 'start="0"'
        elif k < len(states):
            kind, more = 'causality="output" initial="exact"', f'start="{states[name]!r}"'
        elif k < 2 * len(states):
            kind, more = 'causality="local"', f'derivative="{k - len(states) + 1}"'
        else:
            kind, more = 'causality="output"', ""
        variables.append(f'<ScalarVariable name="{name}" valueReference="{k}" {kind}><Real {more}/></ScalarVariable>')
    outputs = [k + 1 for k, v in enumerate(variables) if 'causality="output"' in v]

    def unknowns(tag: str, numbers: Sequence[int], on: str | None) -> str:
        given = "" if on is None else f' dependencies="{on}"'
        return f"<{tag}>" + "".join(f'<Unknown index="{n}"{given}/>' for n in numbers) + f"</{tag}>" if numbers else ""

    rates = unknowns("Derivatives", [len(states) + k + 1 for k in range(len(states))], None)
    start = unknowns("InitialUnknowns", outputs, at_start) if at_start is not None else ""
    way = (
        f'<ModelExchange modelIdentifier="small" completedIntegratorStepNotNeeded="{str(not needs_steps).lower()}"/>'
        if states
        else '<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true" '
        'canGetAndSetFMUstate="true"/>'
    )
    structure = f"{unknowns('Outputs', outputs, dependencies)}{rates}{start}"
    text = (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="small" guid="g" '
        f'numberOfEventIndicators="{indicators}">{way}<ModelVariables>{"".join(variables)}</ModelVariables>'
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )
    starts = ", ".join(repr(float(states.get(name, 0.0))) for name in names)
    source = SOURCE.format(derive=derive, completed=completed, event=event, indicate=indicate, starts=starts)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.writestr("binaries/linux64/small.so", _library(source))
    return path
