// SPDX-License-Identifier: Apache-2.0
// sources: nodes/virtual/hub.c nodes/virtual/hub_faults.c nodes/support/can_bits.c
// Faults of the virtual bus under virtual time: each kind does what it says, to whom it says, when it says.
#include "nodes/support/can_bits.h"
#include "nodes/virtual/hub.h"
#include "tests/check.h"

#include <string.h>

enum { BIT_NS = 1000 };

static struct hub hub;
static int a, b, listener;

static struct hub_rule any(uint32_t kind, double share) {
    return (struct hub_rule){
        .kind = kind, .sender = -1, .receiver = -1, .share = share, .until_ns = UINT64_MAX / 2};
}

// A bus at BITRATE with two senders and a listener, and rules from time 0 on.
static void begin(uint32_t bitrate, const struct hub_rule *rules, size_t count) {
    const struct hub_config config = {.bitrate = bitrate, .seed = 7, .stuck_limit_ns = 2000000000};
    hub_init(&hub, &config);
    a = hub_connect(&hub);
    b = hub_connect(&hub);
    listener = hub_connect(&hub);
    hub_set_rules(&hub, rules, count, 0);
}

static void put_data(int client, uint32_t id, const void *data, uint8_t length, uint64_t now_ns) {
    uint8_t record[HUB_RECORD] = {0};
    memcpy(record, &id, sizeof(id));
    record[4] = length;
    memcpy(record + 8, data, length);
    hub_receive(&hub, client, record, sizeof(record), now_ns);
}

static void put(int client, uint32_t id, uint32_t tag, uint64_t now_ns) {
    put_data(client, id, &tag, sizeof(tag), now_ns);
}

// Takes one frame of a client's output; returns its tag, or UINT32_MAX when nothing waits.
static uint32_t get(int client) {
    const uint8_t *data;
    uint32_t tag;
    if (hub_output(&hub, client, &data) < HUB_RECORD)
        return UINT32_MAX;
    memcpy(&tag, data + 8, sizeof(tag));
    hub_taken(&hub, client, HUB_RECORD, hub.free_ns);
    return tag;
}

static uint32_t bits_of(uint32_t id, uint32_t tag) {
    uint8_t data[4];
    memcpy(data, &tag, sizeof(data));
    return can_frame_bits(id, sizeof(data), data);
}

// Runs to the end of all that waits, always in time; returns when that is.
static uint64_t finish(uint64_t now_ns) {
    while (hub_deadline(&hub) != HUB_NEVER) {
        now_ns = hub_deadline(&hub);
        hub_run(&hub, now_ns);
    }
    return now_ns;
}

static void rules_pick_by_id_sender_time_and_number(void) {
    struct hub_rule rules[] = {any(HUB_LOSE, 1), any(HUB_LOSE, 1), any(HUB_LOSE, 1), any(HUB_LOSE, 0)};
    rules[0].id = 0x109, rules[0].mask = 0x7FE; // 108 and 109: bits outside the mask do not count
    rules[1].sender = 1, rules[1].id = 0x200, rules[1].mask = 0x7FF;
    rules[2].from_ns = 5000, rules[2].until_ns = 6000;
    rules[3].nth = 3, rules[3].id = 0x300, rules[3].mask = 0x700;
    begin(0, rules, 4);
    static const struct {
        int client;
        uint32_t id;
        uint64_t now_ns;
        bool lost;
    } frames[] = {
        {0, 0x107, 1000, false}, {0, 0x108, 1000, true},  {1, 0x109, 1000, true},  {0, 0x10A, 1000, false},
        {0, 0x200, 1000, false}, {1, 0x200, 1000, true},  {1, 0x201, 1000, false}, {0, 0x300, 1000, false},
        {0, 0x301, 1000, false}, {1, 0x300, 1000, false}, {0, 0x302, 1000, true},  {0, 0x303, 1000, false},
        {0, 0x700, 4999, false}, {0, 0x700, 5000, true},  {0, 0x700, 5999, true},  {0, 0x700, 6000, false},
    };
    for (uint32_t i = 0; i < sizeof(frames) / sizeof(*frames); i++) {
        put(frames[i].client, frames[i].id, i, frames[i].now_ns);
        hub_run(&hub, frames[i].now_ns);
        CHECK_EQUAL(get(listener), frames[i].lost ? UINT32_MAX : i);
    }
    CHECK_EQUAL(hub.counters.lost, 6);
    CHECK_EQUAL(hub.faults.counters[0].hits, 2);
    CHECK_EQUAL(hub.faults.counters[3].picked, 5);
    CHECK_EQUAL(hub.faults.counters[3].hits, 1);
}

