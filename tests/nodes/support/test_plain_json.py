"""JSON of others: what is read can be written again, as JSON and as UTF-8."""

import pytest

from nodes.support.plain_json import read_json


@pytest.mark.parametrize(
    "text",
    [
        rb'"\ud800"',
        rb'{"\uDFFF x": 1}',
        rb'{"a": [[1, {"b": "\udead\ud83d"}]]}',
        b'["\xed\xa0\x80"]',
        '["\ud800"]',
    ],
)
def test_half_of_a_surrogate_pair_is_refused_wherever_it_stands(text: str | bytes) -> None:
    with pytest.raises(ValueError, match="has half of a surrogate pair"):
        read_json(text)


def test_other_texts_are_read_as_they_are() -> None:
    assert read_json(rb'{"\ud83d\ude00": ["\u00b5", "\\ud800", ""]}') == {"\U0001f600": ["µ", r"\ud800", ""]}
