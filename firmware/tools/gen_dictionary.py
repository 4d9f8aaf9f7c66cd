"""Collects the declarations of core/declare.h from C sources and writes the tables and the dictionary.

Usage: gen_dictionary.py -o OUT.c [--json OUT.json] [-D NAME=VALUE]... [--cc CC] SOURCE.c...

Each source goes through ``CC -E -DCANDUCTOR_COLLECT``, where a declaration becomes ``@@kind(arguments)@@``.
The result is one C file that defines what the declarations promise. It needs no file that lists commands, and
only Python's standard library. A contradiction (one id symbol for two texts, two commands of one name, ...)
ends the build with one sentence.
"""

import argparse
import ast
import hashlib
import json
import operator
import re
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn, TypeVar

V = TypeVar("V")
FIRMWARE = Path(__file__).resolve().parent.parent
RELEASE = "0.1.0"
FIXED_IDS = {"identify": 1, "identify_response": 0}
IN_SHUTDOWN, FREQUENT = 1, 2
TYPES = {
    "%u": "WIRE_U32",
    "%i": "WIRE_I32",
    "%hu": "WIRE_U16",
    "%hi": "WIRE_I16",
    "%c": "WIRE_U8",
    "%*s": "WIRE_BYTES",
    "%.*s": "WIRE_BYTES",
}
MESSAGE_ARGS_MAX = 12
MARKER = re.compile(r"@@(\w+)\((.*?)\)@@", re.DOTALL)
STRING = re.compile(r'"(?:[^"\\]|\\.)*"')
OPERATORS: dict[type[ast.AST], Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.FloorDiv: operator.floordiv,
    ast.BitOr: operator.or_,
    ast.LShift: operator.lshift,
}


def fail(sentence: str) -> NoReturn:
    """End the build with one sentence."""
    sys.exit(f"gen_dictionary: {sentence}")


@dataclass
class Declarations:
    """Everything declared in one build, by kind, in the order of the sources."""

    commands: dict[str, tuple[str, int]] = field(default_factory=dict)  # format -> (function, flags)
    responses: dict[str, str] = field(default_factory=dict)  # symbol -> format
    constants: dict[str, int | str] = field(default_factory=dict)
    enumerations: dict[str, dict[str, int | list[int]]] = field(default_factory=dict)
    strings: dict[str, str] = field(default_factory=dict)  # symbol -> text
    functions: dict[str, list[str]] = field(default_factory=lambda: {"task": [], "init": [], "shutdown": []})

    def add(self, kind: str, arguments: list[str]) -> None:
        """Take one marker."""
        if kind == "command":
            self.once(self.commands, text(arguments[2]), (arguments[0], number(arguments[1])))
        elif kind == "response":
            self.once(self.responses, arguments[0], text(arguments[1]))
        elif kind == "constant":
            self.once(self.constants, text(arguments[0]), number(arguments[1]))
        elif kind == "constant_str":
            self.once(self.constants, text(arguments[0]), text(arguments[1]))
        elif kind == "enumeration":
            first, count = number(arguments[2]), number(arguments[3])
            values = self.enumerations.setdefault(text(arguments[0]), {})
            self.once(values, text(arguments[1]), first if count == 1 else [first, count])
        elif kind == "string":
            self.once(self.strings, arguments[0], text(arguments[1]))
        elif kind in self.functions:
            self.functions[kind].append(arguments[0])
        else:
            fail(f"unknown declaration {kind}")

    @staticmethod
    def once(into: dict[str, V], key: str, value: V) -> None:
        """Add to a table; the same declaration may be repeated, a different one may not."""
        if into.setdefault(key, value) != value:
            fail(f"{key!r} is declared twice: as {into[key]!r} and as {value!r}")


def number(expression: str) -> int:
    """Evaluate an integer constant expression of C."""
    plain = re.sub(r"\b(0[xX][0-9a-fA-F]+|\d+)[uUlL]*", r"\1", expression).replace("/", "//")

    def value(node: ast.AST) -> int:
        if isinstance(node, ast.Constant) and isinstance(node.value, int):
            return node.value
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            return OPERATORS[type(node.op)](value(node.left), value(node.right))
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            return -value(node.operand)
        return fail(f"{expression!r} is not an integer constant; write a number or a macro that is one")

    try:
        return value(ast.parse(plain.strip(), mode="eval").body)
    except SyntaxError:
        fail(f"{expression!r} is not an integer constant; write a number or a macro that is one")


