"""C code that forwards FMI functions, generated from FMI's own headers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

TYPEDEF = re.compile(r"typedef\s+([^;()]*?)\b(fmi[23]\w+)TYPE\s*\(([^;]*?)\)\s*;", re.DOTALL)
COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
PARAMETER = re.compile(r"(?P<type>.*?[\s*])?(?P<name>\w+)\s*(?P<array>\[\])?", re.DOTALL)
# Functions whose effect on the wrapper is hand-written in C, without the prefix; others are forwarded as they are.
HANDLED = {
    2: """
        GetTypesPlatform GetVersion Instantiate FreeInstance SetupExperiment EnterInitializationMode
        ExitInitializationMode Reset GetReal SetReal GetFMUstate SetFMUstate FreeFMUstate SerializedFMUstateSize
        SerializeFMUstate DeSerializeFMUstate GetDirectionalDerivative EnterEventMode NewDiscreteStates
        EnterContinuousTimeMode CompletedIntegratorStep SetTime SetContinuousStates GetDerivatives
        SetRealInputDerivatives GetRealOutputDerivatives DoStep
    """,
    3: """
        GetVersion InstantiateModelExchange InstantiateCoSimulation InstantiateScheduledExecution FreeInstance
        EnterInitializationMode ExitInitializationMode Reset GetFloat64 SetFloat64 GetFMUState SetFMUState FreeFMUState
        SerializedFMUStateSize SerializeFMUState DeserializeFMUState GetDirectionalDerivative GetAdjointDerivative
        EnterEventMode UpdateDiscreteStates EnterContinuousTimeMode CompletedIntegratorStep SetTime SetContinuousStates
        GetContinuousStateDerivatives GetOutputDerivatives DoStep
    """,
}
# Functions that need no current inputs: before them nothing is computed.
UNRELATED = ("Set", "Cancel", "Terminate", "EnterConfigurationMode", "ExitConfigurationMode")


@dataclass(frozen=True)
class Function:
    """A function of FMI: result, name without prefix, and parameters."""

    result: str
    name: str
    parameters: tuple[tuple[str, str], ...]  # type before the name, "[]" or "" behind it


def functions_of(header: str) -> list[Function]:
    """Return the function types of FMI's header."""
    found = TYPEDEF.findall(COMMENT.sub("", header))
    return [Function(result.strip(), name[4:], tuple(_parameters(text))) for result, name, text in found]


def _parameters(text: str) -> Iterator[tuple[str, str]]:
    for part in text.split(","):
        match = PARAMETER.fullmatch(part.strip())
        if match is None or part.strip() == "void":
            continue
        is_named = match["type"] is not None and match["type"].strip() not in ("", "const")
        kind = match["type"] if is_named else f"{match['type'] or ''}{match['name']}"
        yield " ".join(kind.split()), match["array"] or ""


def function_table(header: str, fmi: int) -> str:
    """Return C: the table of functions `Functions`, and their names with their places in it, `SYMBOLS`."""
    functions = functions_of(header)
    table = [f"    fmi{fmi}{f.name}TYPE *{f.name};" for f in functions]
    symbols = [f'    {{"fmi{fmi}{f.name}", offsetof(Functions, {f.name})}},' for f in functions]
    head = ["/* Generated from FMI's headers. */", "typedef struct {", *table, "} Functions;", ""]
    head += ["static const struct {", "    const char *name;", "    size_t place;", "} SYMBOLS[] = {"]
    return "\n".join([*head, *symbols, "};", ""])


def forwarding_code(header: str, fmi: int) -> str:
    """Return C of all functions that only forward.

    Pending inputs are sent to the original before it is asked for anything.
    """
    functions = [f for f in functions_of(header) if f.name not in HANDLED[fmi].split()]
    return "\n".join(["/* Generated from FMI's headers. */", *(_forward(f, fmi) for f in functions)])


def _forward(f: Function, fmi: int) -> str:
    parameters = ", ".join(f"{kind} a{k}{array}" for k, (kind, array) in enumerate(f.parameters))
    arguments = "".join(f", a{k}" for k in range(1, len(f.parameters)))
    is_unrelated = f.name.startswith(UNRELATED)
    call = f"FORWARD({f.name}{arguments})" if is_unrelated else f"FORWARD_SETTLED({f.name}, (w->component{arguments}))"
    return f"{f.result} fmi{fmi}{f.name}({parameters})\n{{\n    {call};\n}}\n"
