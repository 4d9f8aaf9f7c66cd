from pathlib import Path

import pytest

from coordinator.machine import reference

PAGE = Path(__file__).parents[3] / "docs" / "configuration.md"
HINT = "the page is stale: paste what `python -m coordinator.machine.reference` prints"


@pytest.mark.parametrize("title", reference.SECTIONS)
def test_the_page_has_the_table_of(title: str) -> None:
    assert reference.section_table(title) in PAGE.read_text(), HINT


def test_the_page_lists_what_does_not_act_yet() -> None:
    assert PAGE.read_text().endswith(reference.later_sections()), HINT


def test_all_tables_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    reference.main()
    out = capsys.readouterr().out
    assert all(reference.section_table(title) in out for title in reference.SECTIONS)
