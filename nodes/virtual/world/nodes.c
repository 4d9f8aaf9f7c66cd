// SPDX-License-Identifier: Apache-2.0
// Nodes of the world: the firmware on its simulated board, with a crystal, interrupts and latencies.
#include "nodes/virtual/world/parts.h"

#include "boards/board.h"
#include "nodes/virtual/world/can_wire.h"

#include <stdlib.h>
#include <string.h>

enum {
    EVENTS = 4,
    EDGES_AT_FIRST = 1024,
    NODE_QUEUE = 4, // three mailboxes of the chip, one of them for urgent frames, and the driver's queue
    NODE_RESERVED = 2,
    NODE_MAILBOXES = 3,
    DATA_IDS = 0x100,
    DATA_IDS_END = 0x300,
    PS_PER_NS = 1000,
};

// -------------------------------------------------------------------------------------------- its own time

// Runs the firmware up to now.
static void catch_up(struct world_node *node) {
    sim_run_until(node->board, crystal_ticks(&node->crystal, node->world->agenda.now_ns));
}

// Plans the next events of the firmware, after any change of its state.
static void settle(struct world_node *node) {
    struct agenda *agenda = &node->world->agenda;
    if (!node->counters.running)
        return;
    if (sim_reset_wanted(node->board)) {
        world_node_reset(node);
        return;
    }
    if (sim_tasks_wanted(node->board) && !event_planned(&node->tasks))
        agenda_plan(agenda, &node->tasks, agenda->now_ns + latency_draw(&node->chance, &node->settings.task));
    uint64_t deadline = sim_next_deadline(node->board);
    uint64_t at_ns = deadline == UINT64_MAX ? AGENDA_NEVER : crystal_time(&node->crystal, deadline);
    if (at_ns == AGENDA_NEVER)
        agenda_cancel(agenda, &node->timer);
    else if (!event_planned(&node->timer) || node->timer.at_ns != at_ns)
        agenda_plan(agenda, &node->timer, at_ns);
}

static void timer_due(void *owner) {
    struct world_node *node = owner;
    catch_up(node);
    settle(node);
}

static void tasks_due(void *owner) {
    struct world_node *node = owner;
    catch_up(node);
    node->counters.tasks++;
    sim_run_tasks(node->board);
    settle(node);
}

// ------------------------------------------------------------------------------------------------- wires

// A chip's acceptance filter: of data frames only those with the node's own ids.
static int accepts(const struct world_node *node, uint32_t id) {
    return id < DATA_IDS || id >= DATA_IDS_END || (id - DATA_IDS) / 2 == sim_node_id(node->board);
}

static void frame_came(void *owner, const struct can_bits *frame) {
    struct world_node *node = owner;
    if (!node->counters.running || !accepts(node, frame->id))
        return;
    if (node->frame_count == IRQ_RING) {
        node->counters.irq_overflow++;
        return;
    }
    struct agenda *agenda = &node->world->agenda;
    uint64_t jitter_ns = node->settings.irq_jitter_ns;
    uint64_t at_ns = agenda->now_ns + (jitter_ns ? chance_below(&node->chance, jitter_ns + 1) : 0);
    if (node->frame_count) {
        uint64_t last_ns = node->frames[(node->frame_first + node->frame_count - 1) % IRQ_RING].at_ns;
        at_ns = at_ns > last_ns ? at_ns : last_ns;
    } else {
        agenda_plan(agenda, &node->irq, at_ns);
    }
    node->frames[(node->frame_first + node->frame_count++) % IRQ_RING] =
        (struct pending_frame){at_ns, *frame};
}

static void irq_due(void *owner) {
    struct world_node *node = owner;
    const struct pending_frame pending = node->frames[node->frame_first];
    node->frame_first = (node->frame_first + 1) % IRQ_RING;
    if (--node->frame_count)
        agenda_plan(&node->world->agenda, &node->irq, node->frames[node->frame_first].at_ns);
    catch_up(node);
    sim_receive_frame(node->board, pending.frame.id, pending.frame.data, pending.frame.size);
    settle(node);
}

