"""Lines of G-code that a client sends as one text."""


def script_lines(script: str) -> list[str]:
    """Return the lines of SCRIPT without their ends: line feeds, carriage returns, or both together.

    Nothing else ends a line, as in files: what Unicode or ``str.splitlines`` takes for an end is text of a
    display or a mistake, never the begin of a second command.
    """
    lines = script.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if not lines[-1]:
        del lines[-1]
    return lines
