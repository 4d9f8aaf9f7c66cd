// SPDX-License-Identifier: Apache-2.0
// The host's port on a wire: the adapter's queues in the kernel, and the I/O thread of a bus.
#include "nodes/virtual/world/parts.h"

#include <linux/can.h>
#include <stdlib.h>
#include <string.h>

#define NO_BUFFERS_NS UINT64_C(300000) // delay of the I/O thread after ENOBUFS

enum { EVENTS = 2, PORT_MAILBOXES = 1, RECORDS = 64 };

static uint64_t now_of(const struct world_port *port) {
    return port->world->agenda.now_ns;
}

// ------------------------------------------------------------------------------------------- waking up

// Wakes the thread at AT_NS, or earlier if that is planned.
static void wake_at(struct world_port *port, uint64_t at_ns) {
    if (event_planned(&port->wake) && port->wake.at_ns <= at_ns)
        return;
    agenda_plan(&port->world->agenda, &port->wake, at_ns);
}

static void wake_soon(struct world_port *port) {
    if (port->bus)
        wake_at(port, now_of(port) + latency_draw(&port->chance, &port->settings.wake));
}

static void plan_deadline(struct world_port *port) {
    uint64_t now = now_of(port), at_ns = io_deadline(port->bus, now);
    if (port->out_size && !io_ended(port->bus))
        at_ns = port->retry_ns < at_ns ? port->retry_ns : at_ns;
    if (at_ns == UINT64_MAX)
        return;
    at_ns = at_ns > now ? at_ns : now + 1;
    wake_at(port, at_ns + latency_draw(&port->chance, &port->settings.wake));
}

// ------------------------------------------------------------------------------------------- receiving

static void frame_came(void *owner, const struct can_bits *frame) {
    struct world_port *port = owner;
    if (!port->bus)
        return; // the interface is not open
    uint32_t room = port->settings.receive_queue;
    if (port->received_count >= (room < WORLD_RECEIVE_MAX ? room : WORLD_RECEIVE_MAX)) {
        port->counters.overflow++;
        return;
    }
    port->received[(port->received_first + port->received_count++) % WORLD_RECEIVE_MAX] = *frame;
    if (port->received_count > port->counters.receive_max)
        port->counters.receive_max = port->received_count;
    wake_soon(port);
}

static void read_frames(struct world_port *port) {
    struct can_frame records[RECORDS];
    while (port->received_count) {
        size_t count = 0;
        for (; count < RECORDS && port->received_count; count++, port->received_count--) {
            const struct can_bits *frame = &port->received[port->received_first];
            records[count] = (struct can_frame){.can_id = frame->id, .can_dlc = frame->size};
            memcpy(records[count].data, frame->data, frame->size);
            port->received_first = (port->received_first + 1) % WORLD_RECEIVE_MAX;
        }
        io_received(port->bus, (const uint8_t *)records, count * sizeof(records[0]), now_of(port));
    }
}

static void read_bytes(struct world_port *port) {
    uint8_t bytes[RECORDS];
    size_t size;
    while ((size = ring_take(&port->uart->received, bytes, sizeof(bytes))))
        io_received(port->bus, bytes, size, now_of(port));
}

void port_uart_bytes(struct world_port *port) {
    wake_soon(port);
}

// --------------------------------------------------------------------------------------------- sending

// One write(); returns how many bytes were accepted.
static size_t write_some(struct world_port *port) {
    const uint8_t *data = port->out + port->out_at;
    size_t size = port->out_size - port->out_at;
    if (port->uart)
        return uart_to_node(port->uart, data, size);
    struct can_frame record;
    memcpy(&record, data, sizeof(record));
    if (record.can_id > CAN_SFF_MASK || record.can_dlc > CAN_MAX_DLEN)
        return sizeof(record); // the core sends no such frames
    return world_can_send(&port->controller, record.can_id, record.data, record.can_dlc) ? 0 : sizeof(record);
}

static int flush(struct world_port *port) {
    while (port->out_at < port->out_size) {
        size_t done = write_some(port);
        if (done == 0) {
            port->counters.no_buffers++;
            port->retry_ns = now_of(port) + NO_BUFFERS_NS;
            io_count_wait(port->bus);
            return 0;
        }
        port->out_at += done;
    }
    port->out_at = port->out_size = 0;
    return 1;
}

static uint64_t queued(const struct world_port *port) {
    return port->uart ? port->uart->to_node.queue.count : port->controller.count;
}

static void write_all(struct world_port *port) {
    while (flush(port)) {
        port->out_size = io_next(port->bus, now_of(port), queued(port), port->out, sizeof(port->out));
        if (port->out_size == 0)
            return;
    }
}

static void wake_due(void *owner) {
    struct world_port *port = owner;
    struct world *world = port->world;
    if (now_of(port) < world->io_stalled_ns) {
        wake_at(port, world->io_stalled_ns + latency_draw(&port->chance, &port->settings.wake));
        return;
    }
    port->counters.wakeups++;
    io_count_wakeup(port->bus);
    if (port->uart)
        read_bytes(port);
    else
        read_frames(port);
    io_handle_time(port->bus, now_of(port));
    if (!io_ended(port->bus))
        write_all(port);
    plan_deadline(port);
}

