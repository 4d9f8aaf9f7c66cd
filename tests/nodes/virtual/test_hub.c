// SPDX-License-Identifier: Apache-2.0
// sources: nodes/virtual/hub.c nodes/virtual/hub_faults.c nodes/support/can_bits.c
// The virtual bus under virtual time: arbitration, one order, true rate, back-pressure, loss, garbage.
#include "nodes/support/can_bits.h"
#include "nodes/virtual/hub.h"
#include "tests/check.h"

#include <string.h>

enum { STUCK_LIMIT_NS = 2000000000 };

// Room for as many as the hub's own structure needs; static, so that the stack stays small.
static struct hub hub;

static void begin(uint32_t bitrate, double loss, uint64_t seed) {
    const struct hub_config config = {
        .bitrate = bitrate, .loss = loss, .seed = seed, .stuck_limit_ns = STUCK_LIMIT_NS};
    hub_init(&hub, &config);
}

static void make_record(uint8_t *record, uint32_t id, uint32_t tag) {
    memset(record, 0, HUB_RECORD);
    memcpy(record, &id, sizeof(id));
    record[4] = 4;
    memcpy(record + 8, &tag, sizeof(tag));
}

static void put(int client, uint32_t id, uint32_t tag, uint64_t now_ns) {
    uint8_t record[HUB_RECORD];
    make_record(record, id, tag);
    hub_receive(&hub, client, record, sizeof(record), now_ns);
}

// Takes one frame of a client's output; returns its tag, or UINT32_MAX when nothing waits.
static uint32_t get(int client, uint64_t now_ns) {
    const uint8_t *data;
    uint32_t tag;
    if (hub_output(&hub, client, &data) < HUB_RECORD)
        return UINT32_MAX;
    memcpy(&tag, data + 8, sizeof(tag));
    hub_taken(&hub, client, HUB_RECORD, now_ns);
    return tag;
}

static uint32_t bits_of(uint32_t id, uint32_t tag) {
    uint8_t record[HUB_RECORD];
    make_record(record, id, tag);
    return can_frame_bits(id, record[4], record + 8);
}

static void known_lengths(void) {
    static const uint8_t zeros[8] = {0};
    // All zeros, checksum included: a stuff bit after every five of the 34 bits.
    CHECK_EQUAL(can_frame_bits(0x000, 0, zeros), 47 + 34 / 5);
    CHECK_EQUAL(can_frame_bits(0x000, 0, NULL), 47 + 34 / 5); // no data, none looked at
}

static void lowest_id_wins_and_equals_take_turns(void) {
    begin(1000000, 0, 0);
    int a = hub_connect(&hub), b = hub_connect(&hub), c = hub_connect(&hub), listener = hub_connect(&hub);
    put(a, 0x300, 1, 1000);
    put(a, 0x001, 2, 1000); // behind its own head: no part in the arbitration
    put(b, 0x200, 3, 1000);
    put(c, 0x200, 4, 1000);
    put(b, 0x200, 5, 1000);
    put(c, 0x200, 6, 1000);
    hub_run(&hub, 1000000000);
    static const uint32_t expected[] = {3, 4, 5, 6, 1, 2};
    for (size_t i = 0; i < 6; i++)
        CHECK_EQUAL(get(listener, 1000000000), expected[i]);
    CHECK_EQUAL(get(listener, 1000000000), UINT32_MAX);
    CHECK_EQUAL(get(a, 1000000000), 3); // and never its own
    CHECK_EQUAL(get(a, 1000000000), 4);
    CHECK_EQUAL(hub.clients[a].counters.sent, 2);
}

static void a_later_urgent_frame_waits_for_the_one_on_the_wire(void) {
    begin(1000000, 0, 0);
    int a = hub_connect(&hub), b = hub_connect(&hub), listener = hub_connect(&hub);
    put(a, 0x400, 1, 1000);
    put(a, 0x400, 2, 1000);
    hub_run(&hub, 1000);
    uint64_t end_ns = 1000 + 1000 * (uint64_t)bits_of(0x400, 1);
    CHECK_EQUAL(hub_deadline(&hub), end_ns);
    put(b, 0x010, 3, end_ns - 1);
    hub_run(&hub, end_ns - 1);
    CHECK_EQUAL(get(listener, end_ns), UINT32_MAX); // not before its last bit
    hub_run(&hub, end_ns);
    CHECK_EQUAL(get(listener, end_ns), 1);
    hub_run(&hub, end_ns + 1000000);
    CHECK_EQUAL(get(listener, end_ns), 3); // became ready a nanosecond before the bus was free
    CHECK_EQUAL(get(listener, end_ns), 2);
}

