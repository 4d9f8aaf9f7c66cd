"""Where C and Python can be mutated, and what a changed source reads."""

import ast
import subprocess
from pathlib import Path

import pytest

from tests.mutation import c_source, python_source
from tests.mutation.mutation import Mutation

C = b"""\
enum { LIMIT = 3 };
int buffer[8];
DECL_CONSTANT("X", 5);
int f(int a, int b) {
    if (a < b && !b)
        return 0;
    for (int i = 0; i != LIMIT; i++)
        b += a << 1;
    switch (a) {
    case 1:
        b = 2;
        break;
    default:
        b = 3;
    }
    while (b > 9)
        b--;
    if (a)
        b = 1;
    else
        b = 2;
    return a ? b : 0x10u;
}
"""

PYTHON = b'''\
"""Number 7."""
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    import nothing
LIMIT: "Final[7]" = 1.5
def f(a: int, b: bool = True) -> int:
    """1 < 2"""
    if not a and b is not None:
        return 0
    if a == (  # <
        3
    ):
        raise ValueError(f"{a + 1}")
    self.x = a // 2
    a += 1 if not (a or
       b) else 2
    return -a if b in c else [k for k in c if k]
'''


def changes(found: list[Mutation], line: int) -> set[str]:
    return {mutation.change for mutation in found if mutation.line == line}


def test_c_is_mutated_everywhere_but_in_what_is_read_as_text() -> None:
    found = c_source.find_mutations("x.c", C)
    assert changes(found, 1) == {"3 -> 4"}
    assert changes(found, 2) == {"8 -> 7"}, "a longer array is no change"
    assert changes(found, 3) == set()
    assert changes(found, 5) == {
        "< -> <=",
        "< -> >=",
        "&& -> ||",
        "! -> nothing",
        "a < b && !b -> !(a < b && !b)",
    }
    assert changes(found, 6) == {"0 -> 1", "return 0; -> ;"}
    assert changes(found, 7) == {"0 -> 1", "!= -> ==", "++ -> --"}
    assert changes(found, 8) == {"+= -> -=", "<< -> >>", "1 -> 0", "b += a << 1; -> ;"}
    assert changes(found, 12) == {"break; -> ;"}
    assert changes(found, 16) == {"> -> >=", "> -> <=", "9 -> 10"}
    assert changes(found, 22) == {"a -> !(a)", "0x10u -> 17u"}, "the last return is no early one"


def test_python_is_mutated_everywhere_but_in_annotations_and_sentences() -> None:
    found = python_source.find_mutations("x.py", PYTHON)
    assert changes(found, 1) == changes(found, 3) == changes(found, 7) == set()
    assert changes(found, 5) == {"1.5 -> 2.5"}
    assert changes(found, 6) == {"True -> False"}
    assert changes(found, 8) == {
        *("not -> nothing", "and -> or", "is not -> is"),
        "not a and b is not None -> (not (not a and b is not None))",
    }
    assert changes(found, 9) == {"0 -> 1", "return 0 -> pass"}
    assert changes(found, 10) == {"== -> !="}
    assert changes(found, 13) == {'raise ValueError(f"{a + 1}") -> pass'}
    assert changes(found, 14) == {"// -> *", "2 -> 3", "self.x = a // 2 -> pass"}
    assert {"+= -> -=", "1 -> 0", "not -> nothing", "or -> and"} <= changes(found, 15)
    assert {"- -> nothing", "in -> not in", "k -> (not (k))"} <= changes(found, 17)


@pytest.mark.parametrize("mutation", python_source.find_mutations("x.py", PYTHON), ids=str)
def test_mutated_python_is_another_program_with_the_same_lines(mutation: Mutation) -> None:
    changed = mutation.applied(PYTHON)
    assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(PYTHON))
    assert changed.count(b"\n") == PYTHON.count(b"\n")


def test_a_change_is_refused_in_another_source() -> None:
    mutation = python_source.find_mutations("x.py", b"a = 1 + 2\n")[0]
    with pytest.raises(ValueError, match="not the one that was parsed"):
        mutation.applied(b"abc = 1 + 2\n")


def test_equal_texts_in_a_line_are_numbered() -> None:
    found = c_source.find_mutations("x.c", b"int f(int a) { return a + 1 + 1; }\n")
    assert [m.change for m in found] == [
        "+ -> -",
        "1 -> 0",
        "+ -> - (2)",
        "1 -> 0 (2)",
    ]


def test_the_innermost_statement_is_that_of_a_line() -> None:
    assert python_source.statement_line(PYTHON, PYTHON.index(b"3\n")) == 10
    assert python_source.statement_line(PYTHON, PYTHON.index(b"return 0")) == 9


def test_counters_mark_what_is_executed(tmp_path: Path) -> None:
    main = b"int main(void) { return f(1, 5) == 1 && mutation_hits[0] ? 0 : 1; }\n"
    source = C.replace(b'DECL_CONSTANT("X", 5);', b"") + main
    count = len(c_source.statement_spans(source))
    path, hits = tmp_path / "x.c", tmp_path / "hits"
    path.write_bytes(c_source.with_counters(source, 0))
    counters = Path(c_source.__file__).with_name("hits.c")
    program = tmp_path / "x"
    subprocess.run(
        ["gcc", "-w", f"-DMUTATION_HITS={count}", str(path), str(counters), "-o", str(program)], check=True
    )
    subprocess.run([str(program)], check=True, env={"MUTATION_HITS_FILE": str(hits)})
    executed = {
        source[start:end].split(b"\n")[0].decode()
        for (start, end), hit in zip(c_source.statement_spans(source), hits.read_bytes(), strict=True)
        if hit
    }
    assert {"b += a << 1;", "b = 2;", "break;", "b = 1;", "return a ? b : 0x10u;"} <= executed
    assert not {"return 0;", "b = 3;", "b--;"} & executed
