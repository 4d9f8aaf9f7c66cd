// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c firmware/core/*.c firmware/objects/*.c firmware/net/*.c
// sources: firmware/boards/virtual/*.c firmware/plant/*.c firmware/boards/sim/sim.c build/sim/tables.c
// Whatever a wire brings, a node survives: random commands with random arguments in sound blocks, and the
// same with damage, under the sanitizers; on CAN also signals, admin commands, tables and other nodes'
// frames.
// Everything follows from the seed that a failure prints.
#include "boards/sim/sim.h"
#include "core/node.h"
#include "net/can_stream.h"
#include "objects/mt.h"
#include "tests/check.h"

#include <string.h>

enum { ROUNDS = 40, BLOCKS = 600, OIDS = 11, NODE_ID = 4, TO_NODE = 0x108, FROM_NODE = 0x109 };
enum { DAMAGED = 1, ON_CAN = 2, TABLE_ROOM = 4 };

static const uint8_t uuid[NODE_UUID_SIZE] = {1, 2, 3, 4, 5, 6};

DECL_COMMAND(command_config_reset, "", 0);
DECL_COMMAND(command_allocate_oids, "", 0);
DECL_COMMAND(command_finalize_config, "", 0);
DECL_COMMAND(command_config_stepper, "", 0);
DECL_COMMAND(command_config_trsync, "", 0);
DECL_COMMAND(command_config_endstop, "", 0);
DECL_COMMAND(command_config_digital_out, "", 0);
DECL_COMMAND(command_config_pwm_out, "", 0);
DECL_COMMAND(command_config_analog_in, "", 0);
DECL_COMMAND(command_config_buttons, "", 0);
DECL_COMMAND(command_config_tmcuart, "", 0);
DECL_COMMAND(command_config_table, "", 0);
DECL_COMMAND(command_config_table_register, "", 0);

DECL_COMMAND(command_queue_step, "", 0);
DECL_COMMAND(command_set_next_step_dir, "", 0);
DECL_COMMAND(command_reset_step_clock, "", 0);
DECL_COMMAND(command_stepper_get_position, "", 0);
DECL_COMMAND(command_stepper_stop_on_trigger, "", 0);
DECL_COMMAND(command_trsync_start, "", 0);
DECL_COMMAND(command_trsync_set_timeout, "", 0);
DECL_COMMAND(command_trsync_trigger, "", 0);
DECL_COMMAND(command_trsync_set_group, "", 0);
DECL_COMMAND(command_set_bus_stop, "", 0);
DECL_COMMAND(command_endstop_home, "", 0);
DECL_COMMAND(command_endstop_query_state, "", 0);
DECL_COMMAND(command_set_digital_out_pwm_cycle, "", 0);
DECL_COMMAND(command_queue_digital_out, "", 0);
DECL_COMMAND(command_update_digital_out, "", 0);
DECL_COMMAND(command_queue_pwm_out, "", 0);
DECL_COMMAND(command_query_analog_in, "", 0);
DECL_COMMAND(command_buttons_query, "", 0);
DECL_COMMAND(command_buttons_ack, "", 0);
DECL_COMMAND(command_tmcuart_send, "", 0);
DECL_COMMAND(command_table_activate, "", 0);
DECL_COMMAND(command_table_find, "", 0);
DECL_COMMAND(command_table_query, "", 0);
DECL_COMMAND(command_table_read, "", 0);
DECL_COMMAND(command_table_register_poll, "", 0);
DECL_COMMAND(command_table_register_write, "", 0);

