"""The project on ARM: built by cross compilers, run by user-mode emulation, compared with this computer's."""
