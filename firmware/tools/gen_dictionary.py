"""Gathers the declarations of a firmware build (core/declare.h) and writes its tables and dictionary.

Usage: gen_dictionary.py --output TABLES.c [--json DICT.json] [-D NAME=VALUE]... [-I DIR]... SOURCE.c...

Standard library only. Every error is one sentence on stderr, exit status 1.
"""

import argparse
import ast
import json
import re
import subprocess
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

TYPES = {
    "%u": "WIRE_U32",
    "%i": "WIRE_I32",
    "%hu": "WIRE_U16",
    "%hi": "WIRE_I16",
    "%c": "WIRE_U8",
    "%s": "WIRE_BYTES",
    "%*s": "WIRE_BYTES",
    "%.*s": "WIRE_BYTES",
}
FIXED_COMMAND, FIXED_RESPONSE = "identify", "identify_response"
ARGS_MAX = 12  # NODE_ARGS_MAX in core/node.h
ONE_BYTE_MIN, ONE_BYTE_MAX = -32, 95
DECLARATION = re.compile(r"CANDUCTOR_DECLARE_BEGIN (.*?)\s*CANDUCTOR_DECLARE_END", re.DOTALL)
STRING = r'"(?:[^"\\]|\\.)*"'
ARGUMENT = re.compile(rf"\s*((?:{STRING}\s*)+|[^,\"]+)\s*(?:,|$)")
ALLOWED_IN_SHUTDOWN, FREQUENT = 1, 2


class BuildError(Exception):
    """An invalid declaration; the sentence names it."""


@dataclass
class Declarations:
    """All declarations of one build, in source order."""

    commands: dict[str, tuple[str, int]] = field(default_factory=dict)  # format -> handler, flags
    responses: dict[str, str] = field(default_factory=dict)  # format -> symbol
    constants: dict[str, int | str] = field(default_factory=dict)
    enumerations: dict[str, dict[str, int | list[int]]] = field(default_factory=dict)
    strings: dict[str, str] = field(default_factory=dict)  # symbol -> text
    functions: dict[str, list[str]] = field(default_factory=lambda: {"task": [], "init": [], "hook": []})

    def add(self, kind: str, args: Sequence[str]) -> None:
        """Add one declaration; raises BuildError when it contradicts an earlier one."""
        match kind:
            case "command":
                handler, text, flags = args[0], string(args[1]), args[2]
                put(self.commands, text, (handler, number(flags)), "command")
            case "response":
                put(self.responses, string(args[1]), args[0], "response")
            case "constant":
                value = string(args[1]) if args[1].startswith('"') else number(args[1])
                put(self.constants, string(args[0]), value, "constant")
            case "enumeration":
                names = self.enumerations.setdefault(string(args[0]), {})
                put(names, string(args[1]), number(args[2]), "enumeration name")
            case "range":
                names = self.enumerations.setdefault(string(args[0]), {})
                put(names, string(args[1]), [number(args[2]), number(args[3])], "enumeration name")
            case "string":
                put(self.strings, args[0], string(args[1]), "static string", repeat=True)
            case _:
                self.functions[kind].append(args[0])


def put(table: dict, key: str, value: object, what: str, *, repeat: bool = False) -> None:
    """Add KEY to TABLE, once."""
    if key in table and not (repeat and table[key] == value):
        raise BuildError(f'the {what} "{key}" is declared twice')
    table[key] = value


def string(token: str) -> str:
    """Parse one C string, or several adjacent ones."""
    return "".join(ast.literal_eval(part) for part in re.findall(STRING, token))


def number(token: str) -> int:
    """Parse an integer expression of literals, `|`, `<<`, `*`, `+`, `-` and the flags of declare.h."""
    names = {"ALLOWED_IN_SHUTDOWN": ALLOWED_IN_SHUTDOWN, "FREQUENT": FREQUENT}
    text = re.sub(r"\b(0x[0-9a-fA-F]+|[0-9]+)[uUlL]+\b", r"\1", token.strip())
    text = re.sub(r"[A-Za-z_]\w*", lambda match: str(names.get(match[0], match[0])), text)
    if not re.fullmatch(r"[0-9a-fA-Fx|<*+()\s-]+", text):
        raise BuildError(f'"{token}" is not a number the dictionary generator can read')
    return int(eval(text, {"__builtins__": {}}))  # noqa: S307 - only digits and operators are left