// What each object of configure() is used for; with `timed` the second argument is a clock.
static const struct {
    void (*handler)(struct node *node, const struct wire_arg *args);
    uint8_t oid, timed;
} uses[] = {
    {command_queue_step, 0, 0},
    {command_set_next_step_dir, 0, 1},
    {command_reset_step_clock, 0, 1},
    {command_stepper_get_position, 0, 1},
    {command_stepper_stop_on_trigger, 0, 1},
    {command_trsync_start, 2, 1},
    {command_trsync_set_timeout, 2, 1},
    {command_trsync_trigger, 2, 1},
    {command_trsync_set_group, 2, 0},
    {command_endstop_home, 3, 1},
    {command_endstop_query_state, 3, 1},
    {command_set_digital_out_pwm_cycle, 4, 0},
    {command_queue_digital_out, 4, 1},
    {command_update_digital_out, 4, 1},
    {command_queue_pwm_out, 5, 1},
    {command_query_analog_in, 6, 1},
    {command_buttons_query, 7, 1},
    {command_buttons_ack, 7, 1},
    {command_tmcuart_send, 10, 0},
    {command_table_activate, 8, 1},
    {command_table_query, 8, 0},
    {command_table_read, 8, 0},
    {command_table_register_poll, 9, 1},
    {command_table_register_write, 9, 0},
    {command_queue_step, 1, 0},
    {command_queue_step, 0, 0},
    {command_queue_step, 1, 0},
    {command_reset_step_clock, 1, 1},
    {command_set_next_step_dir, 1, 1},
};

struct fuzz {
    uint64_t state;
    struct sim_board *board;
    unsigned seq;
    int on_can;
    unsigned signals, replies; // what the node said besides data
    uint8_t out[SIM_OUT_ROOM], stream[SIM_OUT_ROOM];
};

static uint32_t below(struct fuzz *fuzz, uint32_t limit) {
    uint64_t z = (fuzz->state += 0x9E3779B97F4A7C15u);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return (uint32_t)((z ^ (z >> 31)) % limit);
}

// ------------------------------------------------------------------------------------------------- the wire

static void feed(struct fuzz *fuzz, const uint8_t *data, size_t size) {
    if (!fuzz->on_can) {
        sim_receive_bytes(fuzz->board, data, size);
        return;
    }
    for (size_t at = 0; at < size; at += CAN_FRAME_MAX)
        sim_receive_frame(fuzz->board, TO_NODE, data + at,
                          size - at < CAN_FRAME_MAX ? size - at : CAN_FRAME_MAX);
}

static void assign(struct fuzz *fuzz) {
    uint8_t data[CAN_FRAME_MAX] = {SET_NODEID};
    memcpy(data + 1, uuid, sizeof(uuid));
    data[7] = NODE_ID;
    sim_receive_frame(fuzz->board, CAN_ID_ADMIN_REQUEST, data, sizeof(data));
}

// A frame with one or two words of tables, sometimes with a size that is none.
static void send_table_frame(struct fuzz *fuzz) {
    static const uint32_t words[] = {0x80000000u, 0x80000001u, 0x10000000u, 0x10000001u,
                                     0x20000000u, 0x30000000u, 0x40000000u, 0};
    uint8_t data[CAN_FRAME_MAX];
    for (size_t at = 0; at < sizeof(data); at += MT_WORD_SIZE) {
        uint32_t word = words[below(fuzz, sizeof(words) / sizeof(*words))];
        word += word >> 31 ? 0 : below(fuzz, 2 * TABLE_ROOM);
        for (size_t i = 0; i < MT_WORD_SIZE; i++)
            data[at + i] = (uint8_t)(word >> (8 * i));
    }
    size_t size = below(fuzz, 8) ? MT_WORD_SIZE * (1 + below(fuzz, 2)) : below(fuzz, CAN_FRAME_MAX + 1);
    sim_receive_frame(fuzz->board, CAN_ID_TABLES, data, size);
}

// A frame that is not data for this node: any signal, any admin command, sometimes a trigger of its group or
// a conflict about its id.
static void send_other_frame(struct fuzz *fuzz) {
    static const uint8_t commands[] = {QUERY_UNASSIGNED, SET_NODEID, SYNC_PULSE, WHO_IS_HERE};
    uint8_t data[CAN_FRAME_MAX];
    for (size_t i = 0; i < sizeof(data); i++)
        data[i] = (uint8_t)below(fuzz, below(fuzz, 2) ? 8 : 256);
    size_t size = below(fuzz, CAN_FRAME_MAX + 1);
    uint32_t id = below(fuzz, 0x40);
    if (id == 0x10 && below(fuzz, 4))
        id++; // or it would hardly live
    if (below(fuzz, 2)) {
        id = 0x20 + below(fuzz, 16);
        data[0] = (uint8_t)(below(fuzz, 4) ? id - 0x20 : data[0]);
    } else if (!below(fuzz, 100)) {
        id = below(fuzz, 2) ? FROM_NODE : below(fuzz, 0x800);
    } else if (below(fuzz, 2)) {
        id = CAN_ID_ADMIN_REQUEST;
        data[0] = below(fuzz, 8) ? commands[below(fuzz, sizeof(commands))] : data[0];
    }
    sim_receive_frame(fuzz->board, id, data, size);
}

