"""Builds ``nodes.link._link``: the sans-IO core of links and their bus, and the bus's I/O thread."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent))

from nodes.support.link_sources import CORE_HEADERS, CORE_SOURCES
from nodes.support.native_build import builder

ffibuilder = builder(
    "nodes.link._link",
    headers=[*CORE_HEADERS, "nodes/link/io/io_thread.h"],
    sources=[*CORE_SOURCES, "nodes/link/io/io_thread.c"],
)
