// SPDX-License-Identifier: Apache-2.0
// The uuid of a node on CAN: six bytes made of the chip's own, longer id.
#ifndef NET_CAN_UUID_H
#define NET_CAN_UUID_H

#include <stddef.h>
#include <stdint.h>

enum { CAN_UUID_SIZE = 6 };

// The first six bytes, little-endian, of fasthash64(CHIP_ID) with the seed that all such firmwares share.
// Chip id 00 01 … 0b gives 90 a4 ae 02 2d fc.
void can_uuid_from_chip_id(const uint8_t *chip_id, size_t size, uint8_t uuid[CAN_UUID_SIZE]);

#endif
