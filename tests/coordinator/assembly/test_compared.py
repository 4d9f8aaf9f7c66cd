"""The page that compares with the peer claims nothing that no test uses, and leaves nothing out."""

import re
from pathlib import Path

import pytest

from coordinator.assembly.compared import BEGIN, name_tables, verdict_table, with_firmware_column
from coordinator.config.unsupported import UNSUPPORTED_SECTIONS
from coordinator.gcode.builtins import basic as basic_commands
from coordinator.gcode.builtins import machine as machine_commands
from coordinator.modules.registry import own_kinds
from tests.profiles import is_full

ROOT = Path(__file__).parents[3]
WHOLE_PAGE = (ROOT / "docs" / "compared.md").read_text(encoding="utf-8")
PAGE = WHOLE_PAGE.partition(BEGIN)[0]
ROW = re.compile(r"^\| `(\[?)(\w+)\]?` \| (\w+) \| [^|]* \| ?([^| ]*) ?\| (?:yes)? ?\|$", re.MULTILINE)
ROWS: list[tuple[str, str, str, str]] = ROW.findall(PAGE)
HERE = {name: here for _, name, here, _ in ROWS}
REFERENCE = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")


def uses_section(name: str, text: str) -> bool:
    """Tell whether a test with this TEXT uses a section, itself or by one of the example machines."""
    machines = [
        path.read_text(encoding="utf-8")
        for path in (ROOT / "config").glob("*.cfg")
        if re.search(rf"[\"/]{path.stem}(\.cfg)?\"", text)
    ]
    return any(re.search(rf"\[{name}\d*[ \]]", words) for words in (text, *machines))


def test_every_row_is_read() -> None:
    assert len(ROWS) == len([line for line in PAGE.splitlines() if line.startswith("| `")])
    assert len(HERE) == len(ROWS)
    assert set(HERE.values()) <= {"works", "differs", "absent", "untested"}


@pytest.mark.parametrize(("section", "name", "here", "test"), ROWS, ids=[row[1] for row in ROWS])
def test_a_row_names_a_test_that_uses_it(section: str, name: str, here: str, test: str) -> None:
    if here in ("works", "differs"):
        text = (ROOT / "tests" / test).read_text(encoding="utf-8")
        used = uses_section(name, text) if section else re.search(rf"\b{name}(?!\w)", text)
        assert used, f"{test} does not use {name}"
    else:
        assert not test


def test_sections_that_act_are_here_and_those_that_wait_are_absent() -> None:
    assert [kind for kind in own_kinds() if HERE.get(kind) not in ("works", "differs")] == []
    assert [kind for kind in sorted(UNSUPPORTED_SECTIONS) if HERE.get(kind) != "absent"] == []


def test_every_section_of_the_reference_is_here() -> None:
    kinds = re.findall(r"^### `\[(\w+)", REFERENCE, re.MULTILINE)
    assert len(kinds) > 50
    numbered = {kind: re.sub(r"\d+$", "", kind) for kind in kinds}
    assert [kind for kind, plain in numbered.items() if not {kind, plain} & HERE.keys()] == []


def test_the_interpreters_own_commands_are_here() -> None:
    waiting = {"G5"}  # refused with a sentence
    known = {*basic_commands.HANDLERS, *machine_commands.HANDLERS} - waiting
    assert sorted(known - HERE.keys()) == []


DATA = ROOT / ".." / "shared" / "data"
FIRMWARE_TESTS = (
    "tests/smoke/test_foreign_firmware.py",
    "tests/stages/foreign_firmware.py",
    "../shared/data/firmware/klipper-linux.cfg",
)
COMMAND = (
    f"python -m coordinator.assembly.compared ../shared/data docs/compared.md {' '.join(FIRMWARE_TESTS)}"
)


@pytest.mark.skipif(not (DATA / "firmware").exists(), reason="the peer's firmware is no part of the project")
def test_the_last_column_marks_what_ran_with_the_peers_firmware() -> None:
    tests = "\n".join((ROOT / name).read_text(encoding="utf-8") for name in FIRMWARE_TESTS)
    assert with_firmware_column(PAGE, tests) == PAGE, f"run {COMMAND}"
    assert sum(line.endswith("| yes |") for line in PAGE.splitlines()) > 5


@pytest.mark.skipif(
    not (DATA / "peer").exists(), reason="the peer's reference as data is no part of the project"
)
def test_the_tables_of_names_are_those_of_now() -> None:
    macros = (ROOT / "docs" / "gcode.md").read_text(encoding="utf-8")
    tables = name_tables(DATA / "peer", PAGE, macros)
    assert tables in WHOLE_PAGE, f"run {COMMAND}"


@pytest.mark.skipif(not is_full(), reason="loads 160 machines; test_real_configs.py loads each in profile ci")
def test_the_table_of_configurations_is_that_of_now() -> None:
    if not (DATA / "config" / "real").exists():
        pytest.skip("configurations that people use are no part of the project")
    assert verdict_table(DATA / "config" / "real") in WHOLE_PAGE
