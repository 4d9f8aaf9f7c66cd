"""The tables of docs/configuration.md, made from the options themselves.

``python -m coordinator.assembly.reference`` prints them all; with a page's name it puts them there.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Final

from coordinator.config.options import Option, SectionSpec
from coordinator.config.sections import extruder as read_extruder
from coordinator.config.sections import nodes as read_nodes
from coordinator.config.sections import printer as read_printer
from coordinator.config.sections import rails as read_rails
from coordinator.config.sections import shaper as read_shaper
from coordinator.config.sections import tables as read_tables
from coordinator.config.sections.kinematics import dual_carriage as read_dual
from coordinator.config.sections.kinematics.registry import KINDS, PRINTER_SPECS
from coordinator.config.unsupported import UNSUPPORTED_SECTIONS
from coordinator.modules.registry import own_modules, own_option_readers
from nodes.support.terminal import show

_BEGIN: Final = "<!-- The tables below"
_END: Final = "## Sections that are not supported yet\n"
SECTIONS: dict[str, SectionSpec] = {
    "[mcu], [mcu NAME]": read_nodes.MCU,
    "[printer]": read_printer.PRINTER,
    **{f"[printer] with kinematics {name}": spec for name, spec in PRINTER_SPECS.items()},
    "[stepper_x], [stepper_y], [stepper_z], [stepper_arm]": read_rails.RAIL,
    "[stepper_x1], [stepper_z1], [stepper_z2] …": read_rails.EXTRA_STEPPER,
    **{title: spec for kind in KINDS.values() for title, spec in kind.reference.items()},
    "[dual_carriage]": read_dual.DUAL_CARRIAGE,
    "[extruder], [extruder1] …": read_extruder.EXTRUDER,
    "[extruder_stepper NAME]": read_extruder.EXTRUDER_STEPPER,
    "[input_shaper]": read_shaper.INPUT_SHAPER,
    "[axis_tables]": read_tables.AXIS_TABLES,
    "[board_pins], [board_pins NAME]": read_nodes.BOARD_PINS,
    "[duplicate_pin_override]": read_nodes.DUPLICATE_PIN_OVERRIDE,
}
MOST_NUMBERED = 3
"""Options that differ in their number are shown so far; the help says how many there are."""


def sections() -> list[str]:
    """Return the titles of all sections: the machine's own, then those of our modules."""
    return [*SECTIONS, *_module_sections()]


def _module_sections() -> dict[str, SectionSpec]:
    further = {f"{title}, further options": module.SPEC for title, module in own_option_readers()}
    return further | {title: module.SPEC for title, module in own_modules()}


def reference_spec(title: str) -> SectionSpec:
    """Return the specification of a section by its title."""
    return SECTIONS.get(title) or _module_sections()[title]


def section_json(title: str) -> dict[str, object]:
    """Return one section's purpose and options."""
    spec = reference_spec(title)
    return {
        "help": spec.help,
        "options": [
            {
                "name": option.name,
                "value": option.rule(),
                "unit": option.unit,
                "default": option.default,
                "help": option.help,
            }
            for option in spec.options
        ],
    }


def section_table(title: str) -> str:
    """Return one section's heading, purpose and options in Markdown."""
    spec = reference_spec(title)
    lines = [
        f"### `{title}`",
        "",
        f"{spec.help}.",
        "",
        "| option | value | default | what it is |",
        "|---|---|---|---|",
    ]
    lines += [_row(option) for option in spec.options if not _is_one_of_many(option)]
    if spec.family is not None:
        lines.append(_row(replace(spec.family, name=f"{spec.family.name}NAME")))
    if spec.unsupported:
        names = ", ".join(f"`{name}`" for name in spec.unsupported)
        lines += ["", f"Not supported yet, ignored: {names}."]
    return "\n".join(lines) + "\n"


def unsupported_sections() -> str:
    """Return the first words of all sections that are not supported yet."""
    return ", ".join(f"`{name}`" for name in sorted(UNSUPPORTED_SECTIONS)) + ".\n"


def _is_one_of_many(option: Option[object]) -> bool:
    """Whether OPTION is as those of lower numbers before it (``voltage17``)."""
    number = option.name.lstrip("abcdefghijklmnopqrstuvwxyz_")
    return number.isdecimal() and int(number) > MOST_NUMBERED


def _row(option: Option[object]) -> str:
    default = option.default
    if isinstance(default, tuple):
        default = ", ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in default)
    text = "" if default is None else f"{default:g}" if isinstance(default, float) else str(default)
    return f"| `{option.name}` | {option.rule()} | {text} | {option.help} |"


def with_tables(page: str) -> str:
    """Return the text of a page, which has the marks of docs/configuration.md, with the tables of now."""
    head, _, rest = page.partition(_BEGIN)
    mark, _, rest = rest.partition("\n")
    _, _, rest = rest.partition(_END)
    notes = rest[: rest.index("\n`")]
    tables = "\n".join(section_table(title) for title in sections())
    return f"{head}{_BEGIN}{mark}\n\n{tables}\n{_END}{notes}\n{unsupported_sections()}"


def main() -> None:
    """Print all tables, or put them into the pages that are named."""
    if len(sys.argv) == 1:
        tables = "\n".join(section_table(title) for title in sections())
        show(f"{tables}\n{unsupported_sections()}", end="")
    for path in map(Path, sys.argv[1:]):
        path.write_text(with_tables(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
