// SPDX-License-Identifier: Apache-2.0
// The true length of a CAN frame on the wire.
#ifndef CAN_BITS_H
#define CAN_BITS_H

#include <stdint.h>

// cffi: begin
// Bit times that a data frame with an 11-bit ID and LENGTH (0..8) bytes of DATA keeps the bus busy: all
// fields, the stuff bits that this very content needs, and the interframe space. 47 + 8 * LENGTH and up to 24
// more.
uint32_t can_frame_bits(uint32_t id, uint32_t length, const uint8_t *data);

enum { CAN_BITS_EXTENDED = 1, CAN_BITS_REMOTE = 2 };
// The same for any frame of classical CAN. KIND: CAN_BITS_EXTENDED for a 29-bit ID, CAN_BITS_REMOTE for a
// remote frame, which has no DATA whatever LENGTH it asks for; or'd, 0 for a plain data frame.
uint32_t can_any_frame_bits(uint32_t id, uint32_t kind, uint32_t length, const uint8_t *data);

enum { CAN_LEVELS_MAX = 98 + 24 };
// The levels (0 dominant, 1 recessive) of the stuffed part of a frame, from the start bit to the checksum's
// last bit and a stuff bit behind it; returns how many there are. Behind them come 13 bits that are never
// stuffed.
uint32_t can_frame_levels(uint32_t id, uint32_t length, const uint8_t *data, uint8_t *levels);
// cffi: end

#endif