static void frame_left(void *owner) {
    struct world_node *node = owner;
    if (!node->counters.running)
        return;
    sim_sent(node->board);
    settle(node);
}

static int send_frame(void *context, uint32_t id, const uint8_t *data, size_t size) {
    struct world_node *node = context;
    return node->can ? world_can_send(&node->controller, id, data, size) : -1;
}

static size_t send_bytes(void *context, const uint8_t *data, size_t size) {
    struct world_node *node = context;
    return node->uart ? uart_to_host(node->uart, data, size) : 0;
}

void node_uart_byte(struct world_node *node, uint8_t byte) {
    if (!node->counters.running)
        return;
    catch_up(node);
    sim_receive_bytes(node->board, &byte, 1);
    settle(node);
}

void node_uart_room(struct world_node *node) {
    frame_left(node);
}

static void can_status(void *context, struct board_can_status *out) {
    struct world_node *node = context;
    struct can_controller_status status;
    world_can_status(&node->controller, &status);
    *out = (struct board_can_status){
        .rx_error = status.rec,
        .tx_error = status.tec,
        .tx_retries = status.retries,
        .state = (uint32_t)status.state,
    };
}

// ------------------------------------------------------------------------------------------------- edges

static void remember_edge(struct world_node *node, const struct world_edge *edge) {
    if (node->counters.edges == node->edge_room) {
        size_t room = node->edge_room ? 2 * node->edge_room : EDGES_AT_FIRST;
        struct world_edge *more = room <= WORLD_EDGES_MAX ? realloc(node->edges, room * sizeof(*more)) : NULL;
        if (!more) {
            node->counters.edges_lost++;
            return;
        }
        node->edges = more;
        node->edge_room = room;
    }
    node->edges[node->counters.edges++] = *edge;
}

static void edge(void *context, uint64_t clock, uint32_t pin, int level) {
    struct world_node *node = context;
    if (node->driven[pin])
        return; // an input, whose level only seems to change in a reset
    struct world_edge edge = {
        .true_ps = crystal_time_ps(&node->crystal, clock),
        .clock = clock,
        .pin = (uint16_t)pin,
        .level = (uint8_t)level,
        .life = node->life,
    };
    remember_edge(node, &edge);
    agenda_note(&node->world->agenda, clock << 16 | pin << 1 | (uint64_t)level);
}

static uint64_t true_ns(void *context, uint64_t clock) {
    const struct world_node *node = context;
    return (uint64_t)(crystal_time_ps(&node->crystal, clock) / PS_PER_NS);
}

const struct world_edge *world_node_edges(const struct world_node *node, size_t *count) {
    *count = (size_t)node->counters.edges;
    return node->edges;
}

// -------------------------------------------------------------------------------------------- power and
// reset

static void stop(struct world_node *node) {
    struct agenda *agenda = &node->world->agenda;
    agenda_cancel(agenda, &node->timer);
    agenda_cancel(agenda, &node->tasks);
    agenda_cancel(agenda, &node->irq);
    agenda_cancel(agenda, &node->boot);
    node->frame_count = 0;
    if (node->can)
        can_power(&node->controller, 0);
    else
        uart_clear_to_host(node->uart);
    if (!node->counters.running)
        return;
    catch_up(node);
    node->counters.running = 0;
    sim_power_off(node->board);
    node->life++;
}

static void device_gone(struct world_node *node, uint64_t back_ns) {
    struct world_port *port = node->device;
    if (!port)
        return;
    if (world_port_there(port))
        world_port_fail(port, 0);
    port->back_ns = back_ns;
}

void world_node_carries(struct world_node *node, struct world_port *port, uint64_t gone_ns) {
    node->device = port;
    node->device_gone_ns = gone_ns;
}

