"""Heat, without I/O: sensors, controllers, their tuning and the watch over heaters.

Everything here is a function of (time in s, measured °C) and its earlier arguments; nothing reads a clock
or talks to a node. Temperatures are °C, powers fractions of a heater's full power unless named ``_W``.
"""
