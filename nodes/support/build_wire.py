"""Builds ``nodes.support._wire``: the wire codec of ``firmware/wire``, as the host's Python uses it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from nodes.support.native_build import builder

ffibuilder = builder(
    "nodes.support._wire",
    headers=["firmware/wire/wire.h", "nodes/support/message_values.h"],
    sources=[
        "firmware/wire/vlq.c",
        "firmware/wire/message.c",
        "firmware/wire/block.c",
        "nodes/support/message_values.c",
    ],
)