static void frame_left(void *owner) {
    (void)owner; // the kernel notifies only sockets whose buffer was full
}

// ---------------------------------------------------------------------------- functions for the core

static uint64_t driver_now(void *context) {
    return now_of(context);
}

static void driver_lock(void *context) {
    (void)context; // there is only one thread
}

// Sends what the caller queued without the latency of waking a thread, as with a real thread.
static void driver_kick(void *context) {
    struct world_port *port = context;
    wake_at(port, now_of(port));
}

static void driver_notify(void *context) {
    struct world_port *port = context;
    struct world *world = port->world;
    uint64_t now = now_of(port);
    if (!event_planned(&port->notice))
        agenda_plan(&world->agenda, &port->notice, world_python_wakes(world, now));
}

static void notice_due(void *owner) {
    struct world_port *port = owner;
    struct world *world = port->world;
    if (now_of(port) < world->python_stalled_ns) {
        agenda_plan(&world->agenda, &port->notice, world->python_stalled_ns);
        return;
    }
    port->noticed = 1;
    world->stop = 1;
}

struct world_port *world_noticed(struct world *world) {
    // The oldest port first: new ports are inserted at the head of the list.
    struct world_port *found = NULL;
    for (struct world_port *port = world->ports; port; port = port->next)
        if (port->noticed)
            found = port;
    if (found)
        found->noticed = 0;
    return found;
}

// ------------------------------------------------------------------------------------------- open and close

int world_port_there(const struct world_port *port) {
    return now_of(port) >= port->back_ns;
}

struct io_bus *world_port_open(struct world_port *port, const struct io_settings *settings) {
    static const struct io_driver driver = {driver_now,  driver_lock,   driver_lock,
                                            driver_kick, driver_notify, NULL};
    if (port->bus || !world_port_there(port))
        return NULL;
    port->bus = io_new(port->uart ? IO_BYTES : IO_CAN_STREAM, settings, &driver, port);
    if (port->bus && port->can && !port->controller.powered)
        can_power(&port->controller, 1); // it was connected again
    if (port->bus && port->uart)
        uart_noise(port->uart);
    if (port->bus)
        wake_soon(port);
    return port->bus;
}

void world_port_close(struct world_port *port) {
    struct agenda *agenda = &port->world->agenda;
    if (!port->bus)
        return;
    agenda_cancel(agenda, &port->wake);
    agenda_cancel(agenda, &port->notice);
    io_free(port->bus);
    port->bus = NULL;
    port->noticed = 0;
    port->received_count = 0;
    port->out_at = port->out_size = 0;
}

void world_port_fail(struct world_port *port, int cause) {
    if (port->bus)
        io_end(port->bus, cause);
    if (port->can)
        can_power(&port->controller, 0);
}

static struct world_port *add_port(struct world *world, const struct world_port_settings *settings) {
    struct world_port *port = world->port_count < WORLD_PORTS_MAX ? calloc(1, sizeof(*port)) : NULL;
    if (!port)
        return NULL;
    port->world = world;
    port->settings = *settings;
    port->number = world->port_count;
    port->chance = chance_of(world->seed, CHANCE_PORT, port->number);
    port->wake = (struct event){.fire = wake_due, .owner = port};
    port->notice = (struct event){.fire = notice_due, .owner = port};
    if (agenda_reserve(&world->agenda, EVENTS)) {
        free(port);
        return NULL;
    }
    return port;
}

static struct world_port *enter(struct world_port *port) {
    port->world->port_count++;
    port->next = port->world->ports;
    return port->world->ports = port;
}

struct world_port *world_add_can_port(struct world *world, struct world_can *can,
                                      const struct can_controller_settings *controller,
                                      const struct world_port_settings *settings) {
    struct world_port *port = controller->queue <= CAN_QUEUE_MAX ? add_port(world, settings) : NULL;
    if (!port)
        return NULL;
    port->can = can;
    port->controller = (struct can_controller){
        .settings = *controller,
        .chance = chance_of(world->seed ^ 1, CHANCE_PORT, port->number),
        .owner = port,
        .on_frame = frame_came,
        .on_sent = frame_left,
    };
    port->received = calloc(WORLD_RECEIVE_MAX, sizeof(*port->received));
    if (!port->received || can_wire_join(&can->wire, &port->controller)) {
        port_free(port);
        return NULL;
    }
    return enter(port);
}

struct world_port *world_add_uart_port(struct world *world, struct world_uart *uart,
                                       const struct world_port_settings *settings) {
    struct world_port *port = uart->port ? NULL : add_port(world, settings);
    if (!port)
        return NULL;
    port->uart = uart;
    uart->port = port;
    return enter(port);
}

void port_free(struct world_port *port) {
    world_port_close(port);
    can_controller_free(&port->controller);
    free(port->received);
    free(port);
}

struct world_port_settings *world_port_settings(struct world_port *port) {
    return &port->settings;
}

struct can_controller *world_port_controller(struct world_port *port) {
    return port->can ? &port->controller : NULL;
}

const struct world_port_counters *world_port_counters(const struct world_port *port) {
    return &port->counters;
}
