"""The tables of docs/simulation.md, made from the declarations of scenario.py.

``python -m coordinator.simulate.reference`` prints them all.
"""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from typing import Any

from coordinator.simulate import scenario
from coordinator.support.toml_values import Range
from nodes.support.terminal import show

TABLES: dict[str, type[Any]] = {
    "[nodes.NAME]": scenario.NodeSetting,
    "[buses.NAME]": scenario.BusSetting,
    "[[faults]]": scenario.FaultSetting,
    "[program]": scenario.Program,
    "[outputs.NAME]": scenario.OutputSetting,
    "[bounds]": scenario.Bounds,
}


def table(title: str) -> str:
    """Return one table's heading and options in Markdown."""
    lines = [
        f"### `{title}`",
        "",
        "| option | default | what it is |",
        "| --- | --- | --- |",
        *_rows(TABLES[title]),
    ]
    return "\n".join(lines) + "\n"


def faults() -> str:
    """Return the kinds of faults in Markdown."""
    kinds = [f"| `{kind}` | {what} |" for kind, what in scenario.FAULT_KINDS.items()]
    return "\n".join(["### Kinds of faults", "", "| kind | what happens |", "| --- | --- |", *kinds]) + "\n"


def _rows(kind: type[Any]) -> Iterator[str]:
    source = inspect.getsource(kind)
    for field in dataclasses.fields(kind):
        found = re.search(rf'^    {field.name}: [^\n]*\n    """(.*?)"""', source, re.MULTILINE | re.DOTALL)
        assert found is not None, f"{field.name} is not documented"
        help_ = " ".join(found[1].split()).replace("``", "`")
        yield f"| `{field.name}` | {_default(field.default)} | {help_} |"


def _default(value: object) -> str:
    if value is dataclasses.MISSING:
        return "required"
    if isinstance(value, Range):
        return f"{value.low:g}" if value.low == value.high else f"[{value.low:g}, {value.high:g}]"
    return str(value).lower() if value != "" else "–"  # noqa: RUF001 (a dash for no value)


def main() -> None:
    """Print all tables."""
    show("\n".join([*(table(title) for title in TABLES), faults()]), end="")


if __name__ == "__main__":
    main()
