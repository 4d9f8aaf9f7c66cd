// SPDX-License-Identifier: Apache-2.0
// Functions of the links of a bus for Python: open, close, send, read counters.
#include <stdlib.h>
#include <string.h>

#include "nodes/link/io/io_bus.h"

// --------------------------------------------------------------------------------------------------- links

// There are as many places as links.
static void open_snapshot(struct io_bus *bus, struct io_link *node) {
    struct io_snapshot *place = bus->snapshots;
    while (place->number)
        place++;
    node->snapshot = place;
    node->changed = 1;
    io_publish(bus);
    __atomic_store_n(&place->number, node->number, __ATOMIC_RELEASE);
}

static enum io_status add_link(struct io_bus *bus, unsigned nodeid, const struct link_settings *settings,
                               uint32_t *number) {
    int taken = bus->kind == IO_BYTES ? bus->link_count > 0 : bus->by_nodeid[nodeid] != NULL;
    if (taken || bus->link_count == IO_LINKS_MAX)
        return IO_TAKEN;
    struct io_link *node = calloc(1, sizeof *node);
    if (!node)
        return IO_NO_MEMORY;
    const struct link_memory memories[LINK_CLASSES] = {
        [LINK_MOTION] = {node->motion_memory, IO_MOTION_BYTES},
        [LINK_CONTROL] = {node->control_memory, IO_CONTROL_BYTES},
        [LINK_BULK] = {node->bulk_memory, IO_BULK_BYTES},
    };
    link_init(&node->link, settings, memories);
    node->nodeid = (uint8_t)nodeid;
    node->number = *number = ++bus->last_number;
    bus->links[bus->link_count++] = node;
    open_snapshot(bus, node);
    if (bus->kind != IO_BYTES)
        bus->by_nodeid[nodeid] = node;
    return IO_OK;
}

enum io_status io_open_link(struct io_bus *bus, unsigned nodeid, const struct link_settings *settings,
                            uint32_t *number) {
    if (nodeid > 255 || (bus->kind == IO_BYTES) != (nodeid == 0) || !settings->lost_after_ns ||
        settings->receive_window < LINK_WINDOW_MIN)
        return IO_INVALID;
    io_lock(bus);
    enum io_status status = bus->ended ? IO_CLOSED : add_link(bus, nodeid, settings, number);
    io_unlock(bus);
    return status;
}

static size_t index_of(const struct io_bus *bus, uint32_t number) {
    size_t at = 0;
    while (at < bus->link_count && bus->links[at]->number != number)
        at++;
    return at;
}

void io_close_link(struct io_bus *bus, uint32_t number) {
    io_lock(bus);
    size_t at = index_of(bus, number);
    if (at < bus->link_count) {
        struct io_link *node = bus->links[at];
        bus->by_nodeid[node->nodeid] = NULL;
        bus->link_count--;
        __atomic_store_n(&node->snapshot->number, 0, __ATOMIC_RELEASE);
        memmove(bus->links + at, bus->links + at + 1, (bus->link_count - at) * sizeof *bus->links);
        free(node);
    }
    io_unlock(bus);
}

// Locks the bus and returns the link; NULL (and *status) when it cannot be used.
static struct io_link *enter(struct io_bus *bus, uint32_t number, enum io_status *status) {
    io_lock(bus);
    size_t at = index_of(bus, number);
    *status = bus->ended ? IO_CLOSED : at == bus->link_count ? IO_GONE : IO_OK;
    if (*status != IO_OK)
        return NULL;
    bus->links[at]->changed = 1;
    return bus->links[at];
}

static enum io_status leave_without_kick(struct io_bus *bus, enum io_status status) {
    io_publish(bus);
    io_unlock(bus);
    return status;
}

static enum io_status leave(struct io_bus *bus, enum io_status status) {
    if (status == IO_OK)
        bus->driver.kick(bus->context);
    return leave_without_kick(bus, status);
}

static enum io_status from_link(enum link_status status) {
    static const enum io_status same[] = {
        [LINK_OK] = IO_OK, [LINK_FULL] = IO_FULL, [LINK_INVALID] = IO_INVALID, [LINK_GONE] = IO_GONE};
    return same[status];
}