static void one_receiver_alone_may_be_hit(void) {
    struct hub_rule rule = any(HUB_LOSE, 1);
    rule.receiver = 1;
    begin(0, &rule, 1);
    put(a, 5, 77, 1000);
    hub_run(&hub, 1000);
    CHECK_EQUAL(get(b), UINT32_MAX);
    CHECK_EQUAL(get(listener), 77);
    CHECK_EQUAL(hub.counters.lost, 0);
    CHECK_EQUAL(hub.counters.lost_copies, 1);
    rule.kind = HUB_CORRUPT;
    begin(0, &rule, 1);
    put(a, 5, 77, 1000);
    hub_run(&hub, 1000);
    CHECK(get(b) != 77);
    CHECK_EQUAL(get(listener), 77);
    CHECK_EQUAL(hub.counters.corrupted, 1);
}

static void corruption_changes_one_bit_of_the_data(void) {
    struct hub_rule rule = any(HUB_CORRUPT, 1);
    begin(0, &rule, 1);
    uint64_t seen = 0;
    for (uint32_t i = 0; i < 9000; i++) {
        uint8_t length = (uint8_t)(i % 9);
        static const uint8_t data[8] = {1, 2, 3, 4, 5, 6, 7, 8};
        put_data(a, 0x123, data, length, 1000);
        hub_run(&hub, 1000);
        const uint8_t *got;
        CHECK_EQUAL(hub_output(&hub, listener, &got), HUB_RECORD);
        int changed = 0;
        for (int k = 0; k < 64; k++)
            if ((got[8 + k / 8] ^ (k / 8 < length ? data[k / 8] : 0)) >> (7 - k % 8) & 1) {
                CHECK(k < length * 8);
                seen |= (uint64_t)1 << k;
                changed++;
            }
        CHECK_EQUAL(changed, length > 0);
        CHECK_EQUAL(got[4], length);
        hub_taken(&hub, listener, HUB_RECORD, 1000);
        get(b);
    }
    CHECK_EQUAL(seen, UINT64_MAX); // any bit, in time
    CHECK_EQUAL(hub.counters.corrupted, 8000);
}

static void a_duplicate_costs_bus_time_and_comes_once(void) {
    struct hub_rule rule = any(HUB_DUPLICATE, 1);
    begin(1000000, &rule, 1);
    put(a, 0x200, 1, 1000);
    put(a, 0x200, 2, 1000);
    put(b, 0x200, 3, 1000); // equal ids take turns: the repetition waits for it, order is kept all the same
    uint64_t bits = 2 * (bits_of(0x200, 1) + bits_of(0x200, 2) + bits_of(0x200, 3));
    CHECK_EQUAL(finish(1000), 1000 + bits * BIT_NS);
    static const uint32_t expected[] = {3, 1, 3, 1, 2, 2, UINT32_MAX};
    for (size_t i = 0; i < 7; i++)
        CHECK_EQUAL(get(listener), expected[i]);
    CHECK_EQUAL(hub.counters.duplicated, 3);
    CHECK_EQUAL(hub.counters.frames, 6);
}

