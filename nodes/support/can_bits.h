// SPDX-License-Identifier: Apache-2.0
// The true length of a CAN frame on the wire.
#ifndef CAN_BITS_H
#define CAN_BITS_H

#include <stdint.h>

// cffi: begin
// Returns the duration of a data frame with an 11-bit ID and LENGTH (0..8) bytes of DATA in bits: all fields,
// the stuff bits of this content, and the interframe space. 47 + 8 * LENGTH and up to 24 more.
uint32_t can_frame_bits(uint32_t id, uint32_t length, const uint8_t *data);

enum { CAN_BITS_EXTENDED = 1, CAN_BITS_REMOTE = 2 };
// The same for any frame of classical CAN. KIND: CAN_BITS_EXTENDED for a 29-bit ID, CAN_BITS_REMOTE for a
// remote frame, which has no DATA for any LENGTH; or'd, 0 for a data frame.
uint32_t can_any_frame_bits(uint32_t id, uint32_t kind, uint32_t length, const uint8_t *data);

enum { CAN_LEVELS_MAX = 98 + 24 };
// Writes the levels (0 dominant, 1 recessive) of the stuffed part of a frame, from the start bit to the last
// bit of the checksum and a stuff bit after it; returns their number. 13 bits follow that are never stuffed.
uint32_t can_frame_levels(uint32_t id, uint32_t length, const uint8_t *data, uint8_t *levels);
// cffi: end

#endif
