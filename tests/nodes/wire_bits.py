"""Counts a frame's bits by writing all of them down: slow, obvious, and without a line of the project's."""


def crc15(bits: str) -> str:
    """Long division by x^15+x^14+x^10+x^8+x^7+x^4+x^3+1, on paper."""
    divisor = "1100010110011001"
    rest = list(bits + "0" * 15)
    for at in range(len(bits)):
        if rest[at] == "1":
            for i, bit in enumerate(divisor):
                rest[at + i] = "0" if rest[at + i] == bit else "1"
    return "".join(rest[-15:])


def stuffed(bits: str) -> str:
    wire = ""
    for bit in bits:
        wire += bit
        if wire.endswith(("00000", "11111")):
            wire += "1" if bit == "0" else "0"
    return wire


def bits_on_wire(can_id: int, data: bytes, *, extended: bool = False, asks_for: int | None = None) -> int:
    """ASKS_FOR: it is a remote frame, which asks for so many bytes and has none."""
    remote = "0" if asks_for is None else "1"
    if extended:
        id_bits = f"{can_id:029b}"
        head = "0" + id_bits[:11] + "1" + "1" + id_bits[11:] + remote + "00"
    else:
        head = "0" + f"{can_id:011b}" + remote + "0" + "0"
    head += f"{len(data) if asks_for is None else asks_for:04b}"
    head += "".join(f"{byte:08b}" for byte in data)
    end_of_frame, pause = "1111111", "111"
    return len(stuffed(head + crc15(head)) + "1" + "01" + end_of_frame + pause)
