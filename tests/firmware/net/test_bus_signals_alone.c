// SPDX-License-Identifier: Apache-2.0
// sources: firmware/net/bus_signals.c
// Signals from node to node by themselves: every byte that leaves, what waits while the board refuses, and
// what is obeyed of frames that come.
#include "boards/board.h"
#include "core/bus_signals.h"
#include "net/can_stream.h"
#include "objects/trsync.h"
#include "tests/check.h"

#include <string.h>

// -------------------------------------------------------------------------------------- what is around it

enum {
    FRAMES_MAX = 40,
    BUS_STOP = 5,
    COMMAND_REQUEST = 9,
    STOP = 0x010,
    TRIGGER = 0x020,
    CLOCK = 0x98765432
};

const uint16_t string_bus_stop = BUS_STOP, string_command_request = COMMAND_REQUEST;
const struct node_response response_sync_pulse;

static struct node node;
static struct can_stream stream;
static struct {
    uint32_t id;
    uint8_t data[8];
    size_t size;
} frames[FRAMES_MAX];
static unsigned frame_count, refused, accepts; // accepts: frames until the board refuses
static unsigned triggered, trigger_group, trigger_reason, shutdowns;
static uint32_t irq_depth, answer[2];

uint32_t board_clock(struct node *at) {
    CHECK(at == &node);
    return CLOCK;
}

uint32_t board_irq_save(struct node *at) {
    (void)at;
    return irq_depth++;
}

void board_irq_restore(struct node *at, uint32_t state) {
    (void)at;
    CHECK_EQUAL(--irq_depth, state);
}

int board_can_send(struct node *at, uint32_t id, const uint8_t *data, size_t size) {
    CHECK(at == &node && frame_count < FRAMES_MAX);
    if (!accepts) {
        refused++;
        return -1;
    }
    accepts--;
    frames[frame_count].id = id;
    frames[frame_count].size = size;
    memcpy(frames[frame_count++].data, data, size);
    return 0;
}

void trsync_trigger_group(struct node *at, uint8_t group, uint8_t reason) {
    CHECK(at == &node);
    triggered++, trigger_group = group, trigger_reason = reason;
}

void node_shutdown(struct node *at, uint16_t reason) {
    shutdowns++;
    at->shutdown.active = 1;
    at->shutdown.reason = reason;
}

int node_respond(struct node *at, const struct node_response *response, const struct wire_arg *args,
                 size_t count) {
    CHECK(at == &node && response == &response_sync_pulse && count == 2);
    answer[0] = args[0].value, answer[1] = args[1].value;
    return 0;
}

void bus_signals_shutdown(struct node *at);
void command_set_bus_stop(struct node *at, const struct wire_arg *args);
void command_get_sync_pulse(struct node *at, const struct wire_arg *args);

static void start(unsigned frames_accepted) {
    memset(&node, 0, sizeof(node));
    memset(&stream, 0, sizeof(stream));
    node.can = &stream;
    stream.node_id = 77;
    frame_count = refused = triggered = shutdowns = 0;
    accepts = frames_accepted;
    CHECK_EQUAL(irq_depth, 0);
}

static void sent(unsigned index, uint32_t id, const uint8_t *data, size_t size) {
    CHECK(index < frame_count);
    CHECK_EQUAL(frames[index].id, id);
    CHECK_EQUAL(frames[index].size, size);
    CHECK(!memcmp(frames[index].data, data, size));
}

// ------------------------------------------------------------------------------------------------- receiving

static void a_stop_is_obeyed_whatever_it_carries(void) {
    for (size_t size = 0; size <= 8; size++) {
        start(0);
        bus_signals_receive(&node, STOP, (const uint8_t[8]){0}, size);
        CHECK_EQUAL(shutdowns, 1);
        CHECK_EQUAL(node.shutdown.reason, BUS_STOP);
    }
    static const uint32_t others[] = {0, STOP - 1, STOP + 1, TRIGGER - 1};
    for (unsigned i = 0; i < sizeof(others) / sizeof(others[0]); i++) {
        start(0);
        bus_signals_receive(&node, others[i], (const uint8_t[8]){(uint8_t)(others[i] - TRIGGER)}, 8);
        CHECK(!shutdowns && !triggered);
    }
}