def arguments(text: str) -> list[str]:
    """Split what stands between the marks at its commas."""
    return [match[1].strip() for match in ARGUMENT.finditer(" ".join(text.split("\n"))) if match[1].strip()]


def collect(sources: Sequence[Path], preprocess: Sequence[str]) -> Declarations:
    """Preprocess every source and gather what it declares."""
    found = Declarations()
    for source in sources:
        command = [*preprocess, "-E", "-P", "-DCANDUCTOR_COLLECT", str(source)]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            raise BuildError(f"cannot preprocess {source}: {result.stderr.strip()}")
        for match in DECLARATION.finditer(result.stdout):
            kind, *args = arguments(match[1])
            try:
                found.add(string(kind), args)
            except (BuildError, IndexError, ValueError, SyntaxError) as error:
                raise BuildError(f"{source}: {error}") from error
    return found


def parameter_types(text: str) -> list[str]:
    """Return the wire types of the parameters of one format."""
    types = []
    for word in text.split()[1:]:
        name, _, code = word.partition("=")
        if not re.fullmatch(r"\w+", name) or code not in TYPES:
            raise BuildError(f'the format "{text}" has a bad parameter "{word}"')
        types.append(TYPES[code])
    if len(types) > ARGS_MAX:
        raise BuildError(f'the format "{text}" has more than {ARGS_MAX} parameters')
    return types


def assign_ids(found: Declarations) -> tuple[dict[str, int], dict[str, int]]:
    """Assign ids: commands from 1 up, frequent ones first; responses from 0 down, the rest after those."""

    def name(text: str) -> str:
        return text.split(maxsplit=1)[0]

    for kind, table in (("command", found.commands), ("response", found.responses)):
        names = [name(text) for text in table]
        twice = {n for n in names if names.count(n) > 1}
        if twice:
            raise BuildError(f'the {kind} "{min(twice)}" is declared with two formats')
    order = sorted(
        found.commands,
        key=lambda text: (name(text) != FIXED_COMMAND, not found.commands[text][1] & FREQUENT, text),
    )
    if not order or name(order[0]) != FIXED_COMMAND:
        raise BuildError(f'no command "{FIXED_COMMAND}" is declared')
    commands = {text: index + 1 for index, text in enumerate(order)}
    beyond = [
        text
        for text, value in commands.items()
        if value > ONE_BYTE_MAX and found.commands[text][1] & FREQUENT
    ]
    if beyond:
        raise BuildError(f'"{beyond[0]}" is one frequent command too many for one-byte ids')
    rest = sorted(found.responses, key=lambda text: (name(text) != FIXED_RESPONSE, text))
    if not rest or name(rest[0]) != FIXED_RESPONSE:
        raise BuildError(f'no response "{FIXED_RESPONSE}" is declared')
    one_byte = 1 - ONE_BYTE_MIN
    responses = {text: -index for index, text in enumerate(rest[:one_byte])}
    responses |= {text: len(commands) + 1 + index for index, text in enumerate(rest[one_byte:])}
    return commands, responses


def string_ids(found: Declarations) -> dict[str, int]:
    """Return the numbers of the distinct static strings, from 2 on: 0 and 1 are reserved for 'none'."""
    return {text: index + 2 for index, text in enumerate(sorted(set(found.strings.values())))}


def dictionary(found: Declarations, version: str, build_versions: str) -> bytes:
    """Return the dictionary's JSON."""
    commands, responses = assign_ids(found)
    content = {
        "app": "canductor",
        "build_versions": build_versions,
        "commands": commands,
        "config": found.constants,
        "enumerations": found.enumerations | {"static_string_id": string_ids(found)},
        "license": "Apache-2.0",
        "output": {},
        "responses": responses,
        "version": version,
    }
    return json.dumps(content, separators=(",", ":"), sort_keys=True).encode()


