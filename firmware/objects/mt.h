// SPDX-License-Identifier: Apache-2.0
// MT, receiving side: a table X[i] -> Y[i] that one transmission brings to all receivers its mask selects.
//
// A stream of 32-bit words is commands or values. Commands have the top four bits 1 (mask), 2 (start, with
// the number of pairs), 3 and 4 (low and high half of the checksum); START enters value mode, where a word is
// a value, ESC ends the values, and LIT takes the word behind it as a value whatever it is.
//
//   ESC MASK(0) ESC MASK(m) CKHIGH CKLOW START(l) X[0] Y[0] … X[l-1] Y[l-1] ESC ESC MASK(0)
//
// What a receiver makes of trouble: values go into a shadow, which becomes the table at the ESC that ends a
// sound transmission and is dropped by any other. Receivers that are not selected follow the modes too, and
// store nothing; so no values can be taken for commands. Both halves of the checksum must have come since the
// last mask. Each kept table counts the generation up: an "OK" that is left from another transmission shows.
//
// Sans-IO; the caller owns all memory. One writer at a time: who reads tables while an interrupt feeds words
// reads them with interrupts off.
#ifndef OBJECTS_MT_H
#define OBJECTS_MT_H

#include <stddef.h>
#include <stdint.h>

// cffi: begin
enum { MT_AXLE_MIN = 1, MT_AXLE_MAX = 28, MT_WORD_SIZE = 4 };

enum { MT_DIGEST_FACTOR = 0x01000193 };

enum mt_status { MT_OK, MT_TRANSMITTING, MT_CHECKSUM_ERROR, MT_LENGTH_ERROR };
enum mt_mode { MT_COMMAND, MT_VALUE, MT_LITERAL };

struct mt_pair {
    int32_t x, y;
};

// One axle's receiver. `table` holds `length` pairs; `generation`, `checksum` and `digest` are the table's.
// The digest is not MT's: begun with 0, each value makes it digest * MT_DIGEST_FACTOR + value. Unlike a sum
// it tells tables apart that differ in the order of their values.
struct mt_receiver {
    struct mt_pair *table, *shadow; // of `capacity` pairs each
    uint32_t capacity;
    uint32_t length, generation, checksum, digest;
    uint8_t axle, status, mode;
    uint8_t selected, halves; // halves of the checksum that came since the mask
    uint32_t announced_checksum, sum, running_digest;
    uint32_t announced; // pairs
    uint32_t values;    // so far; stays at its highest instead of rolling over
};

// An empty table of AXLE, 1..28, with room for CAPACITY pairs in each of TABLE and SHADOW.
void mt_start(struct mt_receiver *receiver, uint8_t axle, struct mt_pair *table, struct mt_pair *shadow,
              uint32_t capacity);
// Returns 1 when the word ended a transmission that is kept, else 0.
int mt_word(struct mt_receiver *receiver, uint32_t word);

// Words from a stream of bytes, little endian. Bytes get lost on a serial line: after GAP ticks of silence
// the next byte begins a word, and what there was of another is dropped and counted.
struct mt_bytes {
    uint32_t gap, last;
    uint32_t word;
    uint8_t size, begun;
    uint32_t dropped;
};
// Takes a byte at clock NOW. Returns 1 and the word with its last byte, else 0.
int mt_byte(struct mt_bytes *bytes, uint8_t byte, uint32_t now, uint32_t *word);

// Words from a register that is polled: only a change is seen.
struct mt_register {
    uint32_t last;
    uint8_t seen;
};
// Returns 1 when VALUE differs from that of the last poll (the first poll sees none), else 0.
int mt_poll(struct mt_register *reg, uint32_t value);
// cffi: end

#endif
