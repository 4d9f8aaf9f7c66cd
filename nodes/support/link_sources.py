"""Sources and headers of the core of a bus, for a cffi module with any driver."""

CORE_HEADERS = (
    "firmware/wire/wire.h",
    *(f"nodes/link/core/{name}.h" for name in ("queue", "link", "schedule")),
    *(f"nodes/link/io/{name}.h" for name in ("io_core", "io_api")),
)
"""Headers, in the order of inclusion."""
CORE_SOURCES = (
    *(f"firmware/wire/{name}.c" for name in ("vlq", "message", "block")),
    *(f"nodes/link/core/{name}.c" for name in ("queue", "link", "link_states", "link_pack", "link_receive")),
    "nodes/link/core/schedule.c",
    *(f"nodes/link/io/io_{name}.c" for name in ("core", "receive", "send", "schedule")),
    *(f"nodes/link/io/io_{name}.c" for name in ("forecast", "stats", "links")),
    "nodes/support/can_bits.c",
)