def tables(found: Declarations, blob: bytes) -> Iterator[str]:
    """Yield the lines of the C file."""
    commands, responses = assign_ids(found)
    yield "// Generated by firmware/tools/gen_dictionary.py; do not edit."
    yield '#include "core/node.h"'
    numbers = string_ids(found)
    for symbol, text in found.strings.items():
        yield f"const uint16_t string_{symbol} = {numbers[text]};"
    for text, symbol in found.responses.items():
        types = parameter_types(text)
        yield f"static const uint8_t types_{symbol}[] = {{{', '.join([*types, '0'])}}};"
        yield (
            f"const struct node_response response_{symbol} = "
            f"{{.types = types_{symbol}, .id = {responses[text]}, .arg_count = {len(types)}}};"
        )
    for handler, _ in found.commands.values():
        yield f"void {handler}(struct node *node, const struct wire_arg *args);"
    for text, (handler, _) in found.commands.items():
        yield f"static const uint8_t types_{handler}[] = {{{', '.join([*parameter_types(text), '0'])}}};"
    yield "static const struct node_command commands[] = {"
    for text, value in commands.items():
        handler, flags = found.commands[text]
        count = len(parameter_types(text))
        yield f"    [{value}] = {{{handler}, types_{handler}, {count}, {flags}}},"
    yield "};"
    for kind, functions in found.functions.items():
        for function in functions:
            yield f"void {function}(struct node *node);"
        # A null at the end: C has no empty arrays.
        yield f"static void (*const {kind}s[])(struct node *node) = {{{', '.join([*functions, 'NULL'])}}};"
    yield "static const uint8_t dictionary[] = {"
    for at in range(0, len(blob), 20):
        yield "    " + "".join(f"{byte}," for byte in blob[at : at + 20])
    yield "};"
    yield "const struct node_tables node_tables = {"
    yield "    .commands = commands, .tasks = tasks, .inits = inits, .hooks = hooks,"
    yield f"    .dictionary = dictionary, .dictionary_size = {len(blob)},"
    yield f"    .command_count = {max(commands.values()) + 1},"
    yield ", ".join(f"    .{kind}_count = {len(found.functions[kind])}" for kind in found.functions) + ","
    yield "};"


def write_if_changed(path: Path, content: bytes) -> None:
    """Write PATH only when its content changes, so that make rebuilds nothing needlessly."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_bytes() != content:
        path.write_bytes(content)


def generate(
    sources: Sequence[Path],
    preprocess: Sequence[str],
    output: Path,
    *,
    json_path: Path | None = None,
    version: str = "unknown",
    build_versions: str = "",
) -> None:
    """Write the tables of SOURCES to OUTPUT, and the inflated dictionary to JSON_PATH; raises BuildError."""
    found = collect(sources, preprocess)
    text = dictionary(found, version, build_versions)
    write_if_changed(output, ("\n".join(tables(found, zlib.compress(text, 9))) + "\n").encode())
    if json_path:
        write_if_changed(json_path, text)


def main() -> int:
    """Run from a Makefile."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--cc", default="gcc")
    parser.add_argument("--version", default="unknown")
    parser.add_argument("--build-versions", default="")
    parser.add_argument("-D", dest="defines", action="append", default=[])
    parser.add_argument("-I", dest="includes", action="append", default=[])
    parser.add_argument("sources", type=Path, nargs="+")
    options = parser.parse_args()
    preprocess = [
        options.cc,
        *(f"-D{define}" for define in options.defines),
        *(f"-I{include}" for include in options.includes),
    ]
    try:
        generate(
            options.sources,
            preprocess,
            options.output,
            json_path=options.json,
            version=options.version,
            build_versions=options.build_versions,
        )
    except BuildError as error:
        print(f"gen_dictionary: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
