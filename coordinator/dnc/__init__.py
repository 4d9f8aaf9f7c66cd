"""BCC: programs and tables to and from machine-shop peripherals, block by block over a serial line.

``protocol`` is sans-IO; ``driver`` connects its engine with a port, ``files`` stores received files.
docs/dnc.md describes the protocol and its pitfalls.
"""
