"""The pictures that slicers write into the comments at the begin of a program.

    ; thumbnail begin 300x300 15316
    ; iVBORw0KGgoAAAANSUhEUgAA...
    ; thumbnail end

PrusaSlicer, OrcaSlicer, SuperSlicer and Cura's plug-ins write PNG like this; other formats are left out.
"""

import base64
import binascii
import re
from dataclasses import dataclass
from typing import Final

HEAD_BYTES: Final = 1_048_576
"""Of a program: where pictures are looked for."""
PNG_BYTES_MAX: Final = 131_072
"""Of one picture; larger ones are left out."""
_BEGIN: Final = re.compile(
    rb"^;[ \t]*thumbnail begin[ \t]+(\d{1,4})[x ](\d{1,4})[ \t]+\d{1,9}[ \t]*\r?$", re.MULTILINE
)
_END: Final = re.compile(rb"^;[ \t]*thumbnail end", re.MULTILINE)
_PNG: Final = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A picture of what a program prints."""

    width: int
    height: int
    """In pixels, as the slicer states them."""
    png: bytes


def thumbnails(head: bytes) -> list[Thumbnail]:
    """Return the pictures in HEAD, a program's first HEAD_BYTES bytes, the smallest first."""
    found = []
    for begin in _BEGIN.finditer(head):
        end = _END.search(head, begin.end())
        if end is None:
            break
        png = _decoded(head[begin.end() : end.start()])
        if png is not None:
            found.append(Thumbnail(int(begin[1]), int(begin[2]), png))
    return sorted(found, key=lambda picture: picture.width * picture.height)


def _decoded(comments: bytes) -> bytes | None:
    """Return the PNG that COMMENTS hold in base64, or None."""
    if len(comments) > 2 * PNG_BYTES_MAX:
        return None
    lines = (line.strip().lstrip(b";").strip() for line in comments.splitlines())
    try:
        png = base64.b64decode(b"".join(lines), validate=True)
    except binascii.Error:
        return None
    return png if png.startswith(_PNG) and len(png) <= PNG_BYTES_MAX else None