def text(literals: str) -> str:
    """Join the adjacent string literals of a C expression."""
    parts = STRING.findall(literals)
    if not parts or STRING.sub("", literals).strip():
        fail(f"{literals!r} is not a string literal")
    return "".join(str(ast.literal_eval(part)) for part in parts)


def split_arguments(inside: str) -> list[str]:
    """Split at commas that stand neither in a string nor in parentheses."""
    arguments, depth, start = [], 0, 0
    for match in re.finditer(STRING.pattern + r"|[(),]", inside):
        mark = match.group()
        depth += (mark == "(") - (mark == ")")
        if mark == "," and depth == 0:
            arguments.append(inside[start : match.start()].strip())
            start = match.end()
    return [*arguments, inside[start:].strip()]


def collect(sources: Iterable[str], cc: str, defines: list[str]) -> Declarations:
    """Run the preprocessor over each source and take its markers."""
    found = Declarations()
    flags = [f"-I{FIRMWARE}", "-DCANDUCTOR_COLLECT", *(f"-D{define}" for define in defines)]
    for source in sources:
        run = subprocess.run([cc, "-E", "-P", *flags, source], capture_output=True, text=True, check=False)
        if run.returncode:
            fail(f"{source} does not preprocess: {run.stderr.strip()}")
        for kind, inside in MARKER.findall(run.stdout):
            found.add(kind, split_arguments(inside))
    if not found.commands:
        fail("no source declares a command; the markers of core/declare.h do not come through")
    return found


def name_of(message: str) -> str:
    """Return the first word of a format."""
    return message.split(" ", 1)[0]


def parameter_types(message: str) -> list[str]:
    """Return the C names of the parameters' types."""
    types = []
    for parameter in message.split(" ")[1:]:
        code = parameter.partition("=")[2]
        if code not in TYPES:
            fail(f"{message!r}: parameter {parameter!r} has none of the codes {', '.join(TYPES)}")
        types.append(TYPES[code])
    if len(types) > MESSAGE_ARGS_MAX:
        fail(f"{message!r} has more than {MESSAGE_ARGS_MAX} parameters")
    return types


def assign_ids(found: Declarations) -> dict[str, int]:
    """Give each format its id: fixed ones, then frequent commands; -32 to 95 take one byte."""
    frequent = [message for message, (_, flags) in found.commands.items() if flags & FREQUENT]
    messages = list(dict.fromkeys([*frequent, *found.commands, *found.responses.values()]))
    names = [name_of(message) for message in messages]
    for name in names:
        if names.count(name) > 1:
            fail(f"{name!r} is declared with two formats")
    free = iter([*range(2, 96), *range(-32, 0), *range(96, 4096)])
    return {
        message: FIXED_IDS[name] if name in FIXED_IDS else next(free)
        for message, name in zip(messages, names, strict=True)
    }


def string_ids(found: Declarations) -> dict[str, int]:
    """Give each static string a number from 2 on; sorted, so that the order of sources does not matter."""
    return {string: i for i, string in enumerate(sorted(set(found.strings.values())), start=2)}


def fingerprint(sources: list[str]) -> str:
    """Return eight digits of a hash over the sources and all firmware headers: which firmware is this."""
    digest = hashlib.sha256()
    for path in [*sorted(map(Path, sources)), *sorted(FIRMWARE.rglob("*.h")), Path(__file__)]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def dictionary(found: Declarations, ids: dict[str, int], version: str, compiler: str) -> dict[str, object]:
    """Return the dictionary as the host will see it."""
    return {
        "app": "canductor",
        "license": "Apache-2.0",
        "version": version,
        "build_versions": compiler,
        "commands": {message: ids[message] for message in found.commands},
        "responses": {message: ids[message] for message in found.responses.values()},
        "output": {},
        "enumerations": {**found.enumerations, "static_string_id": string_ids(found)},
        "config": found.constants,
    }


def function_list(table: str, functions: list[str]) -> list[str]:
    """Return the C of a list of functions; never empty, because C has no empty arrays."""
    prototypes = [f"void {function}(struct node *);" for function in functions]
    return [*prototypes, f"static const node_function {table}[] = {{{', '.join([*functions, 'NULL'])}}};"]


