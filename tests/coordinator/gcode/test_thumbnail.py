"""Pictures in the comments of programs."""

from base64 import b64encode

import pytest

from coordinator.gcode.thumbnail import HEAD_BYTES, PNG_BYTES_MAX, Thumbnail, thumbnails

PNG = b"\x89PNG\r\n\x1a\n"


def comments(data: bytes, size: str = "32x32", *, end: str = "; thumbnail end\n") -> str:
    text = b64encode(data).decode()
    lines = "".join(f"; {text[i : i + 78]}\n" for i in range(0, len(text), 78))
    return f";\n; thumbnail begin {size} {len(text)}\n{lines}{end}"


def test_all_pictures_are_found_the_smallest_first() -> None:
    small, large = PNG + b"a" * 40, PNG + b"b" * 400
    text = "; made by a slicer\n" + comments(large, "300x200") + ";\n" + comments(small, "16x16") + "G28\n"
    expected = [Thumbnail(16, 16, small), Thumbnail(300, 200, large)]
    assert thumbnails(text.encode()) == expected
    assert thumbnails(text.replace("\n", "\r\n").encode()) == expected


@pytest.mark.parametrize(
    "text",
    [
        "G28\n",
        comments(b"no picture"),
        comments(PNG, end=""),  # the head of the program ends before
        comments(PNG).replace("; iVBO", "; *VBO"),
        comments(PNG + bytes(PNG_BYTES_MAX)),
        comments(PNG, "32"),
        comments(PNG).replace("thumbnail begin", "thumbnail_QOI begin"),
    ],
)
def test_anything_else_is_no_picture(text: str) -> None:
    assert thumbnails(text.encode()) == []


def test_a_begin_without_end_starts_afresh() -> None:
    text = comments(PNG + b"a", "300x200", end="") + comments(PNG + b"b", "16x16")
    assert thumbnails(text.encode()) == [Thumbnail(16, 16, PNG + b"b")]


def test_pictures_that_begin_again_and_again_are_read_once() -> None:
    """Failed before: each begin was searched to the end, a minute for a file's head."""
    begin = b"; thumbnail begin 300x300 100\n"
    picture = comments(PNG).encode()
    repeated = begin * ((HEAD_BYTES - len(picture)) // len(begin))
    assert thumbnails(repeated + picture) == [Thumbnail(32, 32, PNG)]
