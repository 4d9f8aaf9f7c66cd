// SPDX-License-Identifier: Apache-2.0
// MT, receiving side: see mt.h.
#include "objects/mt.h"

#include <string.h>

#define ESC UINT32_C(0x80000000)
#define LIT UINT32_C(0x80000001)
#define COMMAND_MASK UINT32_C(0xF0000000)
#define DATA_MASK UINT32_C(0x0FFFFFFF)
#define C_MASK UINT32_C(0x10000000)
#define C_START UINT32_C(0x20000000)
#define C_CKLOW UINT32_C(0x30000000)
#define C_CKHIGH UINT32_C(0x40000000)

enum { HIGH = 1, LOW = 2, BOTH = HIGH | LOW, HALF_BITS = 16, HALF = 0xFFFF };

void mt_start(struct mt_receiver *receiver, uint8_t axle, struct mt_pair *table, struct mt_pair *shadow,
              uint32_t capacity) {
    memset(receiver, 0, sizeof(*receiver));
    receiver->axle = axle;
    receiver->table = table;
    receiver->shadow = shadow;
    receiver->capacity = capacity;
}

// ------------------------------------------------------------------------------------------------- commands

static void select(struct mt_receiver *receiver, uint32_t mask) {
    receiver->selected = (mask >> (receiver->axle - MT_AXLE_MIN)) & 1;
    receiver->halves = 0; // those of another transmission do not count
}

static void begin(struct mt_receiver *receiver, uint32_t pairs) {
    receiver->mode = MT_VALUE; // selected or not: what follows is no command
    if (!receiver->selected)
        return;
    receiver->status = MT_TRANSMITTING;
    receiver->announced = pairs;
    receiver->values = receiver->sum = receiver->running_digest = 0;
}

static void take_command(struct mt_receiver *receiver, uint32_t word) {
    uint32_t data = word & DATA_MASK;
    switch (word & COMMAND_MASK) {
    case C_MASK:
        select(receiver, data);
        break;
    case C_CKHIGH: // the low half has to follow it
        receiver->announced_checksum = (data & HALF) << HALF_BITS;
        receiver->halves = HIGH;
        break;
    case C_CKLOW:
        receiver->announced_checksum = (receiver->announced_checksum & ~(uint32_t)HALF) | (data & HALF);
        receiver->halves |= LOW;
        break;
    case C_START:
        begin(receiver, data);
        break;
    default: // ESC outside of values, and whatever else: nothing
        break;
    }
}

// --------------------------------------------------------------------------------------------------- values

static void store(struct mt_receiver *receiver, uint32_t word) {
    uint32_t index = receiver->values / 2;
    if (index < receiver->announced && index < receiver->capacity) {
        struct mt_pair *pair = &receiver->shadow[index];
        *(receiver->values % 2 ? &pair->y : &pair->x) = (int32_t)word;
    }
    receiver->sum += word;
    receiver->running_digest = receiver->running_digest * MT_DIGEST_FACTOR + word;
    receiver->values += receiver->values != UINT32_MAX;
}

// The length says more than the checksum of a transmission that lacks or repeats values: it goes first.
static enum mt_status judge(const struct mt_receiver *receiver) {
    if (receiver->announced > receiver->capacity || receiver->values != 2 * receiver->announced)
        return MT_LENGTH_ERROR;
    if (receiver->halves != BOTH || receiver->sum != receiver->announced_checksum)
        return MT_CHECKSUM_ERROR;
    return MT_OK;
}

static int end(struct mt_receiver *receiver) {
    receiver->mode = MT_COMMAND;
    if (!receiver->selected)
        return 0;
    receiver->status = (uint8_t)judge(receiver);
    if (receiver->status != MT_OK)
        return 0;
    struct mt_pair *kept = receiver->shadow;
    receiver->shadow = receiver->table;
    receiver->table = kept;
    receiver->length = receiver->announced;
    receiver->checksum = receiver->sum;
    receiver->digest = receiver->running_digest;
    receiver->generation++;
    return 1;
}

int mt_word(struct mt_receiver *receiver, uint32_t word) {
    if (receiver->mode == MT_COMMAND) {
        take_command(receiver, word);
        return 0;
    }
    if (receiver->mode == MT_VALUE && word == ESC)
        return end(receiver);
    if (receiver->mode == MT_VALUE && word == LIT) {
        receiver->mode = MT_LITERAL;
        return 0;
    }
    receiver->mode = MT_VALUE;
    if (receiver->selected)
        store(receiver, word);
    return 0;
}

// ----------------------------------------------------------------------------------------------- transports

int mt_byte(struct mt_bytes *bytes, uint8_t byte, uint32_t now, uint32_t *word) {
    if (bytes->begun && bytes->size && now - bytes->last > bytes->gap) {
        bytes->dropped += bytes->size;
        bytes->size = 0;
    }
    bytes->begun = 1;
    bytes->last = now;
    bytes->word = (bytes->word >> 8) | (uint32_t)byte << 24;
    if (++bytes->size < MT_WORD_SIZE)
        return 0;
    bytes->size = 0;
    *word = bytes->word;
    return 1;
}

int mt_poll(struct mt_register *reg, uint32_t value) {
    int changed = reg->seen && value != reg->last;
    reg->seen = 1;
    reg->last = value;
    return changed;
}
