"""Sources and headers of the core of a bus, for a cffi module with any driver."""

CORE_HEADERS = (
    "firmware/wire/wire.h",
    *(f"nodes/link/{name}.h" for name in ("queue", "link", "schedule", "io_core", "io_api")),
)
"""Headers, in the order of inclusion."""
CORE_SOURCES = (
    *(f"firmware/wire/{name}.c" for name in ("vlq", "message", "block")),
    *(f"nodes/link/{name}.c" for name in ("queue", "link", "link_states", "link_pack", "link_receive")),
    *(f"nodes/link/{name}.c" for name in ("schedule", "io_core", "io_receive", "io_send", "io_schedule")),
    *(f"nodes/link/{name}.c" for name in ("io_forecast", "io_stats", "io_links")),
    "nodes/support/can_bits.c",
)
