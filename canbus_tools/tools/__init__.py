"""One file per ``canductor can`` command, and ``canductor console``."""