static void boot_due(void *owner) {
    struct world_node *node = owner;
    node->counters.running = 1;
    if (node->can)
        can_power(&node->controller, 1);
    sim_power_on(node->board, crystal_ticks(&node->crystal, node->world->agenda.now_ns));
    node_reapply_inputs(node);
    settle(node);
}

void world_node_reset(struct world_node *node) {
    struct agenda *agenda = &node->world->agenda;
    if (!node->counters.powered)
        return;
    agenda_note(agenda, node->number);
    node->counters.resets++;
    stop(node);
    device_gone(node, agenda->now_ns + node->device_gone_ns);
    agenda_plan(agenda, &node->boot, agenda->now_ns + node->settings.boot_ns);
}

void world_node_power_off(struct world_node *node) {
    stop(node);
    device_gone(node, AGENDA_NEVER);
    node->counters.powered = 0;
}

void world_node_power_on(struct world_node *node, uint64_t start_clock) {
    struct agenda *agenda = &node->world->agenda;
    if (node->counters.powered)
        return;
    node->counters.powered = 1;
    if (node->device)
        node->device->back_ns = agenda->now_ns + node->device_gone_ns;
    double ppm = crystal_ppm(&node->crystal, agenda->now_ns);
    crystal_start(&node->crystal, node->crystal.nominal_hz, agenda->now_ns, start_clock, ppm);
    agenda_plan(agenda, &node->boot, agenda->now_ns + node->settings.boot_ns);
}

// ---------------------------------------------------------------------------------------------- creation

static int connect(struct world_node *node) {
    if (node->uart)
        return node->uart->node ? -1 : 0;
    node->controller = (struct can_controller){
        .settings = {.restart_ns = 0,
                     .queue = NODE_QUEUE,
                     .reserved = NODE_RESERVED,
                     .mailboxes = NODE_MAILBOXES},
        .chance = chance_of(node->world->seed ^ 1, CHANCE_NODE, node->number),
        .owner = node,
        .on_frame = frame_came,
        .on_sent = frame_left,
    };
    return can_wire_join(&node->can->wire, &node->controller);
}

static void start(struct world_node *node, const struct sim_options *options) {
    struct world *world = node->world;
    struct sim_counters counters;
    sim_counters(node->board, &counters);
    crystal_start(&node->crystal, counters.clock_freq, world->agenda.now_ns, options->start_clock,
                  node->settings.ppm);
    const struct sim_owner owner = {node, send_frame, send_bytes, edge, can_status, true_ns};
    sim_own(node->board, &owner);
    node->counters.powered = 1;
    node->timer = (struct event){.fire = timer_due, .owner = node};
    node->tasks = (struct event){.fire = tasks_due, .owner = node};
    node->irq = (struct event){.fire = irq_due, .owner = node};
    node->boot = (struct event){.fire = boot_due, .owner = node};
    if (node->can)
        can_power(&node->controller, 0);
    else
        node->uart->node = node;
    agenda_plan(&world->agenda, &node->boot, world->agenda.now_ns + node->settings.boot_ns);
}

struct world_node *world_add_node(struct world *world, const struct sim_options *options,
                                  const struct world_node_settings *settings, struct world_can *can,
                                  struct world_uart *uart) {
    struct world_node *node = calloc(1, sizeof(*node));
    if (!node)
        return NULL;
    node->world = world;
    node->settings = *settings;
    node->can = can;
    node->uart = can ? NULL : uart;
    node->number = world->node_count;
    node->chance = chance_of(world->seed, CHANCE_NODE, node->number);
    node->board = sim_new_with(options);
    if (!node->board || agenda_reserve(&world->agenda, EVENTS) || connect(node)) {
        node_free(node);
        return NULL;
    }
    start(node, options);
    world->node_count++;
    node->next = world->nodes;
    world->nodes = node;
    return node;
}

void node_free(struct world_node *node) {
    if (node->board)
        sim_free(node->board);
    can_controller_free(&node->controller);
    free(node->edges);
    free(node);
}
