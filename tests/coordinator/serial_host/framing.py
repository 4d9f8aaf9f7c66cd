"""Lines as serial hosts frame them."""

from functools import reduce
from operator import xor


def numbered(number: int, text: str) -> bytes:
    """Return TEXT with its number and checksum."""
    line = f"N{number} {text}".encode()
    return line + b"*%d\n" % reduce(xor, line)
