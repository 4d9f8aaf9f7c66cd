"""What stops a G-code program."""

from nodes.support.errors import CanductorError


class GCodeError(CanductorError):
    """A line that cannot be carried out: ``FILE:LINE: what is wrong; what to do``."""

    def __init__(self, file: str, line: int, problem: str) -> None:
        super().__init__(f"{file}:{line}: {problem}")
        self.file = file
        self.line = line