static void a_trigger_is_taken_when_it_is_whole_and_names_its_group_twice(void) {
    for (uint8_t group = 0; group <= 16; group++)
        for (size_t size = 0; size <= 8; size++)
            for (int other = 0; other <= 1; other++) {
                start(0);
                const uint8_t data[8] = {(uint8_t)(group + other), 33};
                bus_signals_receive(&node, TRIGGER + (uint32_t)group, data, size);
                CHECK_EQUAL(triggered, group < 16 && size >= 6 && !other);
                CHECK(!triggered || (trigger_group == group && trigger_reason == 33));
                CHECK_EQUAL(shutdowns, 0);
            }
}

static void older_firmware_hears_nothing(void) {
    start(0);
    node.config.legacy = 1;
    bus_signals_receive(&node, STOP, (const uint8_t[8]){0}, 8);
    bus_signals_receive(&node, TRIGGER, (const uint8_t[8]){0}, 8);
    bus_signals_pulse(&node, (const uint8_t[2]){0x40, 1}, 2);
    CHECK(!shutdowns && !triggered && !stream.signals.pulse_seq);
}

static void a_pulse_latches_the_clock(void) {
    start(0);
    bus_signals_pulse(&node, (const uint8_t[2]){0x40, 9}, 1);
    bus_signals_pulse(&node, (const uint8_t[2]){0x40, 0}, 2);
    CHECK(!stream.signals.pulse_seq && !stream.signals.pulse_clock);
    command_get_sync_pulse(&node, NULL);
    CHECK(!answer[0] && !answer[1]);
    bus_signals_pulse(&node, (const uint8_t[2]){0x40, 9}, 2);
    command_get_sync_pulse(&node, NULL);
    CHECK(answer[0] == 9 && answer[1] == CLOCK);
    bus_signals_pulse(&node, (const uint8_t[3]){0x40, 255}, 3);
    CHECK_EQUAL(stream.signals.pulse_seq, 255);
    node.can = NULL;
    command_get_sync_pulse(&node, NULL);
    CHECK(!answer[0] && !answer[1]);
}

// --------------------------------------------------------------------------------------------------- sending

static void a_trigger_leaves_at_once_with_its_clock(void) {
    for (uint8_t group = 0; group < 16; group += 15) {
        start(9);
        bus_signals_trigger(&node, group, 7, CLOCK);
        CHECK_EQUAL(frame_count, 1);
        sent(0, TRIGGER + (uint32_t)group, (const uint8_t[]){group, 7, 0x32, 0x54, 0x76, 0x98}, 6);
        CHECK_EQUAL(stream.signals.triggers_waiting, 0);
        CHECK(!bus_signals_flush(&node) && frame_count == 1);
    }
    start(9);
    node.config.legacy = 1;
    bus_signals_trigger(&node, 1, 7, CLOCK);
    node.config.legacy = 0;
    node.can = NULL;
    bus_signals_trigger(&node, 1, 7, CLOCK);
    bus_signals_forget_trigger(&node, 1);
    CHECK_EQUAL(frame_count, 0);
}

static void triggers_that_are_refused_wait_each_with_its_own_words(void) {
    start(0);
    bus_signals_trigger(&node, 15, 1, 0x01020304);
    bus_signals_trigger(&node, 0, 2, 0x05060708);
    bus_signals_trigger(&node, 3, 3, 0);
    bus_signals_forget_trigger(&node, 3);
    CHECK_EQUAL(stream.signals.triggers_waiting, 0x8001);
    CHECK_EQUAL(bus_signals_flush(&node), 1);
    accepts = 1;
    CHECK_EQUAL(bus_signals_flush(&node), 1);
    sent(0, TRIGGER, (const uint8_t[]){0, 2, 8, 7, 6, 5}, 6);
    CHECK_EQUAL(stream.signals.triggers_waiting, 0x8000);
    accepts = 9;
    CHECK_EQUAL(bus_signals_flush(&node), 0);
    sent(1, TRIGGER + 15, (const uint8_t[]){15, 1, 4, 3, 2, 1}, 6);
    CHECK(!bus_signals_flush(&node) && frame_count == 2 && irq_depth == 0);
}

