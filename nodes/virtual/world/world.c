// SPDX-License-Identifier: Apache-2.0
// The world as a whole, its CAN wires, and its planned changes of inputs.
#include "nodes/virtual/world/parts.h"

#include <stdlib.h>
#include <string.h>

struct world *world_new(uint64_t seed, uint64_t start_ns) {
    struct world *world = calloc(1, sizeof(*world));
    if (!world)
        return NULL;
    world->seed = seed;
    world->agenda.now_ns = start_ns;
    world->python_chance = chance_of(seed, CHANCE_PYTHON, 0);
    world->actions = calloc(WORLD_ACTIONS_MAX, sizeof(*world->actions));
    if (!world->actions || agenda_reserve(&world->agenda, WORLD_ACTIONS_MAX)) {
        world_free(world);
        return NULL;
    }
    actions_start(world);
    return world;
}

void world_free(struct world *world) {
    for (struct world_port *port = world->ports, *next; port; port = next) {
        next = port->next;
        port_free(port);
    }
    for (struct world_node *node = world->nodes, *next; node; node = next) {
        next = node->next;
        node_free(node);
    }
    for (struct world_can *can = world->cans, *next; can; can = next) {
        next = can->next;
        free(can);
    }
    for (struct world_uart *uart = world->uarts, *next; uart; uart = next) {
        next = uart->next;
        free(uart);
    }
    free(world->actions);
    agenda_free(&world->agenda);
    free(world);
}

uint64_t world_now(const struct world *world) {
    return world->agenda.now_ns;
}

uint64_t world_trace(const struct world *world) {
    return world->agenda.trace;
}

uint64_t world_events(const struct world *world) {
    return world->agenda.fired;
}

int world_run(struct world *world, uint64_t until_ns) {
    while (!world->stop)
        if (!agenda_step(&world->agenda, until_ns)) {
            if (until_ns > world->agenda.now_ns)
                world->agenda.now_ns = until_ns;
            return 0;
        }
    world->stop = 0;
    return 1;
}

void world_stall(struct world *world, uint64_t until_ns, int io, int python) {
    if (io && until_ns > world->io_stalled_ns)
        world->io_stalled_ns = until_ns;
    if (python && until_ns > world->python_stalled_ns)
        world->python_stalled_ns = until_ns;
}

uint64_t world_python_stalled(const struct world *world) {
    return world->python_stalled_ns;
}

uint64_t latency_draw(struct chance *chance, const struct world_latency *latency) {
    return chance_latency(chance, latency->min_ns, latency->mean_ns, latency->max_ns);
}

struct world_latency *world_python_latency(struct world *world) {
    return &world->python;
}

uint64_t world_python_wakes(struct world *world, uint64_t due_ns) {
    if (due_ns < world->python_stalled_ns)
        due_ns = world->python_stalled_ns;
    return due_ns + latency_draw(&world->python_chance, &world->python);
}

// --------------------------------------------------------------------------------------------------- CAN

struct world_can *world_add_can(struct world *world, const struct can_wire_settings *settings) {
    struct world_can *can = calloc(1, sizeof(*can));
    if (!can)
        return NULL;
    struct chance chance = chance_of(world->seed, CHANCE_WIRE, world->can_count);
    if (can_wire_start(&can->wire, &world->agenda, chance, settings)) {
        free(can);
        return NULL;
    }
    world->can_count++;
    can->world = world;
    can->next = world->cans;
    world->cans = can;
    return can;
}

struct can_wire_settings *world_can_settings(struct world_can *can) {
    return &can->wire.settings;
}

const struct can_wire_counters *world_can_counters(const struct world_can *can) {
    return &can->wire.counters;
}

void world_can_status(const struct can_controller *controller, struct can_controller_status *out) {
    *out = (struct can_controller_status){
        .tec = controller->tec,
        .rec = controller->rec,
        .retries = (uint32_t)controller->counters.retries,
        .queued = controller->count,
        .state = (int)can_state_of(controller),
    };
}

const struct can_controller_counters *world_can_controller_counters(const struct can_controller *controller) {
    return &controller->counters;
}

struct can_controller_settings *world_can_controller_settings(struct can_controller *controller) {
    return &controller->settings;
}

static int make_frame(struct can_bits *frame, uint32_t id, const uint8_t *data, size_t size) {
    if (id > 0x7FF || size > 8)
        return -1;
    *frame = (struct can_bits){.id = id, .size = (uint8_t)size};
    memcpy(frame->data, data, size);
    return 0;
}

int world_can_send(struct can_controller *controller, uint32_t id, const uint8_t *data, size_t size) {
    struct can_bits frame;
    return make_frame(&frame, id, data, size) ? -1 : can_offer(controller, &frame);
}

void world_can_babble(struct can_controller *controller, uint32_t id, const uint8_t *data, size_t size,
                      uint64_t until_ns) {
    struct can_bits frame;
    if (make_frame(&frame, id, data, size) == 0)
        can_babble(controller, &frame, until_ns);
}

// ------------------------------------------------------------------------------------------------ actions

static void action_due(void *owner) {
    struct action *action = owner;
    node_drive(action->node, action->pin, action->value, action->adc);
    action->next_free = action->world->free_action;
    action->world->free_action = action;
}

void actions_start(struct world *world) {
    for (int i = WORLD_ACTIONS_MAX - 1; i >= 0; i--) {
        struct action *action = &world->actions[i];
        action->world = world;
        action->event = (struct event){.fire = action_due, .owner = action};
        action->next_free = world->free_action;
        world->free_action = action;
    }
}

int action_plan(struct world_node *node, uint32_t pin, uint16_t value, int adc, uint64_t at_ns) {
    struct world *world = node->world;
    struct action *action = world->free_action;
    if (!action || pin >= WORLD_PINS)
        return -1;
    world->free_action = action->next_free;
    action->node = node;
    action->pin = pin;
    action->value = value;
    action->adc = adc != 0;
    agenda_plan(&world->agenda, &action->event, at_ns);
    return 0;
}
