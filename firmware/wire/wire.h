// SPDX-License-Identifier: Apache-2.0
// Wire codec: values (VLQ), messages, checksums and message blocks, as both ends of a link speak them.
//
// The same C is compiled into every node's firmware and into the host. Nothing here allocates, keeps state of
// its own, reads a clock or blocks; all functions are total: garbage in gives an error return, never a fault.
#ifndef WIRE_H
#define WIRE_H

#include <stddef.h>
#include <stdint.h>

// cffi: begin
// ---------------------------------------------------------------------------------------------------- values

enum { WIRE_VLQ_MAX = 5 };

// Writes VALUE (-2^31 .. 2^32-1) as a base-128 number, most significant group first; returns its 1..5 bytes.
// Bits above 32 are the caller's error and are dropped. A u32 that is to travel in the fewest bytes is passed
// as (int32_t)value: readers take the 32 bits and do not care which of the two forms was sent.
size_t wire_vlq_encode(uint8_t *out, int64_t value);

// Reads one value from [*at, end) and moves *at behind it. Returns 0, or -1 (and leaves *at) when the bytes
// end early or a sixth byte would be needed.
int wire_vlq_decode(const uint8_t **at, const uint8_t *end, uint32_t *value);

// -------------------------------------------------------------------------------------------------- messages

// The type of one parameter. Sizes matter to range checks and to the reader's signedness, not to the
// encoding.
enum wire_type { WIRE_U32, WIRE_I32, WIRE_U16, WIRE_I16, WIRE_U8, WIRE_BYTES };

// One argument: an integer, or (WIRE_BYTES) a length and a pointer to bytes that the owner keeps alive.
struct wire_arg {
    uint32_t value;
    const uint8_t *data;
};

// Encodes COUNT arguments of the given TYPES. Returns the bytes written, or 0 when they do not fit into ROOM.
// Integers are sent in their shortest form. (COUNT 0 writes nothing; callers put the message id in front.)
size_t wire_pack(const uint8_t *types, size_t count, const struct wire_arg *args, uint8_t *out, size_t room);

// Decodes COUNT arguments from [*at, end), moving *at behind them. WIRE_BYTES arguments point into the input.
// 16- and 8-bit integers are truncated to their size, signed ones sign-extended. Returns 0, or -1 on short
// input.
int wire_unpack(const uint8_t *types, size_t count, const uint8_t **at, const uint8_t *end,
                struct wire_arg *args);

// ---------------------------------------------------------------------------------------------------- blocks

// A block: <length> <sequence> <content: 0..59 bytes> <crc high> <crc low> <0x7E>
enum {
    WIRE_BLOCK_MIN = 5,
    WIRE_BLOCK_MAX = 64,
    WIRE_HEADER = 2,
    WIRE_TRAILER = 3,
    WIRE_CONTENT_MAX = WIRE_BLOCK_MAX - WIRE_BLOCK_MIN,
    WIRE_SYNC = 0x7E,
    WIRE_SEQ_MARK = 0x10,
    WIRE_SEQ_MASK = 0x0F,
};

// CRC-16/MCRF4XX of LENGTH bytes: reflected polynomial 0x1021, initial 0xFFFF; "123456789" gives 0x6F91.
uint16_t wire_crc16(const uint8_t *data, size_t length);

// Completes the block whose CONTENT_LENGTH bytes of content already stand at block + WIRE_HEADER: fills in
// header and trailer (low four bits of SEQUENCE). Returns the length of the whole block. BLOCK has room for
// WIRE_BLOCK_MAX.
size_t wire_block_finish(uint8_t *block, size_t content_length, unsigned sequence);

enum wire_scan {
    WIRE_MORE,  // no whole block yet: drop SKIP bytes, keep the rest, read more
    WIRE_BLOCK, // a checked block of LENGTH bytes stands at data + SKIP
    WIRE_LOST,  // a framing or checksum error begins here: drop SKIP bytes, and nak if the receiver naks
};

// Receiver of a byte stream. Zero-initialise; one per direction.
struct wire_scanner {
    uint8_t hunting; // after an error: everything up to and including the next sync byte is dropped
};

// Looks at the front of DATA for the next block. Call again after consuming SKIP (+ LENGTH) bytes, until
// WIRE_MORE. One error is reported once, however many bytes it costs. Never asks for more than WIRE_BLOCK_MAX
// buffered bytes.
enum wire_scan wire_scan(struct wire_scanner *scanner, const uint8_t *data, size_t size, size_t *skip,
                         size_t *length);
// cffi: end

#endif