// The reason REASON of a node that shuts itself down, as it may leave.
static void shut_down(uint16_t reason) {
    node.objects.stops_bus = 1;
    node.shutdown.active = 1;
    node.shutdown.reason = reason;
    node.shutdown.clock = CLOCK - 1;
    bus_signals_shutdown(&node);
}

static void a_shutdown_stops_the_bus_with_its_reason_and_origin(void) {
    static const uint16_t reasons[] = {1, BUS_STOP - 1, COMMAND_REQUEST + 1, 254, 255, 256, 65535};
    for (unsigned i = 0; i < sizeof(reasons) / sizeof(reasons[0]); i++) {
        start(1);
        shut_down(reasons[i]);
        CHECK_EQUAL(frame_count, 1);
        uint8_t reason = (uint8_t)(reasons[i] < 256 ? reasons[i] : 0);
        sent(0, STOP, (const uint8_t[]){reason, 77, 0x31, 0x54, 0x76, 0x98}, 6);
        CHECK_EQUAL(stream.signals.stop_waiting, 0);
        CHECK_EQUAL(bus_signals_flush(&node), 0);
    }
}

static void what_is_no_reason_to_stop_others_does_not(void) {
    for (int what = 0; what < 6; what++) {
        start(9);
        node.objects.stops_bus = what != 0;
        node.shutdown.active = what != 1;
        node.shutdown.reason = what == 2 ? BUS_STOP : what == 3 ? COMMAND_REQUEST : 1;
        node.config.legacy = what == 4;
        if (what == 5)
            node.can = NULL;
        bus_signals_shutdown(&node);
        CHECK(!frame_count && !stream.signals.stop_waiting);
    }
}

static void a_stop_that_is_refused_goes_before_triggers(void) {
    start(0);
    shut_down(3);
    CHECK_EQUAL(stream.signals.stop_waiting, 1);
    CHECK_EQUAL(bus_signals_flush(&node), 1); // also without any trigger
    bus_signals_trigger(&node, 4, 6, 0);
    refused = 0;
    CHECK_EQUAL(bus_signals_flush(&node), 1);
    CHECK_EQUAL(refused, 1); // the trigger was not even offered
    accepts = 9;
    CHECK_EQUAL(bus_signals_flush(&node), 0);
    CHECK_EQUAL(frame_count, 2);
    sent(0, STOP, (const uint8_t[]){3, 77, 0x31, 0x54, 0x76, 0x98}, 6);
    sent(1, TRIGGER + 4, (const uint8_t[]){4, 6, 0, 0, 0, 0}, 6);
}

static void a_stop_that_was_cleared_meanwhile_does_not_come(void) {
    start(0);
    shut_down(3);
    node.shutdown.active = 0;
    accepts = 9;
    CHECK_EQUAL(bus_signals_flush(&node), 0);
    CHECK(!frame_count && !stream.signals.stop_waiting);
    node.shutdown.active = 1;
    CHECK_EQUAL(bus_signals_flush(&node), 0);
    CHECK_EQUAL(frame_count, 0);
}

static void the_host_turns_it_on_and_off(void) {
    start(0);
    for (unsigned value = 0; value <= 2; value++) {
        command_set_bus_stop(&node, (const struct wire_arg[]){{.value = value}});
        CHECK_EQUAL(node.objects.stops_bus, value != 0);
    }
}

int main(void) {
    a_stop_is_obeyed_whatever_it_carries();
    a_trigger_is_taken_when_it_is_whole_and_names_its_group_twice();
    older_firmware_hears_nothing();
    a_pulse_latches_the_clock();
    a_trigger_leaves_at_once_with_its_clock();
    triggers_that_are_refused_wait_each_with_its_own_words();
    a_shutdown_stops_the_bus_with_its_reason_and_origin();
    what_is_no_reason_to_stop_others_does_not();
    a_stop_that_is_refused_goes_before_triggers();
    a_stop_that_was_cleared_meanwhile_does_not_come();
    the_host_turns_it_on_and_off();
    return 0;
}
