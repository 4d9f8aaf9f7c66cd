from pathlib import Path

import pytest

from coordinator.assembly import reference
from coordinator.modules.registry import own_kinds

PAGE = Path(__file__).parents[3] / "docs" / "configuration.md"
HINT = "the page is stale; run: python -m coordinator.assembly.reference docs/configuration.md"


@pytest.mark.parametrize("title", reference.sections())
def test_the_page_has_the_table_of(title: str) -> None:
    assert reference.section_table(title) in PAGE.read_text(), HINT


def test_the_page_lists_what_does_not_act_yet() -> None:
    assert PAGE.read_text().endswith(reference.unsupported_sections()), HINT


def test_the_page_is_what_would_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In its order, and without a table of what is gone."""
    page = tmp_path / "page.md"
    page.write_text(PAGE.read_text().replace("### `[printer]`", "### `[gone]`", 1))
    monkeypatch.setattr("sys.argv", ["reference", str(page)])
    reference.main()
    assert page.read_text() == PAGE.read_text(), HINT


def test_modules_have_tables() -> None:
    kinds = {title.strip("[]").partition(" ")[0] for title in reference.sections()}
    assert set(own_kinds()) <= kinds


def test_all_tables_are_printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["reference"])
    reference.main()
    out = capsys.readouterr().out
    assert all(reference.section_table(title) in out for title in reference.sections())