static void an_error_frame_costs_time_and_the_frame_comes_later(void) {
    struct hub_rule rule = any(HUB_ERROR, 0);
    rule.nth = 1;
    begin(1000000, &rule, 1);
    put(a, 0x200, 1, 1000);
    put(a, 0x100, 2, 1000);
    uint64_t good = bits_of(0x200, 1) + bits_of(0x100, 2);
    uint64_t lost_bits = (finish(1000) - 1000) / BIT_NS - good;
    CHECK(lost_bits > 23 && lost_bits <= bits_of(0x200, 1) - 10 + 23);
    CHECK_EQUAL(get(listener), 1); // in order
    CHECK_EQUAL(get(listener), 2);
    CHECK_EQUAL(hub.counters.errors, 1);
    CHECK_EQUAL(hub.counters.frames, 2);
    CHECK_EQUAL(hub.counters.bits, good + lost_bits);
    CHECK_EQUAL(hub.clients[a].counters.sent, 2);
}

// Thirty-two failures in a row: the sender's error counter says bus-off; then it recovers.
static void errors_without_end_are_bus_off(void) {
    struct hub_rule rule = any(HUB_ERROR, 1);
    rule.sender = 0;
    begin(1000000, &rule, 1);
    put(a, 0x100, 1, 1000);
    put(a, 0x100, 2, 1000);
    put(b, 0x200, 3, 1000);
    uint64_t end_ns = finish(1000);
    CHECK_EQUAL(hub.counters.errors, 32);
    CHECK_EQUAL(hub.counters.bus_offs, 1);
    CHECK_EQUAL(hub.counters.unsent, 2);
    CHECK_EQUAL(get(listener), 3);
    CHECK_EQUAL(hub.clients[a].off_ns, end_ns - bits_of(0x200, 3) * BIT_NS + 1408 * BIT_NS);
    uint64_t back_ns = hub.clients[a].off_ns;
    put(a, 0x100, 4, back_ns); // it starts from nothing again
    finish(back_ns);
    CHECK_EQUAL(hub.counters.errors, 64);
    CHECK_EQUAL(hub.counters.bus_offs, 2);
    begin(0, &rule, 1); // where frames take no time, this ends too
    put(a, 0x100, 1, 1000);
    hub_run(&hub, 1000);
    CHECK_EQUAL(hub.counters.unsent, 1);
    CHECK_EQUAL(hub_deadline(&hub), HUB_NEVER);
}

static void a_delay_keeps_the_order_of_its_sender(void) {
    struct hub_rule rule = any(HUB_DELAY, 1);
    rule.id = 0x100, rule.mask = 0x7FF, rule.time_ns = 1000000;
    begin(1000000, &rule, 1);
    put(a, 0x100, 1, 1000); // delayed
    put(a, 0x050, 2, 1000); // behind it
    put(b, 0x300, 3, 1000); // another's
    uint64_t third_ns = 1000 + bits_of(0x300, 3) * (uint64_t)BIT_NS;
    hub_run(&hub, third_ns);
    CHECK_EQUAL(get(listener), 3);
    CHECK_EQUAL(hub_deadline(&hub), 1001000);
    uint64_t end_ns = finish(third_ns);
    CHECK_EQUAL(end_ns, 1001000 + (uint64_t)(bits_of(0x100, 1) + bits_of(0x050, 2)) * BIT_NS);
    CHECK_EQUAL(get(listener), 1);
    CHECK_EQUAL(get(listener), 2);
    CHECK_EQUAL(hub.counters.delayed, 1);
}

static void jitter_is_spread_evenly(void) {
    struct hub_rule rule = any(HUB_DELAY, 1);
    rule.time_ns = 2000, rule.jitter_ns = 1000000;
    begin(0, &rule, 1);
    uint64_t sum_ns = 0, least_ns = UINT64_MAX, most_ns = 0;
    for (uint32_t i = 0; i < 4000; i++) {
        uint64_t now_ns = (i + 1) * 10000000ull;
        put(a, 1, i, now_ns);
        uint64_t delay_ns = finish(now_ns) - now_ns;
        sum_ns += delay_ns;
        least_ns = delay_ns < least_ns ? delay_ns : least_ns;
        most_ns = delay_ns > most_ns ? delay_ns : most_ns;
        CHECK_EQUAL(get(listener), i);
        get(b);
    }
    CHECK(least_ns >= 2000 && least_ns < 10000 && most_ns < 1002000 && most_ns > 990000);
    CHECK(sum_ns / 4000 > 485000 && sum_ns / 4000 < 520000);
}

