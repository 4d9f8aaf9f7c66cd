// SPDX-License-Identifier: Apache-2.0
// CAN: assignment of the node's id, and message blocks as a stream of bytes in frames of at most eight.
#ifndef NET_CAN_STREAM_H
#define NET_CAN_STREAM_H

#include "core/bus_signals.h"
#include "core/node.h"
#include "net/discovery.h"

enum { CAN_ID_ADMIN_REQUEST = 0x3F0, CAN_ID_ADMIN_RESPONSE = 0x3F1, CAN_FRAME_MAX = 8 };
enum { CAN_ID_TABLES = 0x3F2 }; // words of MT for all nodes, ids or not (objects/table.h)

enum { SET_NODEID = 0x01, SYNC_PULSE = 0x40 }; // admin commands; those of questions are in discovery.h

// Ids below this one win against all data; a board sends them before whatever else waits in it.
enum { CAN_ID_URGENT_END = 0x100 };

// One per node, owned by the board; zeroed by can_stream_attach().
struct can_stream {
    uint8_t node_id; // 0: none assigned
    struct discovery discovery;
    struct bus_signals signals;
};

// The id of data for the node with NODE_ID; the next one is that of what it sends.
static inline uint32_t can_stream_receive_id(uint8_t node_id) {
    return node_id * 2u + 0x100;
}
// Connects STREAM to NODE, before node_start() and again at every restart: the id is dropped.
void can_stream_attach(struct node *node, struct can_stream *stream);
// A frame of SIZE <= 8 bytes came. Interrupt context allowed.
void can_stream_receive(struct node *node, uint32_t id, const uint8_t *data, size_t size);
// A node's uuid from the chip's unique number.
void can_stream_uuid(const uint8_t *chip_id, size_t size, uint8_t uuid[NODE_UUID_SIZE]);

#endif
