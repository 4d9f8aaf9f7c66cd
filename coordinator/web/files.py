"""The files of the page, read once and kept: nothing a browser says becomes a path."""

import gzip
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parent / "page"
_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True, slots=True)
class PageFile:
    """A file as it is sent."""

    content: bytes
    packed: bytes
    """The same for browsers that know gzip."""
    content_type: str
    tag: str
    """Changes with the content."""


def page_files() -> dict[str, PageFile]:
    """Return the files by the path a browser asks for."""
    files = {}
    for path in sorted(FOLDER.rglob("*")):
        if path.suffix in _TYPES:
            content = path.read_bytes()
            tag = f'"{hashlib.sha256(content).hexdigest()[:24]}"'
            packed = gzip.compress(content, mtime=0)
            files[f"/{path.relative_to(FOLDER)}"] = PageFile(content, packed, _TYPES[path.suffix], tag)
    files["/"] = files.pop("/index.html")
    return files
