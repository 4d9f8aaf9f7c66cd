"""The safety case and the threat model name tests: those exist, under these names."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NAMED = re.compile(r"`(tests/[\w/.]+\.py)(?:::(\w+))?`")
HAZARDS = ("## Heat and fire", "## Motion and pinching")


def named_tests(page: str) -> list[tuple[str, str]]:
    return [(match[1], match[2] or "") for match in NAMED.finditer((ROOT / "docs" / page).read_text())]


@pytest.mark.parametrize("page", ["safety.md", "security.md"])
def test_the_tests_that_are_named_exist(page: str) -> None:
    found = named_tests(page)
    assert len(found) > 5
    for file, name in found:
        path = ROOT / file
        assert path.is_file(), file
        assert not name or re.search(rf"^(async )?def {name}\(", path.read_text(), re.MULTILINE), (file, name)


@pytest.mark.parametrize("hazard", HAZARDS)
def test_each_hazard_names_who_stops_it_and_a_test_and_what_remains(hazard: str) -> None:
    section = (ROOT / "docs/safety.md").read_text().split(f"\n{hazard}\n")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| ")][2:]
    assert len(rows) >= 10
    for row in rows:
        assert row[2].strip() in ("node", "host", "both"), row
        assert NAMED.search(row[3]), row
    assert "Left with the user:" in section
