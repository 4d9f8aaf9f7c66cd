// SPDX-License-Identifier: Apache-2.0
// CAN: assignment of the node's id, and message blocks as a stream of bytes in frames of at most eight.
//
// A node without an id hears only the admin channel and says nothing but its uuid when asked for it; what its
// core has to say meanwhile is dropped, as a board's first words are that nobody listens to.
#include "net/can_stream.h"

#include "boards/board.h"
#include "objects/table.h"

#include <string.h>

DECL_STATIC_STRING(id_conflict, "Another CAN node assigned this ID");

DECL_RESPONSE(canbus_id, "canbus_id canbus_uuid=%.*s canbus_nodeid=%u");
DECL_RESPONSE(canbus_status, "canbus_status rx_error=%u tx_error=%u tx_retries=%u canbus_bus_state=%u");

DECL_ENUMERATION("canbus_bus_state", "active", 0);
DECL_ENUMERATION("canbus_bus_state", "warn", 1);
DECL_ENUMERATION("canbus_bus_state", "passive", 2);
DECL_ENUMERATION("canbus_bus_state", "off", 3);

static uint32_t receive_id(const struct can_stream *stream) {
    return can_stream_receive_id(stream->node_id);
}

static uint32_t transmit_id(const struct can_stream *stream) {
    return receive_id(stream) + 1;
}

void can_stream_attach(struct node *node, struct can_stream *stream) {
    memset(stream, 0, sizeof(*stream));
    node->can = stream;
}

// ------------------------------------------------------------------------------------------------- receiving

static void lose_id(struct node *node) {
    node_shutdown(node, STRING(id_conflict)); // under the id whose loss it may have to tell the bus
    node->can->node_id = 0;
}

static void set_node_id(struct node *node, const uint8_t *data) {
    struct can_stream *stream = node->can;
    uint8_t wanted = data[1 + NODE_UUID_SIZE];
    if (memcmp(data + 1, node->config.uuid, NODE_UUID_SIZE) != 0) {
        if (stream->node_id && wanted == stream->node_id)
            lose_id(node);
    } else if (wanted != stream->node_id) {
        stream->node_id = wanted;
    }
}

static void receive_admin(struct node *node, const uint8_t *data, size_t size) {
    if (!size)
        return;
    if (data[0] == SYNC_PULSE)
        bus_signals_pulse(node, data, size);
    else if (data[0] == QUERY_UNASSIGNED || data[0] == WHO_IS_HERE)
        discovery_query(node, data[0]);
    else if (data[0] == SET_NODEID && size >= 2 + NODE_UUID_SIZE)
        set_node_id(node, data);
}

void can_stream_receive(struct node *node, uint32_t id, const uint8_t *data, size_t size) {
    struct can_stream *stream = node->can;
    if (size > CAN_FRAME_MAX)
        return;
    if (id < CAN_ID_URGENT_END) {
        bus_signals_receive(node, id, data, size);
    } else if (id == CAN_ID_ADMIN_REQUEST) {
        receive_admin(node, data, size);
    } else if (id == CAN_ID_TABLES) {
        table_receive_frame(node, data, size);
    } else if (stream->node_id && id == receive_id(stream)) {
        node_receive(node, data, size);
    } else if (stream->node_id && id == transmit_id(stream)) {
        lose_id(node);
    }
}

// ---------------------------------------------------------------------------------------------- transmitting

void can_stream_task(struct node *node) {
    struct can_stream *stream = node->can;
    if (!stream)
        return;
    if (bus_signals_flush(node))
        return; // nothing goes before a signal; the board wakes the tasks
    discovery_run(node);
    uint8_t data[CAN_FRAME_MAX];
    size_t size;
    while ((size = node_transmit_peek(node, data, sizeof(data)))) {
        if (stream->node_id && board_can_send(node, transmit_id(stream), data, size))
            return;
        node_transmitted(node, size);
    }
}
DECL_TASK(can_stream_task);

// ------------------------------------------------------------------------------------------------- questions

void command_get_canbus_id(struct node *node, const struct wire_arg *args) {
    (void)args;
    RESPOND(node, canbus_id, BYTES(node->config.uuid, NODE_UUID_SIZE),
            INT(node->can ? node->can->node_id : 0));
}
DECL_COMMAND(command_get_canbus_id, "get_canbus_id", ALLOWED_IN_SHUTDOWN);

void command_get_canbus_status(struct node *node, const struct wire_arg *args) {
    (void)args;
    struct board_can_status status = {0};
    if (node->can)
        board_can_status(node, &status);
    else
        status.state = BOARD_CAN_OFF;
    RESPOND(node, canbus_status, INT(status.rx_error), INT(status.tx_error), INT(status.tx_retries),
            INT(status.state));
}
DECL_COMMAND(command_get_canbus_status, "get_canbus_status", ALLOWED_IN_SHUTDOWN);

// ------------------------------------------------------------------------------------------------------ uuid

static uint64_t mix(uint64_t value) {
    value ^= value >> 23;
    value *= 0x2127599BF4325C37u;
    return value ^ (value >> 47);
}

// fasthash64 (MIT-licensed, by Zilong Tan), from its definition: eight bytes at a time, the rest
// zero-extended.
static uint64_t fasthash64(const uint8_t *data, size_t size, uint64_t seed) {
    const uint64_t multiplier = 0x880355F21E6D1965u;
    uint64_t hash = seed ^ (size * multiplier);
    for (size_t at = 0; at < size; at += 8) {
        uint64_t word = 0;
        for (size_t i = 0; i < 8 && at + i < size; i++)
            word |= (uint64_t)data[at + i] << (8 * i);
        hash = (hash ^ mix(word)) * multiplier;
    }
    return mix(hash);
}

void can_stream_uuid(const uint8_t *chip_id, size_t size, uint8_t uuid[NODE_UUID_SIZE]) {
    uint64_t hash = fasthash64(chip_id, size, 0xA16231A7u);
    for (unsigned i = 0; i < NODE_UUID_SIZE; i++)
        uuid[i] = (uint8_t)(hash >> (8 * i));
}