static void timed_bus_off_and_recovery(void) {
    struct hub_rule rule = any(HUB_BUS_OFF, 1);
    rule.timed = true, rule.sender = 0, rule.from_ns = 100000, rule.time_ns = 500000;
    begin(1000000, &rule, 1);
    CHECK_EQUAL(hub_deadline(&hub), 100000); // it is woken for it
    put(a, 0x100, 1, 1000);                  // sent before
    put(a, 0x100, 2, 60000);                 // on the wire when it goes off
    put(a, 0x100, 3, 60000);                 // waits
    put(b, 0x200, 4, 60000);                 // another's is sent, the one off does not hear it
    hub_run(&hub, 99999);
    CHECK(hub.on_wire == a);
    CHECK_EQUAL(hub_deadline(&hub), 100000);
    hub_run(&hub, 400000);
    CHECK_EQUAL(get(listener), 1);
    CHECK_EQUAL(get(listener), 4);
    CHECK_EQUAL(get(listener), UINT32_MAX);
    CHECK_EQUAL(get(a), UINT32_MAX);
    CHECK_EQUAL(get(b), 1);
    uint64_t duration_ns = bits_of(0x200, 8) * (uint64_t)BIT_NS;
    put(b, 0x200, 8, 600000 - duration_ns); // ends when it is back
    hub_run(&hub, 599998);
    put(a, 0x100, 5, 599999); // still off
    put(a, 0x100, 6, 600000); // back
    uint64_t end_ns = finish(600000);
    put(b, 0x200, 7, end_ns);
    finish(end_ns);
    CHECK_EQUAL(get(listener), 8);
    CHECK_EQUAL(get(listener), 6);
    CHECK_EQUAL(get(listener), 7);
    CHECK_EQUAL(get(a), 8);
    CHECK_EQUAL(get(a), 7);
    CHECK_EQUAL(hub.counters.bus_offs, 1);
    CHECK_EQUAL(hub.counters.unsent, 3);
    CHECK_EQUAL(hub.counters.unheard, 1);
    CHECK_EQUAL(hub.counters.frames, 5);
    CHECK_EQUAL(hub.faults.counters[0].hits, 1);
}

// A caller that comes late finds what it would have found in time, bus-off included.
static void a_late_caller_finds_the_same(void) {
    struct hub_rule rule = any(HUB_BUS_OFF, 1);
    rule.timed = true, rule.from_ns = 350000, rule.time_ns = 200000;
    for (int late = 0; late < 2; late++) {
        begin(1000000, &rule, 1);
        for (uint32_t tag = 0; tag < 20; tag++)
            put(a, 0x123, tag, 1000);
        if (!late)
            finish(1000);
        put(a, 0x123, 99, 2000000); // the first thing the late one does
        hub_run(&hub, 3000000);
        uint32_t sent = 0, got;
        while ((got = get(listener)) != 99)
            CHECK_EQUAL(got, sent++);
        CHECK_EQUAL(sent, (350000 - 1000) / BIT_NS / bits_of(0x123, 1));
        CHECK_EQUAL(hub.counters.unsent, 20 - sent);
        CHECK_EQUAL(hub.counters.bus_offs, 3); // all who are connected
    }
}

