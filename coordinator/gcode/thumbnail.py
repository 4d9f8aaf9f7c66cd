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
from io import BytesIO
from typing import Final

HEAD_BYTES: Final = 1_048_576
"""Of a program: where pictures are looked for."""
PNG_BYTES_MAX: Final = 131_072
"""Of one picture; larger ones are left out."""
_COMMENT_BYTES_MAX: Final = 2 * PNG_BYTES_MAX
_MARK_BYTES_MAX: Final = 256
"""Of a line at which a picture begins or ends."""
_BEGIN: Final = re.compile(rb";[ \t]*thumbnail begin[ \t]+(\d{1,4})[x ](\d{1,4})[ \t]+\d{1,9}\s*")
_END: Final = re.compile(rb";[ \t]*thumbnail end")
_PNG: Final = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A picture of what a program prints."""

    width: int
    height: int
    """In pixels, as the slicer states them."""
    png: bytes


def thumbnails(head: bytes) -> list[Thumbnail]:
    """Return the pictures in HEAD, a program's first HEAD_BYTES bytes, the smallest first.

    Each line is read once, in short steps of Python: a thread may do it while the control loop runs.
    """
    found = []
    begin: re.Match[bytes] | None = None
    comments = bytearray()
    for line in BytesIO(head):
        is_mark = line.startswith(b";") and len(line) <= _MARK_BYTES_MAX
        if is_mark and (another := _BEGIN.fullmatch(line)):
            begin = another
            comments.clear()
        elif begin is not None and is_mark and _END.match(line):
            if png := _decoded(bytes(comments)):
                found.append(Thumbnail(int(begin[1]), int(begin[2]), png))
            begin = None
        elif begin is not None and len(comments) <= _COMMENT_BYTES_MAX:
            comments += line.strip().lstrip(b";").strip()
    return sorted(found, key=lambda picture: picture.width * picture.height)


def _decoded(text: bytes) -> bytes | None:
    """Return the PNG that TEXT is in base64, or None."""
    if len(text) > _COMMENT_BYTES_MAX:
        return None
    try:
        png = base64.b64decode(text, validate=True)
    except binascii.Error:
        return None
    return png if png.startswith(_PNG) and len(png) <= PNG_BYTES_MAX else None
