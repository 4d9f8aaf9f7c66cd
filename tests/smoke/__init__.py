"""The dozen tests on real processes in real time, with the shipped constants.

They show that the parts work together outside virtual time: processes, sockets, pseudo-terminals, signals.
What the machine does is tested in virtual time, in ``tests/sim``. No test here asserts how long anything
takes: each waits for lines of output, answers and ends of processes. Motion begins after a G4 of 1.5 s, so
that its first commands are sent as far ahead as all others; a busy computer may give the host its turn a
second late.
"""
