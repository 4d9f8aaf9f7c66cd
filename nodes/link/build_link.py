"""Builds ``nodes.link._link``: the sans-IO link and the I/O thread of a bus."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent))

from nodes.native_build import builder

ffibuilder = builder(
    "nodes.link._link",
    headers=["firmware/wire/wire.h", "nodes/link/queue.h", "nodes/link/link.h", "nodes/link/io_thread.h"],
    sources=[
        *(f"firmware/wire/{name}.c" for name in ("vlq", "message", "block")),
        *(f"nodes/link/{name}.c" for name in ("queue", "link", "link_receive")),
        *(f"nodes/link/{name}.c" for name in ("io_schedule", "io_transfer", "io_thread", "io_links")),
    ],
)
