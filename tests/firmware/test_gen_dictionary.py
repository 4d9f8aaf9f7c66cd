"""The dictionary generator: what it makes of declarations, and how it refuses senseless ones."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BASE = """
#include "core/node.h"
DECL_COMMAND(command_identify, "identify offset=%u count=%c", 0);
DECL_RESPONSE(identify_response, "identify_response offset=%u data=%.*s");
"""


def generate(folder: Path, source: str) -> subprocess.CompletedProcess[str]:
    (folder / "source.c").write_text(source)
    command = [sys.executable, "firmware/tools/gen_dictionary.py", "-I", "firmware", "-D", "SPEED=(3 * 7)"]
    command += [
        "--output",
        str(folder / "tables.c"),
        "--json",
        str(folder / "d.json"),
        str(folder / "source.c"),
    ]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_every_kind_of_declaration(tmp_path: Path) -> None:
    source = (
        BASE
        + """
    DECL_COMMAND(command_late, "a_late_one", 0);
    DECL_COMMAND(command_often, "z_often oid=%c "
                 "value=%hi", FREQUENT | ALLOWED_IN_SHUTDOWN);
    DECL_RESPONSE(state, "state data=%*s");
    DECL_CONSTANT("SPEED", SPEED);
    DECL_CONSTANT("NAME", "a, \\"b\\"");
    DECL_ENUMERATION("colour", "red", 0x10u);
    DECL_ENUMERATION_RANGE("colour", "grey0", 1 << 5, 16);
    DECL_STATIC_STRING(one, "Something, went wrong");
    DECL_STATIC_STRING(two, "Another");
    DECL_TASK(some_task);
    """
    )
    result = generate(tmp_path, source)
    assert result.returncode == 0, result.stderr
    words = json.loads((tmp_path / "d.json").read_text())
    assert words["commands"] == {
        "identify offset=%u count=%c": 1,
        "z_often oid=%c value=%hi": 2,
        "a_late_one": 3,
    }
    assert words["responses"] == {"identify_response offset=%u data=%.*s": 0, "state data=%*s": -1}
    assert words["config"] == {"SPEED": 21, "NAME": 'a, "b"'}
    assert words["enumerations"] == {
        "colour": {"red": 16, "grey0": [32, 16]},
        "static_string_id": {"Another": 2, "Something, went wrong": 3},
    }
    options = ["-std=gnu11", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-fsyntax-only", "-Ifirmware"]
    subprocess.run(["gcc", *options, str(tmp_path / "tables.c")], cwd=ROOT, check=True)


def test_many_frequent_commands_stay_in_one_byte_and_others_go_beyond(tmp_path: Path) -> None:
    source = BASE + "".join(
        f'DECL_COMMAND(c{k}, "c{k}", 0);\nDECL_RESPONSE(r{k}, "r{k}");\n' for k in range(120)
    )
    source += 'DECL_COMMAND(often, "often", FREQUENT);\n'
    assert generate(tmp_path, source).returncode == 0
    words = json.loads((tmp_path / "d.json").read_text())
    ids = [*words["commands"].values(), *words["responses"].values()]
    assert len(ids) == len(set(ids)) == 243
    assert min(ids) == -32
    assert words["commands"]["often"] == 2


@pytest.mark.parametrize(
    ("declaration", "words"),
    [
        ('DECL_COMMAND(a, "name p=%d", 0);', 'bad parameter "p=%d"'),
        ('DECL_COMMAND(a, "name p", 0);', 'bad parameter "p"'),
        ('DECL_COMMAND(a, "name", 0);\nDECL_COMMAND(b, "name", 0);', "declared twice"),
        ('DECL_COMMAND(a, "name", 0);\nDECL_COMMAND(b, "name p=%c", 0);', "two formats"),
        ('DECL_CONSTANT("A", 1);\nDECL_CONSTANT("A", 2);', 'constant "A" is declared twice'),
        ('DECL_CONSTANT("A", UNKNOWN);', "not a number"),
        ('DECL_STATIC_STRING(a, "x");\nDECL_STATIC_STRING(a, "y");', "declared twice"),
        ("#include <no_such_header.h>", "cannot preprocess"),
        ('DECL_COMMAND(a, "n ' + " ".join(f"p{k}=%c" for k in range(13)) + '", 0);', "more than 12"),
        (
            "".join(f'DECL_COMMAND(c{k}, "c{k}", FREQUENT);\n' for k in range(100)),
            "one frequent command too many",
        ),
    ],
)
def test_senseless_declarations_are_refused_in_a_sentence(
    tmp_path: Path, declaration: str, words: str
) -> None:
    result = generate(tmp_path, BASE + declaration)
    assert result.returncode == 1
    assert words in result.stderr
    assert "Traceback" not in result.stderr
