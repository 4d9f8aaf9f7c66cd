"""The tables of docs/compared.md that are made from the peer's public reference as data.

``python -m coordinator.assembly.compared DATA PAGE TEST…`` puts them into the page. DATA: the folder with
``peer/config_options.json``, ``peer/commands.json``, ``peer/status_fields.json`` and ``config/real``. A name
is *acting*, *absent* (known, and named as not acting) or *unknown*; what is known but changes nothing is
absent. TESTs: those that run with the peer's firmware; what they use is marked in the last column.
"""

import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from coordinator.assembly.load import load_machine
from coordinator.assembly.reference import reference_spec, sections
from coordinator.config.options import SectionSpec
from coordinator.config.unsupported import UNSUPPORTED_SECTIONS
from coordinator.gcode.absent_commands import ABSENT
from nodes.support.errors import CanductorError

BEGIN: Final = "<!-- The tables below are made by python -m coordinator.assembly.compared -->\n"
SOURCES: Final = (("klipper", "the peer"), ("kalico_beyond", "its fork beyond it"))
NO_COMMANDS: Final = frozenset(
    (
        *("NAME", "CENTER", "POLYGON", "TAPS", "TIMEOOUT", "METHOD", "FACTOR", "BAND", "STEP_DELTA"),
        *("STEP_HEIGHT", "HOME", "BAD_PROBE_STRATEGY", "BAD_PROBE_RETRIES", "RETRY_SPEED", "ENABLE"),
        *("COMPONENT", "O32", "STOP_ON_ENDSTOP", "PATTERN_SPACING", "TEMP_COEFF", "BELAY"),
    )
)
"""Parameters and words that the data has as commands."""
STATUS_OBJECTS: Final = {
    "heater": "extruder",
    "temperature sensors": "temperature_sensor",
    "tmc drivers": "tmc2209",
    "skew_correction.py": "skew_correction",
}
"""How the page of macros calls what the data calls otherwise."""
READ_ELSEWHERE: Final = {"include": "acting", "constants": "absent"}
"""Sections without a specification."""
COLUMN: Final = "run with the peer's firmware"
FIRST_CELLS: Final = 4
NOT_KNOWN: Final = {
    "tmc2209": frozenset({"mcu_phase_offset", "phase_offset_position", "temperature"}),
    "temperature_sensor": frozenset({"humidity", "pressure", "gas"}),
}
"""Fields of what nothing here measures: None, or not there."""


@dataclass(frozen=True, slots=True)
class Names:
    """The names of one group, by what this project does with them."""

    group: str
    acting: tuple[str, ...]
    absent: tuple[str, ...]
    unknown: tuple[str, ...]

    @classmethod
    def of(cls, group: str, states: Iterable[tuple[str, str]]) -> "Names":
        """Return names and their states (acting, absent, unknown) sorted by state."""
        found: dict[str, list[str]] = {"acting": [], "absent": [], "unknown": []}
        for name, state in states:
            found[state].append(name)
        return cls(group, *(tuple(sorted(found[state])) for state in ("acting", "absent", "unknown")))


# ------------------------------------------------------------------------------------------------ options


def _specs() -> dict[str, list[SectionSpec]]:
    """Return the specifications of each section's first word."""
    found: dict[str, list[SectionSpec]] = {}
    for title in sections():
        for word in re.findall(r"\[(\w+)", title):
            found.setdefault(word, []).append(reference_spec(title))
    return found


def _state(option: str, specs: Iterable[SectionSpec]) -> str:
    named = False
    for spec in specs:
        if any(option == known.name for known in spec.options):
            return "acting"
        if spec.family is not None and option.startswith(spec.family.name):
            return "acting"
        named |= option in spec.unsupported
    return "absent" if named else "unknown"


def option_names(data: Mapping[str, Mapping[str, Any]]) -> list[Names]:
    """Return the options of each section of DATA."""
    specs = _specs()
    rows = []
    for section, options in data.items():
        word = section.split()[0]
        known = specs.get(word) or specs.get(word.rstrip("0123456789")) or []
        elsewhere = "absent" if word in UNSUPPORTED_SECTIONS else READ_ELSEWHERE.get(word)
        states = ((o, elsewhere if not known and elsewhere else _state(o.lower(), known)) for o in options)
        rows.append(Names.of(f"[{section}]", states))
    return rows


# ------------------------------------------------------------------------------- commands, status, machines


def command_names(data: Mapping[str, Any], page: str) -> Names:
    """Return the commands of DATA, as the table of commands on PAGE has them."""
    here = dict(re.findall(r"^\| `(\w+)` \| (\w+) \|", page, re.MULTILINE))
    state = {"works": "acting", "differs": "acting", "absent": "absent"}
    elsewhere = {name: "absent" if name in ABSENT else "unknown" for name in data}
    commands = (name for name in data if name not in NO_COMMANDS)
    return Names.of("commands", ((name, state.get(here.get(name, ""), elsewhere[name])) for name in commands))


def status_names(data: Mapping[str, Iterable[str]], macros: str) -> list[Names]:
    """Return the fields of each object of DATA, as MACROS (docs/gcode.md) has them."""
    there: dict[str, set[str]] = {}
    seen = macros.partition("## What macros see")[2]
    for names, text in re.findall(r"^\| (`.*?) \| (.*) \|$", seen, re.MULTILINE):
        fields = set(re.findall(r"\w+", re.sub(r"\([^)]*\)", "", text)))
        for name in re.findall(r"`(\w+)", names):
            there.setdefault(name, set()).update(fields)
    return [Names.of(name, _field_states(name, fields, there)) for name, fields in data.items() if fields]


