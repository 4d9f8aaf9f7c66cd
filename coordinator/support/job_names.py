"""Which names job files may have: one rule for uploads, the job folder, front ends and the command line."""

from typing import Final

SUFFIXES: Final = (".gcode", ".gco", ".g", ".nc", ".ngc")
NAME_BYTES_MAX: Final = 240
"""Of one part of a path, in UTF-8. Disks take 255; while a file is uploaded its name is longer."""
DEPTH_MAX: Final = 8
PATH_BYTES_MAX: Final = DEPTH_MAX * (NAME_BYTES_MAX + 1)
RULE: Final = (
    f"a plain name that ends in one of {', '.join(SUFFIXES)}: up to {NAME_BYTES_MAX} bytes of printable"
    " characters without /, \\ and ;, of which the first is no space, . or -"
)


def is_plain_part(part: str) -> bool:
    """Return whether PART may be the name of a file or folder in the job folder.

    A semicolon begins a comment in G-code: M23 could not name the file.
    """
    return (
        0 < len(part.encode(errors="surrogatepass")) <= NAME_BYTES_MAX
        and part.isprintable()
        and not any(c in part for c in "/\\;")
        and part[0] not in ".- "
    )


def is_job_name(name: str) -> bool:
    """Return whether NAME, without folders, may be the name of a job's file."""
    return is_plain_part(name) and name.lower().endswith(SUFFIXES)


def job_path_parts(name: str) -> tuple[str, ...]:
    """Return the parts of NAME, a path in the job folder; none unless it may be that of a job's file."""
    parts = tuple(name.split("/"))
    if not 0 < len(parts) <= DEPTH_MAX or not is_job_name(parts[-1]):
        return ()
    return parts if all(map(is_plain_part, parts[:-1])) else ()