// Every rate, awkward ones too: over ten thousand frames the bus is not a nanosecond off.
static void rate_is_exact(void) {
    static const uint32_t rates[] = {1000000, 500000, 250000, 83333, 999983};
    for (size_t r = 0; r < sizeof(rates) / sizeof(*rates); r++) {
        begin(rates[r], 0, 0);
        int sender = hub_connect(&hub);
        uint64_t bits = 0, end_ns = 5000, sent = 0;
        for (uint32_t tag = 0; tag < 10000; tag++) {
            put(sender, tag % 2048, tag, 5000);
            bits += bits_of(tag % 2048, tag);
            if (hub_room(&hub, sender) < HUB_RECORD || tag == 9999)
                while (hub_deadline(&hub) != HUB_NEVER && hub_room(&hub, sender) < 200 * HUB_RECORD) {
                    end_ns = hub_deadline(&hub);
                    hub_run(&hub, end_ns);
                }
        }
        while (hub_deadline(&hub) != HUB_NEVER) {
            end_ns = hub_deadline(&hub);
            hub_run(&hub, end_ns);
        }
        sent = hub.counters.frames;
        CHECK_EQUAL(sent, 10000);
        CHECK_EQUAL(hub.counters.bits, bits);
        CHECK_EQUAL(end_ns, 5000 + bits * 1000000000 / rates[r]);
        CHECK_EQUAL(hub.counters.busy_ns, end_ns - 5000);
    }
}

// A caller that sleeps for long finds what it would have found by coming in time.
static void a_late_caller_loses_no_bus_time(void) {
    begin(1000000, 0, 0);
    int sender = hub_connect(&hub), listener = hub_connect(&hub);
    uint64_t now_ns = 1000, bits = 0;
    uint32_t tag = 0;
    for (int round = 0; round < 20; round++) {
        // It comes back after the queue ran empty; the sender had more all the time.
        while (hub_room(&hub, sender) >= HUB_RECORD) {
            put(sender, 0x123, tag, now_ns);
            bits += bits_of(0x123, tag++);
        }
        now_ns += 20000000;
        hub_run(&hub, now_ns);
        while (get(listener, now_ns) != UINT32_MAX)
            ;
    }
    while (hub_deadline(&hub) != HUB_NEVER) {
        now_ns = hub_deadline(&hub);
        hub_run(&hub, now_ns);
    }
    CHECK_EQUAL(now_ns, 1000 + bits * 1000);
}

// Frames for which there had been no room were ready when the client last filled its queue.
static void a_backlog_keeps_its_place_in_time(void) {
    begin(1000000, 0, 0);
    int sender = hub_connect(&hub);
    uint64_t bits = 0;
    for (uint32_t tag = 0; tag < HUB_INPUT; tag++) {
        put(sender, 1, tag, 1000);
        bits += bits_of(1, tag);
    }
    hub_run(&hub, 1000 + bits * 1000 + 500000); // half a millisecond after the last of them
    put(sender, 1, 0, 1000 + bits * 1000 + 500000);
    hub_run(&hub, 1000 + bits * 1000 + 500000);
    CHECK_EQUAL(hub.counters.frames, HUB_INPUT + 1);
    CHECK_EQUAL(hub.counters.busy_ns, (bits + bits_of(1, 0)) * 1000);
    CHECK_EQUAL(hub_deadline(&hub), HUB_NEVER);
}

static void a_slow_reader_stops_the_bus_and_loses_nothing(void) {
    begin(0, 0, 0);
    int sender = hub_connect(&hub), slow = hub_connect(&hub), quick = hub_connect(&hub);
    uint32_t tag = 0, slow_next = 0, quick_next = 0;
    uint64_t now_ns = 1000;
    while (slow_next < 20000) {
        while (tag < 20000 && hub_room(&hub, sender) >= HUB_RECORD)
            put(sender, 7, tag++, now_ns);
        hub_run(&hub, now_ns);
        while (quick_next < tag) {
            uint32_t got = get(quick, now_ns);
            if (got == UINT32_MAX)
                break;
            CHECK_EQUAL(got, quick_next++);
        }
        CHECK(quick_next - slow_next <= HUB_OUTPUT);
        now_ns += STUCK_LIMIT_NS / 4; // slow, but never without a frame for the whole limit
        for (int i = 0; i < 37 && slow_next < quick_next; i++)
            CHECK_EQUAL(get(slow, now_ns), slow_next++);
    }
    CHECK_EQUAL(quick_next, 20000);
    CHECK_EQUAL(hub.counters.expelled, 0);
    CHECK_EQUAL(hub.counters.lost, 0);
}

