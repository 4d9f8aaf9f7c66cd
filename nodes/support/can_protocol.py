"""The fixed CAN ids of the protocol, one of the kernel's, and the commands of the admin frames."""

from struct import Struct
from typing import Final

BUS_STOP_ID: Final = 0x010
"""Every node with this project's firmware shuts down at once, whatever the frame contains."""
BUS_STOP: Final = Struct("<BBI")
"""Its reason, the node id of the sender, and that node's clock; a host sends zeros."""
TRIGGER_ID: Final = 0x020
"""First of TRIGGER_GROUPS ids: an endstop of that group triggered."""
TRIGGER_GROUPS: Final = 16
FIRST_DATA_ID: Final = 0x100
"""Id of frames to node N: FIRST_DATA_ID + 2 N; frames from it have the next id."""
DATA_NODEID_MAX: Final = 255
ADMIN_ID: Final = 0x3F0
"""From the host to all nodes; the first byte is the command."""
ADMIN_RESPONSE_ID: Final = 0x3F1
MT_CAN_ID: Final = 0x3F2
"""Table downloads, from the host to all nodes."""
BUS_OFF: Final = 0x2000_0040
"""The kernel's error frame (CAN_ERR_FLAG | CAN_ERR_BUSOFF): the controller took itself off the bus."""

QUERY_UNASSIGNED: Final = 0x00
SET_NODEID: Final = 0x01
REQUEST_BOOTLOADER: Final = 0x02
SET_NODEID_BOOTLOADER: Final = 0x11
NEED_NODEID: Final = 0x20
NODE_IS_HERE: Final = 0x21
SYNC_PULSE: Final = 0x40
WHO_IS_HERE: Final = 0x41

UUID_SIZE: Final = 6
FIRST_NODEID: Final = 4
LAST_NODEID: Final = 255
