// SPDX-License-Identifier: Apache-2.0
// The CAN transport. Unknown admin commands are ignored: that is what makes extensions possible.
#include "net/can_stream.h"

#include <string.h>

#include "boards/board.h"

DECL_STATIC_STRING(id_conflict, "Another CAN node assigned this ID");
DECL_RESPONSE(canbus_id, "canbus_id canbus_uuid=%.*s canbus_nodeid=%u");
DECL_RESPONSE(canbus_status, "canbus_status rx_error=%u tx_error=%u tx_retries=%u canbus_bus_state=%u");
DECL_ENUMERATION("canbus_bus_state", "active", 0);
DECL_ENUMERATION("canbus_bus_state", "warn", 1);
DECL_ENUMERATION("canbus_bus_state", "passive", 2);
DECL_ENUMERATION("canbus_bus_state", "off", 3);

enum {
    ADMIN_QUERY_UNASSIGNED = 0x00,
    ADMIN_SET_NODEID = 0x01,
    ADMIN_NEED_NODEID = 0x20,
};

static struct can_stream *state_of(struct node *node) {
    return node->config.transport_state;
}

static uint32_t host_id(const struct can_stream *can) {
    return CAN_ID_DATA + 2 * (uint32_t)can->nodeid;
}

static void listen_for(struct node *node, const struct can_stream *can) {
    // The id it sends with, too: a frame there means that another node has the same.
    const uint32_t ids[] = {CAN_ID_ADMIN, host_id(can), host_id(can) + 1};
    board_can_filter(node, ids, can->nodeid ? 3 : 1);
}

void can_stream_start(struct node *node) {
    listen_for(node, state_of(node));
}

// ------------------------------------------------------------------------------------------------- transmit

static bool send_need_nodeid(struct node *node, const struct can_stream *can) {
    uint8_t frame[CAN_FRAME_MAX] = {ADMIN_NEED_NODEID};
    memcpy(frame + 1, can->uuid, CAN_UUID_SIZE);
    frame[1 + CAN_UUID_SIZE] = ADMIN_SET_NODEID;
    return board_can_send(node, CAN_ID_ADMIN_RESPONSE, frame, sizeof(frame));
}

static void transmit(struct node *node) {
    struct can_stream *can = state_of(node);
    if (can->wants_reply && !can->nodeid && !send_need_nodeid(node, can))
        return;
    can->wants_reply = 0;
    uint8_t bytes[CAN_FRAME_MAX];
    size_t size;
    while ((size = link_peek(node, bytes, sizeof(bytes)))) {
        // Without an id nobody could tell whose bytes these are: they are dropped.
        if (can->nodeid && !board_can_send(node, host_id(can) + 1, bytes, (uint8_t)size))
            return;
        link_consume(node, size);
    }
}

const struct transport can_stream_transport = {transmit};

// -------------------------------------------------------------------------------------------------- receive

DECL_TASK(can_stream_conflict_task);
void can_stream_conflict_task(struct node *node) {
    struct can_stream *can = state_of(node);
    if (!can->conflict)
        return;
    can->conflict = 0;
    can->nodeid = 0;
    link_discard(node);
    listen_for(node, can);
    node_shutdown(node, string_id_conflict);
}

static void id_is_taken(struct node *node, struct can_stream *can) {
    can->conflict = 1;
    WAKE(node, can_stream_conflict_task);
}

static void set_nodeid(struct node *node, struct can_stream *can, const uint8_t *data, size_t size) {
    if (size < 2 + CAN_UUID_SIZE)
        return;
    uint8_t nodeid = data[1 + CAN_UUID_SIZE];
    if (memcmp(data + 1, can->uuid, CAN_UUID_SIZE)) {
        if (nodeid && nodeid == can->nodeid)
            id_is_taken(node, can);
    } else if (nodeid != can->nodeid) { // repeated assignments change nothing
        can->nodeid = nodeid;
        link_discard(node);
        listen_for(node, can);
    }
}

void can_stream_receive(struct node *node, uint32_t id, const uint8_t *data, size_t size) {
    struct can_stream *can = state_of(node);
    if (id == CAN_ID_ADMIN && size) {
        if (data[0] == ADMIN_QUERY_UNASSIGNED && !can->nodeid) {
            can->wants_reply = 1;
            link_transmit_ready(node);
        } else if (data[0] == ADMIN_SET_NODEID) {
            set_nodeid(node, can, data, size);
        }
    } else if (can->nodeid && id == host_id(can)) {
        link_receive(node, data, size);
    } else if (can->nodeid && id == host_id(can) + 1) {
        id_is_taken(node, can);
    }
}

// ------------------------------------------------------------------------------------------------- commands

DECL_COMMAND_FLAGS(command_get_canbus_id, COMMAND_IN_SHUTDOWN, "get_canbus_id");
void command_get_canbus_id(struct node *node, const struct wire_arg *args) {
    (void)args;
    static const struct can_stream none; // a board built for CAN may run on a UART
    const struct can_stream *can = node->config.transport == &can_stream_transport ? state_of(node) : &none;
    RESPOND(node, canbus_id, ARG_BYTES(can->uuid, CAN_UUID_SIZE), ARG(can->nodeid));
}

DECL_COMMAND_FLAGS(command_get_canbus_status, COMMAND_IN_SHUTDOWN, "get_canbus_status");
void command_get_canbus_status(struct node *node, const struct wire_arg *args) {
    (void)args;
    struct board_can_status status;
    board_can_status(node, &status);
    RESPOND(node, canbus_status, ARG(status.rx_error), ARG(status.tx_error), ARG(status.tx_retries),
            ARG(status.bus_state));
}
