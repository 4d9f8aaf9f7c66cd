// SPDX-License-Identifier: Apache-2.0
// The records of a batch, byte by byte: as Python and the motion engine write them, too.
#include <stdlib.h>

#include "nodes/link/core/batch.h"
#include "tests/check.h"

enum { PAYLOAD = 5, WHOLE = 8 + 8 + 1 + PAYLOAD };

static const struct __attribute__((packed)) {
    uint64_t min_clock, req_clock;
    uint8_t size, payload[PAYLOAD];
} wanted = {0x1122334455667788, 0x99AABBCCDDEEFF00, PAYLOAD, "abcd"};

static void a_record_is_written(void) {
    uint8_t *bytes = malloc(WHOLE); // no more, so that the sanitizer sees one
    CHECK_EQUAL(batch_write(bytes, wanted.min_clock, wanted.req_clock, wanted.payload, PAYLOAD), WHOLE);
    CHECK(sizeof wanted == WHOLE && memcmp(bytes, &wanted, WHOLE) == 0);
    free(bytes);
}

static void a_record_is_read_when_it_is_whole(void) {
    for (size_t room = 0; room <= WHOLE + 1; room++) {
        uint8_t *bytes = malloc(room + 1);
        uint8_t *at = bytes + 1; // at any address
        memset(at, 0xEE, room);
        memcpy(at, &wanted, room < WHOLE ? room : WHOLE);
        struct batch_record record = {7, 7, 7, NULL};
        if (room < WHOLE) {
            CHECK_EQUAL(batch_read(at, room, &record), 0);
            CHECK(record.min_clock == 7 && record.req_clock == 7 && record.size == 7 && !record.payload);
        } else {
            CHECK_EQUAL(batch_read(at, room, &record), WHOLE);
            CHECK(record.min_clock == wanted.min_clock && record.req_clock == wanted.req_clock);
            CHECK(record.size == PAYLOAD && memcmp(record.payload, wanted.payload, PAYLOAD) == 0);
        }
        free(bytes);
    }
}

static void a_record_may_be_empty(void) {
    uint8_t bytes[BATCH_HEADER];
    struct batch_record record;
    CHECK_EQUAL(batch_write(bytes, 1, 2, bytes, 0), 17);
    CHECK_EQUAL(batch_read(bytes, 17, &record), 17);
    CHECK_EQUAL(record.size, 0);
    CHECK_EQUAL(batch_read(bytes, 16, &record), 0);
}

int main(void) {
    a_record_is_written();
    a_record_is_read_when_it_is_whole();
    a_record_may_be_empty();
    return 0;
}
