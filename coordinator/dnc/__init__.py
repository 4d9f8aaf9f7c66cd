"""BCC: programs and tables to and from machine-shop peripherals, block by block over a serial line.

``engine`` and what it uses are sans-IO; ``driver`` puts an engine on a port, ``files`` keeps what came.
What goes over the line, with its traps, is in docs/dnc.md.
"""
