"""C code that forwards FMI functions, generated from FMI's own headers."""

from __future__ import annotations

import re

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
HEAD = "/* Generated from FMI's headers. */"


def function_table(header: str) -> str:
    """Return C: the table of functions `Functions`, and their names with their places in it, `SYMBOLS`."""
    names = [name for _, name, _ in TYPEDEF.findall(COMMENT.sub("", header))]
    table = [f"    {name}TYPE *{name[4:]};" for name in names]
    symbols = [f'    {{"{name}", offsetof(Functions, {name[4:]})}},' for name in names]
    head = [HEAD, "typedef struct {", *table, "} Functions;", ""]
    head += ["static const struct {", "    const char *name;", "    size_t place;", "} SYMBOLS[] = {"]
    return "\n".join([*head, *symbols, "};", ""])


def forwarding_code(header: str, fmi: int) -> str:
    """Return C of all functions that only forward.

    Pending inputs are sent to the original before it is asked for anything.
    """
    functions = [HEAD]
    for result, name, text in TYPEDEF.findall(COMMENT.sub("", header)):
        plain = name[4:]
        if plain in HANDLED[fmi].split():
            continue
        parameters: list[str] = []
        for part in map(str.strip, text.split(",")):
            match = PARAMETER.fullmatch(part)
            if match is None or part == "void":
                continue
            is_named = match["type"] is not None and match["type"].strip() not in ("", "const")
            kind = match["type"] if is_named else f"{match['type'] or ''}{match['name']}"
            parameters.append(f"{' '.join(kind.split())} a{len(parameters)}{match['array'] or ''}")
        arguments = "".join(f", a{k}" for k in range(1, len(parameters)))
        call = f"FORWARD_SETTLED({plain}, (w->component{arguments}))"
        if plain.startswith(UNRELATED):
            call = f"FORWARD({plain}{arguments})"
        functions.append(f"{result.strip()} {name}({', '.join(parameters)})\n{{\n    {call};\n}}\n")
    return "\n".join(functions)
