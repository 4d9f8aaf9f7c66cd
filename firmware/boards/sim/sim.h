// SPDX-License-Identifier: Apache-2.0
// The simulated board: one node whose time and wires are in its owner's hand. Nothing is read from the
// system.
//
// Time only moves in sim_run_until(), from event to event; an input acts at the clock reached so far. Answers
// are gathered until they are taken; the room for them is bounded (SIM_OUT_ROOM), behind it the node's own
// transmit buffer fills up and its commands wait. Edges are kept until taken.
#ifndef BOARDS_SIM_H
#define BOARDS_SIM_H

#include <stddef.h>
#include <stdint.h>

// cffi: begin
struct sim_board;

enum { SIM_FRAME_SIZE = 16, SIM_OUT_ROOM = 65536 };

// What a node is made as; where 0 or null it is as the build's variant.
struct sim_options {
    const uint8_t *uuid;  // six bytes
    uint64_t start_clock; // below 2^47
    int on_can;           // else on a UART
    uint32_t clock_freq;  // ticks per second, below 2^31 / NODE_STATS_SECONDS
    uint16_t move_count;
    const uint8_t *dictionary; // zlib-compressed; stays the caller's and must outlive the node
    uint32_t dictionary_size;
    int legacy; // 1: firmware without this project's CAN extensions
};
// Makes a node; everything but the dictionary's bytes is copied. Null when memory is out.
struct sim_board *sim_new_with(const struct sim_options *options);
struct sim_board *sim_new(const uint8_t *uuid, uint64_t start_clock, int on_can);
void sim_free(struct sim_board *board);
// As after a power cycle: unconfigured, without node id. The clock goes on.
void sim_restart(struct sim_board *board);

void sim_receive_frame(struct sim_board *board, uint32_t id, const uint8_t *data, size_t size);
void sim_receive_bytes(struct sim_board *board, const uint8_t *data, size_t size);
// Executes everything that is due up to and including CLOCK, then lets CLOCK be now. Earlier clocks do
// nothing.
void sim_run_until(struct sim_board *board, uint64_t clock);
uint64_t sim_clock(const struct sim_board *board);
// The clock of the next event without input; UINT64_MAX: none.
uint64_t sim_next_deadline(const struct sim_board *board);

// Copies out up to SIZE bytes of what the node said, oldest first, and forgets them. On CAN they are records
// of SIM_FRAME_SIZE bytes: u32 id, u8 length, three zeros, eight bytes of data; only whole records are taken,
// urgent ones (ids below CAN_ID_URGENT_END) before all others.
size_t sim_take(struct sim_board *board, uint8_t *out, size_t size);

// Pins (0..143): level of an input, sample of a converter, value of a PWM. Return -1 for another pin.
int sim_set_input(struct sim_board *board, uint32_t pin, int level);
int sim_set_adc(struct sim_board *board, uint32_t pin, uint16_t value);
int sim_level(const struct sim_board *board, uint32_t pin);
int sim_pwm(const struct sim_board *board, uint32_t pin);

// Changes of outputs since the last sim_edges_forget(): clock << 16 | pin << 1 | level.
const uint64_t *sim_edges(const struct sim_board *board, size_t *count);
void sim_edges_forget(struct sim_board *board);
// Edges that were lost because memory was out.
uint64_t sim_edges_lost(const struct sim_board *board);

// What stands around the board (plant/plant.h): TEXT describes it (docs/plant.md). It begins now,
// and outlives resets. NOW_NS: true time; 0: that of the board's last event. -1, with a sentence of at most
// SIM_ERROR bytes in ERROR: there is one already, TEXT is wrong, or memory is out.
enum { SIM_ERROR = 200 };
int sim_plant_start(struct sim_board *board, uint64_t now_ns, const char *text, size_t size, char *error);
// Node NAME, which the text speaks of, is PEER; they end together. -1: it speaks of no such node.
int sim_plant_peer(struct sim_board *board, const char *name, struct sim_board *peer);
// Brings the page up to date; the page (plant_page.h) and its size; null without plant.
void sim_plant_update(struct sim_board *board, uint64_t now_ns);
void *sim_plant_page(struct sim_board *board, size_t *size);

struct sim_counters {
    uint32_t rx_overflow_bytes, rx_lost, rx_out_of_order, rx_blocks, tx_dropped, timers_run;
    uint32_t clock_freq, node_id;
    uint32_t is_shutdown; // 1 from a shutdown to the restart or clear_shutdown that ends it
};
void sim_counters(const struct sim_board *board, struct sim_counters *out);

uint32_t sim_node_id(const struct sim_board *board);
// The sequence number (0..15) of the block that it would accept next.
uint32_t sim_expected(const struct sim_board *board);
// From now on what it sends and does in tasks and on frames is by a clock that is wrong by OFFSET ticks and
// up to SPREAD more, at random; its timers stay right. 0, 0: the truth again.
void sim_lie(struct sim_board *board, int64_t offset, uint32_t spread);

// The dictionary of the build, zlib-compressed, and its SIZE.
const uint8_t *sim_dictionary(uint32_t *size);
// cffi: end

// ------------------------------------------------------------------------------------ within a simulated
// world
//
// A board with an owner leaves to it when tasks run and when a wanted reset happens, and gives it what it
// sends at once. The owner calls sim_run_tasks() some time after sim_tasks_wanted(), and sim_restart() or
// sim_power_on() after sim_reset_wanted().
struct board_can_status;
struct sim_owner {
    void *context;
    int (*send_frame)(void *context, uint32_t id, const uint8_t *data, size_t size); // 0, or -1: busy
    size_t (*send_bytes)(void *context, const uint8_t *data, size_t size);           // bytes taken
    void (*edge)(void *context, uint64_t clock, uint32_t pin, int level);
    void (*can_status)(void *context, struct board_can_status *out);
    uint64_t (*true_ns)(void *context, uint64_t clock); // when the clock became CLOCK
};
// OWNER is copied.
void sim_own(struct sim_board *board, const struct sim_owner *owner);
int sim_tasks_wanted(const struct sim_board *board);
int sim_reset_wanted(const struct sim_board *board);
void sim_run_tasks(struct sim_board *board);
// The wire has room again.
void sim_sent(struct sim_board *board);
// All outputs fall at once, nothing runs until sim_power_on(), whose clock is a new one.
void sim_power_off(struct sim_board *board);
void sim_power_on(struct sim_board *board, uint64_t start_clock);

#endif
