"""What nodes' rooms may not import."""

import ast
from pathlib import Path

import nodes

FOLDER = Path(nodes.__file__).parent


def imported(source: Path) -> set[str]:
    """Return the top-level packages that SOURCE imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.partition(".")[0])
    return found


def test_numpy_is_for_virtual_nodes_only() -> None:
    """It takes more than 10 MB, which a service on a small computer does not have to spare."""
    sources = [p for p in FOLDER.rglob("*.py") if "virtual" not in p.relative_to(FOLDER).parts[:1]]
    assert FOLDER / "clock" / "start.py" in sources
    assert [str(p) for p in sources if "numpy" in imported(p)] == []
