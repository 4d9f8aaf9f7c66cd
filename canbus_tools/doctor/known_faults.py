"""What is publicly known of kernels, drivers and adapters that reorder frames; each with its source."""

import re
from dataclasses import dataclass
from typing import Final

_RELEASE: Final = re.compile(r"(\d+)\.(\d+)")


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownFault:
    """A driver that is at fault in kernels before one version."""

    driver: str
    fixed_in: tuple[int, int]
    """Of the mainline kernel; distributions may have taken the change into older ones."""
    what: str
    source: str


KERNEL_FAULTS: Final = (
    KnownFault(
        driver="gs_usb",
        fixed_in=(6, 6),
        what="hands received frames over out of order when USB interrupts move between processors",
        source="Linux commit 24bc41b45583 'can: gs_usb: convert to NAPI/rx-offload to avoid OoO reception'",
    ),
)

CANDLELIGHT_USB: Final = (0x1D50, 0x606F)
"""The USB id of candleLight firmware, and of others that speak its protocol (gs_usb)."""
CANDLELIGHT_FAULT: Final = (
    "candleLight firmware before 2.0 could hand frames over out of order"
    " (github.com/candle-usb/candleLight_fw/pull/60)"
)


def kernel_version(release: str) -> tuple[int, int] | None:
    """Return major and minor of ``uname -r``; None when it has another form."""
    found = _RELEASE.match(release)
    return (int(found[1]), int(found[2])) if found else None


def faults_of(driver: str, release: str) -> tuple[KnownFault, ...]:
    """Return what is known of DRIVER in this kernel."""
    version = kernel_version(release)
    return tuple(
        fault
        for fault in KERNEL_FAULTS
        if fault.driver == driver and version is not None and version < fault.fixed_in
    )
