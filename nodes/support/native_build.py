"""Helper of the ``build_*.py`` scripts: a cffi builder whose declarations come from the C headers.

The declarations for Python are between the lines ``// cffi: begin`` and ``// cffi: end`` of a header, so that
there is no second copy.
"""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from cffi import FFI

ROOT = Path(__file__).resolve().parents[2]
_SECTION = re.compile(r"^// cffi: begin\n(.*?)^// cffi: end$", re.MULTILINE | re.DOTALL)


def declarations(header: Path) -> str:
    """Return the parts of HEADER for cffi; raises ValueError when there are none."""
    sections = _SECTION.findall(header.read_text())
    if not sections:
        raise ValueError(f"{header} has no '// cffi: begin' section")
    return "\n".join(sections)


def builder(module: str, headers: Sequence[str], sources: Iterable[str], *, cdef: str = "") -> FFI:
    """Return the builder of the extension MODULE of SOURCES (paths relative to the project's root).

    HEADERS are included in this order; their sections for cffi are declared after CDEF.
    """
    ffi = FFI()
    ffi.cdef(cdef + "\n".join(declarations(ROOT / header) for header in headers))
    ffi.set_source(
        module,
        "\n".join(f'#include "{header}"' for header in headers),
        # Relative paths, since setuptools refuses absolute ones.
        sources=list(sources),
        # Else a changed header would leave the module as it is; which ones it includes is not worth asking.
        depends=sorted(
            str(header.relative_to(ROOT))
            for package in ("coordinator", "nodes", "firmware")
            for header in (ROOT / package).rglob("*.h")
        ),
        include_dirs=[".", "firmware"],
        extra_compile_args=[
            "-std=gnu11",
            "-O3",
            "-Wall",
            "-Wextra",
            "-Wno-psabi",
            "-fno-math-errno",
            "-ffp-contract=off",  # equal results on every processor
            "-pthread",
        ],
        extra_link_args=["-pthread"],
        libraries=["m"],
    )
    return ffi