static void a_frame_can_send_its_sender_off(void) {
    struct hub_rule rule = any(HUB_BUS_OFF, 0);
    rule.nth = 2, rule.time_ns = 1000000;
    begin(1000000, &rule, 1);
    for (uint32_t tag = 1; tag <= 4; tag++)
        put(a, 0x100, tag, 1000);
    put(b, 0x200, 5, 1000);
    uint64_t end_ns = finish(1000);
    CHECK_EQUAL(get(listener), 1);
    CHECK_EQUAL(get(listener), 5);
    CHECK_EQUAL(get(listener), UINT32_MAX);
    CHECK_EQUAL(hub.counters.unsent, 3);
    CHECK_EQUAL(hub.clients[a].off_ns,
                1000 + (uint64_t)(bits_of(0x100, 1) + bits_of(0x100, 2)) * BIT_NS + 1000000);
    CHECK(end_ns < hub.clients[a].off_ns);
    put(a, 0x100, 6, hub.clients[a].off_ns);
    finish(hub.clients[a].off_ns);
    CHECK_EQUAL(get(listener), 6);
}

static void of_two_bus_offs_the_longer_counts(void) {
    struct hub_rule rules[] = {any(HUB_BUS_OFF, 1), any(HUB_BUS_OFF, 1)};
    for (int i = 0; i < 2; i++)
        rules[i].timed = true, rules[i].sender = 0;
    rules[0].from_ns = 1000, rules[0].time_ns = 900000;
    rules[1].from_ns = 2000, rules[1].time_ns = 100000;
    begin(1000000, rules, 2);
    finish(0);
    CHECK_EQUAL(hub.counters.bus_offs, 2);
    CHECK_EQUAL(hub.clients[a].off_ns, 901000);
}

static void delays_add_up(void) {
    struct hub_rule rules[] = {any(HUB_DELAY, 1), any(HUB_DELAY, 1)};
    rules[0].time_ns = 1000, rules[1].time_ns = 30000;
    begin(0, rules, 2);
    put(a, 1, 1, 5000);
    CHECK_EQUAL(hub_deadline(&hub), 36000);
}

static void a_bus_that_stands_still_does_not_hold_up_time(void) {
    struct hub_rule rule = any(HUB_BUS_OFF, 1);
    rule.timed = true, rule.sender = 1, rule.from_ns = 5000000, rule.time_ns = 1000000;
    begin(0, &rule, 1);
    for (uint32_t tag = 0; tag < HUB_OUTPUT + 1; tag++) { // nobody reads
        put(a, 7, tag, 1000);
        hub_run(&hub, 1000);
    }
    CHECK_EQUAL(hub_deadline(&hub), 5000000);
    hub_run(&hub, 5000000);
    CHECK_EQUAL(hub.counters.bus_offs, 1);
    CHECK_EQUAL(hub_deadline(&hub), 1000 + 2000000000ull);
}

// What hits depends on the sender's own frames alone: not on what others send in between, nor on the pieces
// in which frames arrive.
static void hits_of_a_sender_do_not_depend_on_others(void) {
    struct hub_rule rules[] = {any(HUB_LOSE, 0.3), any(HUB_ERROR, 0.2), any(HUB_DELAY, 0.5)};
    rules[2].time_ns = 100000;
    static uint8_t lost[2][3000];
    for (int run = 0; run < 2; run++) {
        begin(1000000, rules, 3);
        uint64_t now_ns = 1000;
        for (uint32_t tag = 0; tag < 3000; tag++) {
            put(a, 0x123, tag, now_ns);
            for (uint32_t k = 0; run == 1 && k < tag % 4; k++)
                put(b, 0x050 + k, 1u << 31, now_ns);
            now_ns = finish(now_ns);
            lost[run][tag] = 1;
            for (uint32_t got; (got = get(listener)) != UINT32_MAX;)
                if (got == tag)
                    lost[run][tag] = 0;
            while (get(a) != UINT32_MAX || get(b) != UINT32_MAX)
                ;
        }
    }
    CHECK(memcmp(lost[0], lost[1], sizeof(lost[0])) == 0);
    int count = 0;
    for (int i = 0; i < 3000; i++)
        count += lost[0][i];
    CHECK(count > 800 && count < 1000);
}

