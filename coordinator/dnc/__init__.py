"""BCC: programs and tables to and from machine-shop peripherals, block by block over a serial line.

``engine`` and what it uses are sans-IO; ``driver`` connects an engine with a port, ``files``
stores received files.
docs/dnc.md describes the protocol and its pitfalls.
"""