// Appends the data among SIZE bytes of frame records to the GATHERED bytes in fuzz->stream; returns how many
// there are then. All that the node says must be of a kind it may say.
static size_t gather(struct fuzz *fuzz, size_t size, size_t gathered) {
    for (size_t at = 0; at < size; at += SIM_FRAME_SIZE) {
        const uint8_t *record = fuzz->out + at;
        uint32_t id;
        memcpy(&id, record, sizeof(id));
        if (id == FROM_NODE) {
            memcpy(fuzz->stream + gathered, record + 8, record[4]);
            gathered += record[4];
        } else if (id == CAN_ID_ADMIN_RESPONSE) {
            CHECK_EQUAL(record[8], record[15] == NODE_ID ? NODE_HERE : NEED_NODEID);
            CHECK(memcmp(record + 9, uuid, sizeof(uuid)) == 0);
            fuzz->replies++;
        } else {
            CHECK(id == 0x10 ? record[4] == 6 : id - 0x20 < TRIGGER_GROUPS && record[8] == id - 0x20);
            fuzz->signals++;
        }
    }
    return gathered;
}

// Takes the bytes the node said; returns how many they are. On CAN they may fill the board's room more than
// once.
static size_t take(struct fuzz *fuzz) {
    size_t size = sim_take(fuzz->board, fuzz->out, sizeof(fuzz->out)), gathered = 0;
    if (!fuzz->on_can)
        return size;
    for (; size; size = sim_take(fuzz->board, fuzz->out, sizeof(fuzz->out))) {
        CHECK(gathered + size / 2 <= sizeof(fuzz->stream)); // half of a record is data
        gathered = gather(fuzz, size, gathered);
    }
    return gathered;
}

// ------------------------------------------------------------------------------------------------- commands

// Mostly what makes sense somewhere: small numbers, clocks soon, sometimes anything.
static uint32_t argument(struct fuzz *fuzz, uint8_t type, unsigned index) {
    if (index == 0 && type == WIRE_U8 && below(fuzz, 20))
        return below(fuzz, OIDS);
    switch (below(fuzz, type == WIRE_U8 ? 3 : 6)) {
    case 0:
        return below(fuzz, 4);
    case 1:
        return below(fuzz, 150);
    case 2:
        return below(fuzz, 0xFFFFFFFF) + below(fuzz, 2);
    default:
        return (uint32_t)sim_clock(fuzz->board) + below(fuzz, 20000);
    }
}

static size_t random_command(struct fuzz *fuzz, uint8_t *out, size_t room) {
    static const uint8_t text[40] = "0123456789";
    uint32_t id;
    do
        id = below(fuzz, node_tables.command_count);
    while (!node_tables.commands[id].handler);
    const struct node_command *command = &node_tables.commands[id];
    struct wire_arg args[NODE_ARGS_MAX];
    for (unsigned i = 0; i < command->arg_count; i++) {
        args[i] = (struct wire_arg){.value = argument(fuzz, command->types[i], i)};
        if (command->types[i] == WIRE_BYTES)
            args[i] = (struct wire_arg){.value = below(fuzz, sizeof(text)), .data = text};
    }
    uint8_t number[WIRE_VLQ_MAX];
    size_t size = wire_vlq_encode(number, (int32_t)id);
    if (size > room)
        return 0;
    memcpy(out, number, size);
    size_t packed = wire_pack(command->types, command->arg_count, args, out + size, room - size);
    return packed || !command->arg_count ? size + packed : 0;
}

static size_t command(uint8_t *out, void (*handler)(struct node *, const struct wire_arg *),
                      const struct wire_arg *args) {
    uint32_t id = 0;
    while (node_tables.commands[id].handler != handler)
        CHECK(++id < node_tables.command_count);
    const struct node_command *found = &node_tables.commands[id];
    size_t size = wire_vlq_encode(out, (int32_t)id);
    return size + wire_pack(found->types, found->arg_count, args, out + size, WIRE_CONTENT_MAX - size);
}