enum io_status io_send(struct io_bus *bus, uint32_t number, enum link_class kind, const uint8_t *content,
                       size_t size, uint64_t min_clock, uint64_t req_clock) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(
            link_send(&node->link, kind, content, size, min_clock, req_clock, bus->driver.now(bus->context)));
    if (!bus->corked)
        return leave(bus, status);
    bus->corked_waits |= status == IO_OK;
    return leave_without_kick(bus, status);
}

void io_cork(struct io_bus *bus, int corked) {
    io_lock(bus);
    bus->corked = corked != 0;
    if (!corked && bus->corked_waits && !bus->ended)
        bus->driver.kick(bus->context);
    bus->corked_waits &= bus->corked;
    leave_without_kick(bus, IO_OK);
}

enum io_status io_send_batch(struct io_bus *bus, uint32_t number, const uint8_t *batch, size_t size) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_send_batch(&node->link, batch, size));
    if (status == IO_OK)
        io_note_batch(node, batch, size);
    return leave(bus, status);
}

enum io_status io_send_urgent(struct io_bus *bus, uint32_t number, const uint8_t *content, size_t size) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_send_urgent(&node->link, content, size, bus->driver.now(bus->context)));
    return leave(bus, status);
}

enum io_status io_set_receive_window(struct io_bus *bus, uint32_t number, uint64_t size) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_set_receive_window(&node->link, size));
    return leave(bus, status);
}

enum io_status io_set_clock(struct io_bus *bus, uint32_t number, double freq_hz, uint64_t at_ns,
                            uint64_t at_ticks) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_set_clock(&node->link, freq_hz, at_ns, at_ticks));
    return leave(bus, status);
}

// Returns where the patience for ID is or may be kept; NULL: there is no room.
static struct io_patience *place_of(struct io_link *node, const uint8_t *id, size_t size) {
    struct io_patience *free = NULL;
    for (size_t i = 0; i < IO_PATIENT_MAX; i++) {
        struct io_patience *patience = &node->patience[i];
        if (patience->size == size && memcmp(patience->id, id, size) == 0)
            return patience;
        if (!patience->size)
            free = patience;
    }
    return free;
}

enum io_status io_let_wait(struct io_bus *bus, uint32_t number, const uint8_t *id, size_t size,
                           uint64_t wait_ns, uint32_t together) {
    if (size == 0 || size > IO_ID_MAX)
        return IO_INVALID;
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    struct io_patience *patience = node ? place_of(node, id, size) : NULL;
    if (patience) {
        *patience = (struct io_patience){
            .size = wait_ns ? (uint8_t)size : 0, .wait_ns = wait_ns, .together = together};
        memcpy(patience->id, id, size);
    } else if (node) {
        status = IO_FULL;
    }
    return leave(bus, status);
}

enum io_status io_hurry(struct io_bus *bus, uint32_t number, int hurry) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        node->in_a_hurry = hurry != 0;
    return leave(bus, status);
}

enum io_status io_watch_drained(struct io_bus *bus, uint32_t number) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node) {
        node->watch_drained = 1;
        io_note_states(bus);
    }
    return leave(bus, status);
}

enum io_status io_send_frame(struct io_bus *bus, uint32_t can_id, const uint8_t *data, size_t size) {
    if (size > IO_DATA_MAX || bus->kind == IO_BYTES)
        return IO_INVALID;
    io_lock(bus);
    if (bus->ended || bus->admin_count == IO_ADMIN_MAX)
        return leave(bus, bus->ended ? IO_CLOSED : IO_FULL);
    size_t at = bus->admin_count++;
    if (io_is_stop(can_id)) {
        bus->admin_first = (bus->admin_first + IO_ADMIN_MAX - 1) % IO_ADMIN_MAX;
        at = 0;
    }
    struct can_frame *frame = &bus->admin[(bus->admin_first + at) % IO_ADMIN_MAX];
    *frame = (struct can_frame){.can_id = can_id, .can_dlc = (uint8_t)size};
    memcpy(frame->data, data, size);
    if (bus->admin_count > bus->stats.admin_max)
        bus->stats.admin_max = bus->admin_count;
    return leave(bus, IO_OK);
}
