// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/support/can_bits.c
// sources: nodes/link/io/io_[fr]*.c nodes/link/io/io_s[ct]*.c nodes/link/io/io_send.c
// A computer without memory: what cannot be made is refused, and nothing is left behind (the sanitizer sees
// it).
#include <stdlib.h>

#include "tests/check.h"

static int until_failure = -1; // how many allocations go well; -1: all

static void *scarce_calloc(size_t count, size_t size) {
    return until_failure-- == 0 ? NULL : calloc(count, size);
}

#define calloc scarce_calloc
#include "nodes/link/io/io_core.c"
#include "nodes/link/io/io_links.c"

static uint64_t now_of(void *context) {
    (void)context;
    return 1;
}

static void nothing(void *context) {
    (void)context;
}

static const struct io_driver driver = {now_of, nothing, nothing, nothing, nothing, NULL};
static const struct io_settings unknown_speed = {0};
static const struct link_settings usual = {.receive_window = 192, .lost_after_ns = 1000000000};

int main(void) {
    for (int memories = 0; memories < 3; memories++) { // the bus itself and two rings
        until_failure = memories;
        CHECK(!io_new(IO_CAN_STREAM, &unknown_speed, &driver, NULL));
    }
    until_failure = 3;
    uint32_t number = 0;
    struct io_bus *bus = io_new(IO_CAN_STREAM, &unknown_speed, &driver, NULL);
    CHECK(bus);
    CHECK_EQUAL(io_open_link(bus, 4, &usual, &number), IO_NO_MEMORY);
    CHECK_EQUAL(number, 0);
    CHECK_EQUAL(io_open_link(bus, 4, &usual, &number), IO_OK); // as if it had never been tried
    CHECK_EQUAL(number, 1);
    CHECK_EQUAL(io_open_link(bus, 5, &usual, &number), IO_OK);
    io_free(bus);
    return 0;
}
