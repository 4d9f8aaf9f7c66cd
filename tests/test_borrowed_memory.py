"""C uses memory of Python objects within a function only; no object keeps such a view (``ffi.from_buffer``).

Python's garbage collector takes a cycle apart in any order. A memoryview that it empties while C's view of it
is still there ends the process with a segmentation fault (seen with 3.11).
"""

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
FOLDERS = ("coordinator", "nodes", "canbus_tools")


def kept(source: str) -> list[int]:
    """Return the lines of SOURCE that store such a view in an attribute."""
    found = []
    for part in ast.walk(ast.parse(source)):
        if isinstance(part, ast.Assign | ast.AnnAssign):
            targets = part.targets if isinstance(part, ast.Assign) else [part.target]
            stored = any(isinstance(at, ast.Attribute) for to in targets for at in ast.walk(to))
            if stored and part.value is not None and "from_buffer(" in ast.unparse(part.value):
                found.append(part.lineno)
    return found


def test_no_object_keeps_memory_that_is_borrowed() -> None:
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    assert {str(path.relative_to(ROOT)): lines for path in paths if (lines := kept(path.read_text()))} == {}


def test_such_a_line_is_found() -> None:
    assert kept("self._memory = ffi.from_buffer('double[]', nodes)") == [1]
    assert kept("x = 1\nself.a, b = (_from_buffer(nodes), 2)") == [2]
    assert kept("view = ffi.from_buffer(nodes)\nself.size = len(nodes)") == []