static void a_stuck_client_is_expelled(void) {
    begin(1000000, 0, 0);
    int sender = hub_connect(&hub), stuck = hub_connect(&hub), listener = hub_connect(&hub);
    uint64_t now_ns = 1000;
    uint32_t tag = 0, seen = 0;
    while (hub.clients[stuck].stuck_ns == 0) {
        while (hub_room(&hub, sender) >= HUB_RECORD)
            put(sender, 7, tag++, now_ns);
        now_ns += 1000000;
        hub_run(&hub, now_ns);
        while (get(listener, now_ns) != UINT32_MAX)
            seen++;
    }
    CHECK_EQUAL(seen, HUB_OUTPUT);
    uint64_t since_ns = hub.clients[stuck].stuck_ns;
    CHECK_EQUAL(hub_deadline(&hub), since_ns + STUCK_LIMIT_NS);
    hub_run(&hub, since_ns + STUCK_LIMIT_NS - 1);
    CHECK(!hub_finished(&hub, stuck));
    now_ns = since_ns + STUCK_LIMIT_NS;
    hub_run(&hub, now_ns);
    CHECK(hub_finished(&hub, stuck));
    CHECK_EQUAL(hub.counters.expelled, 1);
    // The bus goes on from now: it does not race through the time it stood still.
    CHECK_EQUAL(hub_deadline(&hub), now_ns + 1000 * (uint64_t)bits_of(7, seen));
    hub_run(&hub, hub_deadline(&hub));
    CHECK_EQUAL(get(listener, now_ns), seen);
    hub_release(&hub, stuck);
    CHECK_EQUAL(hub_connect(&hub), stuck);
}

static void a_stuck_client_that_leaves_frees_the_bus(void) {
    begin(0, 0, 0);
    int sender = hub_connect(&hub), stuck = hub_connect(&hub);
    for (uint32_t tag = 0; tag < HUB_OUTPUT + 1; tag++) {
        put(sender, 7, tag, 1000);
        hub_run(&hub, 1000);
    }
    CHECK_EQUAL(hub.counters.frames, HUB_OUTPUT);
    hub_leave(&hub, stuck, 5000);
    CHECK(hub_finished(&hub, stuck));
    hub_run(&hub, 5000);
    CHECK_EQUAL(hub.counters.frames, HUB_OUTPUT + 1);
}

static void who_leaves_has_its_frames_sent(void) {
    begin(1000000, 0, 0);
    int leaver = hub_connect(&hub), listener = hub_connect(&hub);
    put(leaver, 7, 1, 1000);
    hub_leave(&hub, leaver, 1000);
    put(leaver, 7, 2, 1000); // read from its socket after it had gone
    hub_run(&hub, 1000);
    CHECK(!hub_finished(&hub, leaver));
    hub_run(&hub, 1000000);
    CHECK(hub_finished(&hub, leaver));
    CHECK_EQUAL(get(listener, 1000000), 1);
    CHECK_EQUAL(get(listener, 1000000), 2);
}

static uint64_t losses(double loss, uint64_t seed, uint8_t *which) {
    begin(0, loss, seed);
    int sender = hub_connect(&hub), listener = hub_connect(&hub), other = hub_connect(&hub);
    for (uint32_t tag = 0; tag < 20000; tag++) {
        put(sender, 7, tag, 1000);
        hub_run(&hub, 1000);
        uint32_t got = get(listener, 1000);
        CHECK_EQUAL(get(other, 1000), got); // lost for everybody or for nobody
        CHECK(got == tag || got == UINT32_MAX);
        which[tag] = got == UINT32_MAX;
    }
    return hub.counters.lost;
}

static void loss_is_seeded(void) {
    static uint8_t first[20000], again[20000], other[20000];
    uint64_t lost = losses(0.01, 42, first);
    CHECK(lost > 140 && lost < 260); // 200 expected, deviation 14
    CHECK_EQUAL(losses(0.01, 42, again), lost);
    CHECK(memcmp(first, again, sizeof(first)) == 0);
    losses(0.01, 43, other);
    CHECK(memcmp(first, other, sizeof(first)) != 0);
    CHECK_EQUAL(losses(0, 42, first), 0);
    CHECK_EQUAL(losses(1, 42, first), 20000);
}