def _field_states(
    name: str, fields: Iterable[str], there: Mapping[str, set[str]]
) -> Iterator[tuple[str, str]]:
    ours = STATUS_OBJECTS.get(name, name)
    known = there.get(ours)
    for field in fields:
        root = re.sub(r"^printer\[.*?\]\.", "", field)
        root = re.split(r"[.\[]", root)[0]
        if known is None:
            yield root, "absent" if ours in UNSUPPORTED_SECTIONS else "unknown"
        elif root in NOT_KNOWN.get(ours, ()):
            yield root, "absent"
        else:
            yield root, "acting" if root == "<variable>" or root in known else "unknown"


def _verdicts(folder: Path) -> Iterator[tuple[str, str, str]]:
    """Yield each configuration of FOLDER, the peer's verdict and ours."""
    for path in sorted(folder.glob("*/*.cfg")):
        if path.parent.name not in ("users", "klipper"):
            continue
        text = path.read_text(encoding="utf-8", errors="replace")
        whole = re.search(r"^\[mcu\]", text, re.MULTILINE) and re.search(r"^\[printer\]", text, re.MULTILINE)
        try:
            machine = load_machine(str(path))
        except CanductorError:
            ours = "refused"
        else:
            count = len(machine.unsupported)
            ours = f"loads, {count} not acting" if count else "loads"
        yield f"{path.parent.name}/{path.name}", "loads" if whole else "refused", ours


# --------------------------------------------------------------------------------------------------- page


def _listed(names: Iterable[str]) -> str:
    return " ".join(f"`{name}`" for name in names)


def _table(title: str, rows: Iterable[Names]) -> list[str]:
    lines = [f"| {title} | acting | named as absent | unknown |", "|---|---|---|---|"]
    lines += [
        f"| {row.group} | {_listed(row.acting)} | {_listed(row.absent)} | {_listed(row.unknown)} |"
        for row in rows
        if row.acting or row.absent or row.unknown
    ]
    return [*lines, ""]


def _sum(what: str, rows: Iterable[Names]) -> str:
    found = list(rows)
    acting, absent, unknown = (
        sum(len(getattr(row, state)) for row in found) for state in ("acting", "absent", "unknown")
    )
    return f"| {what} | {acting + absent + unknown:,} | {acting:,} | {absent:,} | {unknown:,} |"


def name_tables(data: Path, page: str, macros: str) -> str:
    """Return the tables of names.

    DATA: the folder ``peer``; PAGE: the text of docs/compared.md, MACROS: of docs/gcode.md.
    """
    options, commands, status = (
        json.loads((data / f"{name}.json").read_bytes())
        for name in ("config_options", "commands", "status_fields")
    )
    by_source = {key: option_names(options[key]) for key, _ in SOURCES}
    of_commands = {key: command_names(commands[key], page) for key, _ in SOURCES}
    fields = status_names(status, macros)
    lines = ["## Every name of the public reference", ""]
    lines += ["| what | names | acting | named as absent | unknown |", "|---|---|---|---|---|"]
    for key, whose in SOURCES:
        lines.append(_sum(f"options of {whose}", by_source[key]))
        lines.append(_sum(f"commands of {whose}", [of_commands[key]]))
    lines += [_sum("status fields of the peer", fields), ""]
    for key, whose in SOURCES:
        lines += [f"### Options of {whose}", "", *_table("section", by_source[key])]
        lines += [f"### Commands of {whose}", "", *_table("", [of_commands[key]])]
    lines += ["### Status fields of the peer", "", *_table("object", fields)]
    return "\n".join(lines)


def verdict_table(folder: Path) -> str:
    """Return the verdict on each configuration in FOLDER (``config/real``)."""
    lines = ["## Configurations one by one", "", "| configuration | the peer | canductor |", "|---|---|---|"]
    lines += [f"| {name} | {peer} | {ours} |" for name, peer, ours in _verdicts(folder)]
    return "\n".join(lines) + "\n"


def with_firmware_column(page: str, tests: str) -> str:
    """Return PAGE with a last column that marks what TESTS use, which run with the peer's firmware."""
    lines = []
    for line in page.splitlines():
        cells = line.split(" | ")
        name = re.match(r"\| `(\[?)(\w+)\]?` \|", line)
        if line.startswith(("| section | here", "| command | here")):
            lines.append("| " + " | ".join(line.strip("| ").split(" | ")[:4]) + f" | {COLUMN} |")
        elif name is not None and len(cells) >= FIRST_CELLS:
            kept = [cell.strip() for cell in line.strip().strip("|").split(" | ")]
            kept = [*kept, "", ""][:FIRST_CELLS]
            used = rf"^\[{name[2]}[ \]]" if name[1] else rf"\b{name[2]}\b"
            kept.append("yes" if re.search(used, tests, re.MULTILINE) else "")
            lines.append("| " + " | ".join(kept) + " |")
        else:
            lines.append("|---|---|---|---|---|" if line == "|---|---|---|---|" else line)
    return "\n".join(lines) + "\n"


def main() -> None:
    """Put the tables into the page."""
    data, path = Path(sys.argv[1]), Path(sys.argv[2])
    tests = "\n".join(Path(test).read_text(encoding="utf-8") for test in sys.argv[3:])
    page = with_firmware_column(path.read_text(encoding="utf-8").partition(BEGIN)[0], tests)
    macros = (path.parent / "gcode.md").read_text(encoding="utf-8")
    tables = f"{name_tables(data / 'peer', page, macros)}\n{verdict_table(data / 'config' / 'real')}"
    path.write_text(f"{page}{BEGIN}\n{tables}", encoding="utf-8")


if __name__ == "__main__":
    main()