static void other_seeds_rules_and_senders_hit_others(void) {
    static uint8_t hits[4][2000];
    struct hub_rule rules[] = {any(HUB_LOSE, 0.5), any(HUB_CORRUPT, 0.5)};
    for (uint64_t seed = 0; seed < 2; seed++) {
        static struct hub_faults faults;
        hub_faults_init(&faults, rules, 2, seed, 0);
        for (size_t i = 0; i < 2000; i++) {
            struct hub_verdict verdict = hub_faults_judge(&faults, ~0u, 3, 1, 8, 0);
            hits[seed][i] = verdict.lost_to != 0;
            if (seed > 0)
                continue;
            hits[2][i] = verdict.corrupt_to != 0;
            hits[3][i] = hub_faults_judge(&faults, ~0u, 4, 1, 8, 0).lost_to != 0;
        }
    }
    for (int k = 1; k < 4; k++) {
        int same = 0;
        for (size_t i = 0; i < 2000; i++)
            same += hits[0][i] == hits[k][i];
        CHECK(same > 900 && same < 1100);
    }
}

// All kinds at once, any bytes, any times: the hub stays whole (the sanitizers watch) and every frame is
// accounted for.
static void nothing_is_unaccounted_for(void) {
    struct hub_rule rules[HUB_KINDS + 1];
    for (uint32_t kind = 0; kind < HUB_KINDS; kind++) {
        rules[kind] = any(kind, kind == HUB_BUS_OFF ? 0.01 : 0.2);
        rules[kind].time_ns = 3000000, rules[kind].jitter_ns = 700000;
    }
    rules[HUB_KINDS] = any(HUB_BUS_OFF, 1);
    rules[HUB_KINDS].timed = true, rules[HUB_KINDS].from_ns = 1000000000;
    rules[HUB_KINDS].time_ns = 50000000;
    begin(1000000, rules, HUB_KINDS + 1);
    uint64_t random = 1, now_ns = 1000, put_count = 0, heard = 0;
    for (int step = 0; step < 100000; step++) {
        random = random * 6364136223846793005u + 1442695040888963407u;
        int client = random >> 40 & 1 ? a : b;
        if (hub_room(&hub, client) >= HUB_RECORD && ++put_count)
            put(client, (uint32_t)(random >> 33) & 0x7FF, (uint32_t)step, now_ns);
        now_ns += (random >> 20) % 300000;
        hub_run(&hub, now_ns);
        while (get(listener) != UINT32_MAX)
            heard++;
        while (get(a) != UINT32_MAX || get(b) != UINT32_MAX)
            ;
    }
    finish(now_ns);
    while (get(listener) != UINT32_MAX)
        heard++;
    CHECK_EQUAL(put_count, hub.clients[a].counters.sent + hub.clients[b].counters.sent -
                               hub.counters.duplicated + hub.counters.unsent);
    CHECK_EQUAL(hub.counters.frames, hub.clients[a].counters.sent + hub.clients[b].counters.sent);
    CHECK_EQUAL(heard, hub.clients[listener].counters.received);
    CHECK(hub.counters.unheard > 0 && hub.counters.delayed > 0 && hub.counters.errors > 0);
}

int main(void) {
    rules_pick_by_id_sender_time_and_number();
    one_receiver_alone_may_be_hit();
    corruption_changes_one_bit_of_the_data();
    a_duplicate_costs_bus_time_and_comes_once();
    an_error_frame_costs_time_and_the_frame_comes_later();
    errors_without_end_are_bus_off();
    a_delay_keeps_the_order_of_its_sender();
    jitter_is_spread_evenly();
    timed_bus_off_and_recovery();
    a_late_caller_finds_the_same();
    a_frame_can_send_its_sender_off();
    of_two_bus_offs_the_longer_counts();
    delays_add_up();
    a_bus_that_stands_still_does_not_hold_up_time();
    hits_of_a_sender_do_not_depend_on_others();
    other_seeds_rules_and_senders_hit_others();
    nothing_is_unaccounted_for();
    return 0;
}
