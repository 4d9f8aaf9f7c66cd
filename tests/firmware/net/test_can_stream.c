// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c firmware/core/*.c firmware/objects/*.c firmware/net/*.c
// sources: firmware/boards/virtual/*.c firmware/plant/*.c firmware/boards/sim/sim.c build/sim/tables.c
// The uuid of a chip.
#include "net/can_stream.h"
#include "tests/check.h"

#include <string.h>

int main(void) {
    static const uint8_t chip_id[12] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11};
    static const uint8_t wanted[NODE_UUID_SIZE] = {0x90, 0xa4, 0xae, 0x02, 0x2d, 0xfc};
    uint8_t uuid[NODE_UUID_SIZE];
    can_stream_uuid(chip_id, sizeof(chip_id), uuid);
    CHECK(memcmp(uuid, wanted, sizeof(wanted)) == 0);
    for (size_t size = 0; size < sizeof(chip_id); size++) {
        can_stream_uuid(chip_id, size, uuid);
        CHECK(memcmp(uuid, wanted, sizeof(wanted)) != 0);
    }
    return 0;
}