def types_of(symbol: str, message: str) -> tuple[str, int]:
    """Return the C array of a message's parameter types and its length."""
    types = parameter_types(message)
    return f"static const uint8_t {symbol}[] = {{{', '.join(types) or '0'}}};", len(types)


def command_lines(found: Declarations, ids: dict[str, int]) -> list[str]:
    """Return the C of the command table."""
    numbers = [ids[message] for message in found.commands]
    first, last = min(numbers), max(numbers)
    lines, rows = [], []
    for message, (function, flags) in found.commands.items():
        array, count = types_of(f"types_of_{function}", message)
        lines += [f"void {function}(struct node *, const struct wire_arg *);", array]
        rows.append(f"    [{ids[message] - first}] = {{{function}, types_of_{function}, {count}, {flags}}},")
    size = last - first + 1
    return [
        *lines,
        f"static const struct command commands[{size}] = {{",
        *rows,
        "};",
        f"enum {{ FIRST_ID = {first}, COMMAND_COUNT = {size} }};",
    ]


def c_source(found: Declarations, ids: dict[str, int], blob: bytes, version: str) -> str:
    """Return the generated C file."""
    lines = [
        f"// Made by firmware/tools/gen_dictionary.py from the sources of firmware {version}; do not edit.",
        '#include "core/tables.h"',
        *command_lines(found, ids),
    ]
    for symbol, message in found.responses.items():
        if name_of(message) != symbol:
            fail(f"response {symbol} has the format {message!r}, which must begin with its name")
        array, count = types_of(f"types_of_response_{symbol}", message)
        entry = f"{{{ids[message]}, {count}, types_of_response_{symbol}}}"
        lines += [array, f"const struct response response_{symbol} = {entry};"]
    numbers = string_ids(found)
    lines += [
        f"const uint16_t string_{symbol} = {numbers[string]};" for symbol, string in found.strings.items()
    ]
    tasks = found.functions["task"]
    if len(tasks) > 32:
        fail("more than 32 tasks; the set of woken tasks is one 32-bit word")
    lines += [f"const uint8_t {task}_index = {i};" for i, task in enumerate(tasks)]
    for kind, functions in found.functions.items():
        lines += function_list(f"{kind}s", functions)
    counts = {kind: len(functions) for kind, functions in found.functions.items()}
    rows = [", ".join(map(str, blob[i : i + 24])) + "," for i in range(0, len(blob), 24)]
    return "\n".join(
        [
            *lines,
            f"static const uint8_t dictionary[{len(blob)}] = {{",
            *rows,
            "};",
            "const struct tables node_tables = {commands, FIRST_ID, COMMAND_COUNT, inits, tasks, shutdowns,",
            f"    {counts['init']}, {counts['task']}, {counts['shutdown']},",
            "    dictionary, sizeof(dictionary)};",
            "",
        ]
    )


def generate(
    sources: list[str],
    out: Path,
    *,
    cc: str = "gcc",
    defines: Iterable[str] = (),
    json_out: Path | None = None,
) -> None:
    """Write OUT (and the dictionary to JSON_OUT) from the declarations in SOURCES."""
    defines = list(defines)
    found = collect(sources, cc, defines)
    ids = assign_ids(found)
    compiler = subprocess.run([cc, "--version"], capture_output=True, text=True, check=True).stdout
    version = f"{RELEASE}-{fingerprint(sources)}"
    content = dictionary(found, ids, version, compiler.splitlines()[0])
    packed = json.dumps(content, separators=(",", ":"), sort_keys=True).encode()
    source = c_source(found, ids, zlib.compress(packed, 9), version)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(source)
    if json_out is not None:
        json_out.write_bytes(packed)


def main() -> None:
    """Command line; see the top of this file."""
    parser = argparse.ArgumentParser(description="Collect declarations, write tables and dictionary.")
    parser.add_argument("-o", dest="out", type=Path, required=True)
    parser.add_argument("-D", dest="defines", action="append", default=[])
    parser.add_argument("--json", type=Path, help="also write the dictionary, not compressed, here")
    parser.add_argument("--cc", default="gcc")
    parser.add_argument("sources", nargs="+")
    options = parser.parse_args()
    generate(options.sources, options.out, cc=options.cc, defines=options.defines, json_out=options.json)


if __name__ == "__main__":
    main()