// One object of every kind, so that random commands find something to act on.
static void configure(struct fuzz *fuzz) {
    const struct {
        void (*handler)(struct node *, const struct wire_arg *);
        struct wire_arg args[6];
    } setup[] = {
        {command_config_reset, {INT(0)}},
        {command_allocate_oids, {INT(OIDS)}},
        {command_config_stepper, {INT(0), INT(1), INT(2), INT(255), INT(0)}},
        {command_config_stepper, {INT(1), INT(3), INT(4), INT(below(fuzz, 2)), INT(below(fuzz, 50))}},
        {command_config_trsync, {INT(2)}},
        {command_config_endstop, {INT(3), INT(5), INT(1)}},
        {command_config_digital_out, {INT(4), INT(6), INT(0), INT(1), INT(below(fuzz, 9000))}},
        {command_config_pwm_out, {INT(5), INT(7), INT(9), INT(0), INT(0), INT(below(fuzz, 9000))}},
        {command_config_analog_in, {INT(6), INT(8)}},
        {command_config_buttons, {INT(7), INT(8)}},
        {command_config_table, {INT(8), INT(1), INT(TABLE_ROOM), INT(below(fuzz, 2))}},
        {command_config_table_register, {INT(9)}},
        {command_config_tmcuart,
         {INT(10), INT(9), INT(1), INT(9 + below(fuzz, 2)), INT(8 + below(fuzz, 99))}},
        {command_trsync_set_group, {INT(2), INT(below(fuzz, 3))}},
        {command_set_bus_stop, {INT(1)}},
        {command_finalize_config, {INT(1)}},
    };
    for (size_t i = 0; i < sizeof(setup) / sizeof(*setup); i++) {
        uint8_t block[WIRE_BLOCK_MAX];
        size_t size = command(block + WIRE_HEADER, setup[i].handler, setup[i].args);
        feed(fuzz, block, wire_block_finish(block, size, fuzz->seq++));
    }
}

// A command that makes sense, most of the time.
static size_t sensible_command(struct fuzz *fuzz, uint8_t *out) {
    uint32_t use = below(fuzz, sizeof(uses) / sizeof(*uses));
    struct wire_arg args[NODE_ARGS_MAX] = {INT(uses[use].oid)};
    uint32_t now = (uint32_t)sim_clock(fuzz->board);
    for (unsigned i = 1; i < NODE_ARGS_MAX; i++)
        args[i] = i == 1 && uses[use].timed ? INT(now + 100 + below(fuzz, 9000)) : INT(below(fuzz, 2000));
    if (uses[use].handler == command_queue_step) {
        args[1] = INT(1 + below(fuzz, 5000));
        args[2] = INT(1 + below(fuzz, 20));
        args[3] = INT(below(fuzz, 3));
    } else if (uses[use].handler == command_query_analog_in) {
        args[5] = INT(2 * below(fuzz, 5));
        args[6] = INT(0);
        args[7] = INT(40000);
    } else if (uses[use].handler == command_endstop_home ||
               uses[use].handler == command_stepper_stop_on_trigger) {
        args[uses[use].oid ? 6 : 1] = INT(2);
    } else if (uses[use].handler == command_tmcuart_send) {
        args[1] = BYTES(uuid, below(fuzz, sizeof(uuid) + 1));
        args[2] = INT(below(fuzz, 11));
    } else if (uses[use].handler == command_trsync_set_group) {
        args[1] = INT(below(fuzz, 3));
    }
    return command(out, uses[use].handler, args);
}

static void send_block(struct fuzz *fuzz, int damage) {
    uint8_t block[WIRE_BLOCK_MAX];
    size_t size = 0, more, commands = 1 + below(fuzz, 4);
    if (below(fuzz, 25))
        size = sensible_command(fuzz, block + WIRE_HEADER);
    else
        while (commands-- &&
               (more = random_command(fuzz, block + WIRE_HEADER + size, WIRE_CONTENT_MAX - size)))
            size += more;
    size = wire_block_finish(block, size, fuzz->seq++);
    if (damage && !below(fuzz, 3))
        block[below(fuzz, (uint32_t)size)] ^= (uint8_t)(1 + below(fuzz, 255));
    feed(fuzz, block, size);
}

