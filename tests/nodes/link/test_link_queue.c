// SPDX-License-Identifier: Apache-2.0
// sources: nodes/link/core/queue.c
// A ring of records: whole at every offset of its wrap, full to the last byte, with its high-water marks.
#include "nodes/link/core/queue.h"

#include <stdlib.h>
#include <string.h>

#include "nodes/link/core/batch.h"
#include "tests/check.h"

enum { SIZE = 256, STAMP = 8 };

static struct link_queue open_with(int stamped, size_t size) {
    struct link_queue queue;
    memset(&queue, 1, sizeof queue);
    uint8_t *memory = malloc(size); // of its own, so that a byte beside it is noticed
    CHECK(memory);
    memset(memory, 1, size);
    link_queue_init(&queue, memory, size, stamped);
    return queue;
}

static struct link_queue open(int stamped) {
    return open_with(stamped, SIZE);
}

static int put(struct link_queue *queue, uint8_t size, uint64_t number) {
    uint8_t payload[UINT8_MAX], record[BATCH_HEADER + UINT8_MAX];
    memset(payload, (int)(number % 251), sizeof payload);
    struct link_command command = {number << 40 | 1, number << 32 | 2, number << 24 | 3, size};
    if (queue->stamped)
        return link_queue_put_stamped(queue, &command, payload);
    size_t length = batch_write(record, command.min_clock, command.req_clock, payload, size);
    return link_queue_put(queue, record, length, 1);
}

static void check_first(struct link_queue *queue, uint8_t size, uint64_t number) {
    struct link_command command;
    memset(&command, 1, sizeof command);
    uint64_t behind = link_queue_peek(queue, queue->head, &command);
    CHECK_EQUAL(behind - queue->head, BATCH_HEADER + (queue->stamped ? STAMP : 0) + size);
    CHECK_EQUAL(command.min_clock, number << 40 | 1);
    CHECK_EQUAL(command.req_clock, number << 32 | 2);
    CHECK_EQUAL(command.queued_ns, queue->stamped ? number << 24 | 3 : 0);
    CHECK_EQUAL(command.size, size);
    uint8_t payload[UINT8_MAX], expected[UINT8_MAX];
    memset(payload, 0xEE, sizeof payload);
    memset(expected, 0xEE, sizeof expected);
    memset(expected, (int)(number % 251), size);
    link_queue_payload(queue, queue->head, &command, payload);
    CHECK(memcmp(payload, expected, sizeof payload) == 0);
    link_queue_drop(queue, behind, 1);
}

static void records_survive_every_wrap(int stamped) {
    struct link_queue queue = open(stamped);
    CHECK_EQUAL(link_queue_bytes(&queue), 0);
    for (uint64_t number = 1; number <= 600; number++) {
        uint8_t size = (uint8_t)(number * 7 % 60);
        CHECK(put(&queue, size, number));
        CHECK(put(&queue, 2, number + 1000));
        CHECK_EQUAL(queue.commands, 2);
        check_first(&queue, size, number);
        check_first(&queue, 2, number + 1000);
        CHECK_EQUAL(queue.commands, 0);
        CHECK_EQUAL(link_queue_bytes(&queue), 0);
    }
    CHECK_EQUAL(queue.commands_max, 2);
    CHECK_EQUAL(queue.bytes_max, 2 * (BATCH_HEADER + (stamped ? STAMP : 0)) + 59 + 2);
    free(queue.memory);
}

static void it_is_filled_to_the_last_byte(void) {
    for (unsigned start = 0; start < SIZE; start++) {
        struct link_queue queue = open(0);
        uint8_t filler[SIZE] = {0};
        CHECK_EQUAL(link_queue_put(&queue, filler, start, 1), 1);
        link_queue_drop(&queue, start, 1);
        CHECK(put(&queue, 111, 1));
        CHECK(put(&queue, 110, 2));
        CHECK_EQUAL(link_queue_bytes(&queue), SIZE - 1);
        CHECK_EQUAL(queue.bytes_max, start > SIZE - 1 ? start : SIZE - 1);
        CHECK_EQUAL(link_queue_put(&queue, filler, 2, 1), 0);
        CHECK_EQUAL(queue.commands, 2);
        CHECK_EQUAL(link_queue_put(&queue, filler, 1, 3), 1);
        CHECK_EQUAL(link_queue_bytes(&queue), SIZE);
        CHECK_EQUAL(queue.commands, 5);
        CHECK_EQUAL(queue.commands_max, 5);
        CHECK_EQUAL(queue.bytes_max, SIZE);
        CHECK_EQUAL(link_queue_put(&queue, filler, 1, 1), 0);
        check_first(&queue, 111, 1);
        check_first(&queue, 110, 2);
        CHECK_EQUAL(queue.commands_max, 5);
        CHECK_EQUAL(link_queue_bytes(&queue), 1);
        free(queue.memory);
    }
}

static void the_longest_record_is_whole(void) {
    struct link_queue queue = open_with(1, 512);
    for (uint64_t number = 1; number <= 9; number++) {
        CHECK(put(&queue, 255, number));
        check_first(&queue, 255, number);
    }
    free(queue.memory);
}

// The rest of the memory is poisoned: a queue that stays short has not touched it.
static void it_uses_no_more_memory_than_it_needs(void) {
    enum { BIG = 1 << 16, ROOM = 4096 };
    struct link_queue queue = open_with(0, BIG);
    for (uint64_t number = 1; number <= 5000; number++) {
        CHECK(put(&queue, (uint8_t)(number % 250), number));
        if (number > 9)
            check_first(&queue, (uint8_t)((number - 9) % 250), number - 9);
    }
    CHECK_EQUAL(queue.room, ROOM);
    for (unsigned i = ROOM; i < BIG; i++)
        CHECK_EQUAL(queue.memory[i], 1);
    free(queue.memory);
}

// From every place in the ring, with both stretches and with one: all that waits is whole, in its order.
static void it_grows_from_everywhere(void) {
    enum { BIG = 1 << 16, ROOM = 4096, RECORD = BATCH_HEADER + 100 };
    for (uint64_t start = 0; start < 2 * BIG; start += start < 4 * ROOM ? 7 : 1021) {
        struct link_queue queue = open_with(0, BIG);
        uint8_t filler[ROOM] = {0};
        for (uint64_t at = 0, size; at < start; at += size) {
            size = start - at < ROOM ? start - at : ROOM;
            CHECK_EQUAL(link_queue_put(&queue, filler, (size_t)size, 1), 1);
            link_queue_drop(&queue, queue.tail, 1);
        }
        CHECK_EQUAL(queue.room, ROOM);
        uint64_t put_in = 0, taken = 0;
        while (link_queue_bytes(&queue) + RECORD <= BIG) {
            CHECK(put(&queue, 100, ++put_in));
            if (put_in % 5 == 0)
                check_first(&queue, 100, ++taken);
        }
        CHECK_EQUAL(queue.room, BIG);
        while (taken < put_in)
            check_first(&queue, 100, ++taken);
        CHECK_EQUAL(link_queue_bytes(&queue), 0);
        free(queue.memory);
    }
}

int main(void) {
    it_uses_no_more_memory_than_it_needs();
    it_grows_from_everywhere();
    the_longest_record_is_whole();
    records_survive_every_wrap(0);
    records_survive_every_wrap(1);
    it_is_filled_to_the_last_byte();
    return 0;
}
