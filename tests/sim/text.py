"""G-code from a string."""


class Text:
    """What ``Program`` reads."""

    def __init__(self, text: str) -> None:
        self._data = text.encode()

    def read(self, size: int, /) -> bytes:
        part, self._data = self._data[:size], self._data[size:]
        return part

    def close(self) -> None:
        """Nothing to release."""