// Follows the node's numbers, and checks that all it says is sound.
static void listen(struct fuzz *fuzz) {
    struct wire_scanner scanner = {0};
    size_t size = take(fuzz), at = 0;
    const uint8_t *stream = fuzz->on_can ? fuzz->stream : fuzz->out;
    for (;;) {
        size_t skip, length;
        enum wire_scan found = wire_scan(&scanner, stream + at, size - at, &skip, &length);
        CHECK(found != WIRE_LOST && skip == 0);
        if (found == WIRE_MORE)
            break;
        fuzz->seq = stream[at + 1] & WIRE_SEQ_MASK;
        at += length;
    }
    CHECK_EQUAL(at, size);
}

// A node that lost its id, or its configuration, gets a new one. Returns whether it had been shut down.
static int revive(struct fuzz *fuzz) {
    int was_shut_down = ((const struct node *)fuzz->board)->shutdown.active;
    struct sim_counters counters;
    sim_counters(fuzz->board, &counters);
    if (fuzz->on_can && counters.node_id != NODE_ID) {
        sim_restart(fuzz->board); // its half-sent block is gone with the id
        fuzz->seq = 0;
        assign(fuzz);
        configure(fuzz);
    } else if (was_shut_down) {
        configure(fuzz);
    }
    return was_shut_down;
}

// It still is a node: after a restart it can be asked.
static void check_alive(struct fuzz *fuzz) {
    static const uint8_t identify[3] = {1, 0, 40};
    sim_restart(fuzz->board);
    if (fuzz->on_can)
        assign(fuzz);
    take(fuzz);
    uint8_t block[WIRE_BLOCK_MAX];
    memcpy(block + WIRE_HEADER, identify, sizeof(identify));
    feed(fuzz, block, wire_block_finish(block, sizeof(identify), 0));
    CHECK_EQUAL(take(fuzz), 43 + 2 * WIRE_BLOCK_MIN);
}

// Returns how many questions about who is there were answered.
static unsigned one_round(uint64_t seed, int kind) {
    static struct fuzz fuzz;
    fuzz = (struct fuzz){.state = seed, .on_can = (kind & ON_CAN) != 0};
    fuzz.board = sim_new(uuid, 0xFFFF0000u, fuzz.on_can);
    CHECK(fuzz.board);
    if (fuzz.on_can)
        assign(&fuzz);
    configure(&fuzz);
    unsigned lives = 0;
    for (unsigned i = 0; i < BLOCKS; i++) {
        send_block(&fuzz, kind & DAMAGED);
        if (fuzz.on_can && below(&fuzz, 2))
            send_other_frame(&fuzz);
        for (unsigned frames = fuzz.on_can ? below(&fuzz, 8) : 0; frames--;)
            send_table_frame(&fuzz);
        uint32_t ticks = below(&fuzz, fuzz.on_can && !below(&fuzz, 16) ? 200000 : 3000);
        sim_run_until(fuzz.board, sim_clock(fuzz.board) + ticks);
        sim_set_input(fuzz.board, below(&fuzz, 144), (int)below(&fuzz, 2));
        listen(&fuzz);
        if (!below(&fuzz, 100)) {
            sim_restart(fuzz.board);
            fuzz.seq = 0;
            if (fuzz.on_can)
                assign(&fuzz);
            configure(&fuzz);
        }
        lives += (unsigned)revive(&fuzz);
        sim_edges_forget(fuzz.board);
    }
    CHECK(lives > 5); // it did get into trouble
    CHECK(!fuzz.on_can || fuzz.signals > 50);
    check_alive(&fuzz);
    sim_free(fuzz.board);
    return fuzz.replies;
}

int main(void) {
    unsigned replies = 0;
    for (uint64_t seed = 1; seed <= ROUNDS; seed++)
        for (int kind = 0; kind <= (DAMAGED | ON_CAN); kind++)
            replies += one_round(seed + 1000 * (uint64_t)kind, kind);
    CHECK(replies > ROUNDS);
    return 0;
}