static void garbage_is_dropped_and_counted(void) {
    begin(0, 0, 0);
    int noisy = hub_connect(&hub), listener = hub_connect(&hub);
    static const uint32_t bad_ids[] = {0x80000001, 0x40000001, 0x20000001, 0x800, 0xFFFFFFFF};
    for (size_t i = 0; i < 5; i++)
        put(noisy, bad_ids[i], 1, 1000);
    uint8_t record[HUB_RECORD];
    make_record(record, 5, 2);
    record[4] = 9;
    hub_receive(&hub, noisy, record, sizeof(record), 1000);
    // A good frame in pieces, with rubbish where a frame has none.
    make_record(record, 5, 3);
    record[5] = record[6] = record[7] = record[12] = record[15] = 0xEE;
    for (size_t i = 0; i < HUB_RECORD; i++)
        hub_receive(&hub, noisy, record + i, 1, 1000);
    hub_receive(&hub, noisy, record, 7, 1000); // cut off by its leaving
    hub_leave(&hub, noisy, 1000);
    hub_run(&hub, 1000);
    CHECK_EQUAL(hub.counters.rejected, 6);
    CHECK_EQUAL(hub.clients[noisy].counters.rejected, 6);
    CHECK_EQUAL(hub.counters.frames, 1);
    const uint8_t *data;
    CHECK_EQUAL(hub_output(&hub, listener, &data), HUB_RECORD);
    make_record(record, 5, 3);
    CHECK(memcmp(data, record, HUB_RECORD) == 0);
    CHECK(hub_finished(&hub, noisy));
}

// Whatever bytes in whatever pieces: the hub stays whole (the sanitizers watch) and its queues bounded.
static void any_bytes_do_no_harm(void) {
    begin(1000000, 0.1, 1);
    uint64_t random = 1, now_ns = 1000;
    for (int i = 0; i < 5; i++)
        hub_connect(&hub);
    for (int step = 0; step < 200000; step++) {
        random = random * 6364136223846793005u + 1442695040888963407u;
        int client = (int)(random >> 33) % 5;
        uint8_t bytes[40];
        for (size_t i = 0; i < sizeof(bytes); i++)
            bytes[i] = (uint8_t)((random >> (i % 50)) & (i % 16 == 1 || i % 16 == 4 ? 7 : 0xFF));
        bytes[2] = bytes[3] = bytes[18] = bytes[19] = 0; // or hardly any would be a frame
        size_t room = hub_room(&hub, client), size = (size_t)(random >> 40) % sizeof(bytes);
        hub_receive(&hub, client, bytes, size < room ? size : room, now_ns);
        now_ns += (random >> 20) % 100000;
        hub_run(&hub, now_ns);
        const uint8_t *data;
        size_t waiting = hub_output(&hub, client, &data);
        CHECK(waiting <= HUB_OUTPUT * HUB_RECORD);
        hub_taken(&hub, client, waiting < 33 ? waiting : 33, now_ns);
    }
    CHECK(hub.counters.frames > 1000 && hub.counters.rejected > 1000);
}

static void places_are_bounded(void) {
    begin(0, 0, 0);
    for (int i = 0; i < HUB_CLIENTS; i++)
        CHECK_EQUAL(hub_connect(&hub), i);
    CHECK_EQUAL(hub_connect(&hub), -1);
    CHECK_EQUAL(hub.counters.refused, 1);
    hub_leave(&hub, 13, 1000);
    CHECK(hub_finished(&hub, 13));
    hub_release(&hub, 13);
    CHECK_EQUAL(hub_connect(&hub), 13);
}

int main(void) {
    known_lengths();
    lowest_id_wins_and_equals_take_turns();
    a_later_urgent_frame_waits_for_the_one_on_the_wire();
    rate_is_exact();
    a_late_caller_loses_no_bus_time();
    a_backlog_keeps_its_place_in_time();
    a_slow_reader_stops_the_bus_and_loses_nothing();
    a_stuck_client_is_expelled();
    a_stuck_client_that_leaves_frees_the_bus();
    who_leaves_has_its_frames_sent();
    loss_is_seeded();
    garbage_is_dropped_and_counted();
    any_bytes_do_no_harm();
    places_are_bounded();
    return 0;
}
