// SPDX-License-Identifier: Apache-2.0
// A virtual node as a process: its main loop.
#include <inttypes.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/signalfd.h>
#include <time.h>
#include <unistd.h>

#include "boards/linux/linux_board.h"
#include "net/uart_stream.h"

enum { US_NS = 1000, S_NS = 1000000000 };

void board_request_reset(struct node *node) {
    board_of(node)->reset_wanted = true;
}

// As after power-on; the clock goes on, nobody outside can tell.
static void start_node(struct linux_board *board) {
    board->reset_wanted = false;
    board->can_stream.nodeid = board->can_stream.wants_reply = board->can_stream.conflict = 0;
    memcpy(board->can_stream.uuid, board->options.uuid, CAN_UUID_SIZE);
    pins_reset(board);
    bool is_uart = board->options.uart != NULL;
    struct node_config config = {
        .clock_freq = BOARD_CLOCK_FREQ,
        .arena = board->arena,
        .arena_size = ARENA_SIZE,
        .move_count = BOARD_MOVE_COUNT,
        .timer_slack_ticks = BOARD_CLOCK_FREQ / 10000,
        .uptime_high = (uint32_t)(clock_now(board) >> 32),
        .transport = is_uart ? &uart_stream_transport : &can_stream_transport,
        .transport_state = is_uart ? NULL : &board->can_stream,
        .board = board,
    };
    node_init(&board->node, &config);
    if (!is_uart)
        can_stream_start(&board->node);
}

// ---------------------------------------------------------------------------------------------------- timers

// Widens a 32-bit clock that lies near the 64-bit one.
static uint64_t widen(uint32_t clock, uint64_t near) {
    return near + (uint64_t)(int64_t)(int32_t)(clock - (uint32_t)near);
}

static void run_timers(struct linux_board *board) {
    uint64_t now = clock_now(board);
    board->in_timer = true;
    for (;;) {
        uint64_t due = widen(board->node.timers->wake_clock, now);
        if (due > now)
            break;
        board->timer_clock = due;
        uint64_t late = now - due;
        board->late_ticks_sum += late;
        board->late_ticks_max = late > board->late_ticks_max ? late : board->late_ticks_max;
        board->timers++;
        sched_dispatch(&board->node);
    }
    board->in_timer = false;
}

// How long to sleep: to the next timer, but not in slices so short that the process only wakes up.
static struct timespec pause_of(const struct linux_board *board, int64_t now_ns) {
    int64_t due_ns = ns_at(board, widen(board->node.timers->wake_clock, clock_at(board, now_ns)));
    int64_t slice_ns = (int64_t)board->options.slice_us * US_NS;
    int64_t wait_ns = due_ns - now_ns > slice_ns ? due_ns - now_ns : slice_ns;
    return (struct timespec){.tv_sec = wait_ns / S_NS, .tv_nsec = wait_ns % S_NS};
}

// ---------------------------------------------------------------------------------------------------- main
// loop

static uint64_t next_random(struct linux_board *board) { // xorshift64*
    board->random ^= board->random >> 12;
    board->random ^= board->random << 25;
    board->random ^= board->random >> 27;
    return board->random * 0x2545F4914F6CDD1D;
}

static void delay_input(struct linux_board *board) {
    if (!board->options.jitter_us)
        return;
    uint64_t us = next_random(board) % (board->options.jitter_us + 1);
    struct timespec delay = {.tv_nsec = (long)(us * US_NS)};
    nanosleep(&delay, NULL);
}

// Waits and handles what comes; returns false when it is time to end.
static bool wait_and_read(struct linux_board *board) {
    struct timespec pause = pause_of(board, monotonic_ns());
    struct pollfd fds[2] = {
        {.fd = board->fd, .events = POLLIN},
        {.fd = board->signal_fd, .events = POLLIN},
    };
    if (board->out_from < board->out_to)
        fds[0].events |= POLLOUT;
    ppoll(fds, 2, &pause, NULL);
    if (fds[0].revents & (POLLIN | POLLHUP | POLLERR)) {
        delay_input(board);
        wires_read(board);
    }
    return !fds[1].revents && !board->closed;
}

static void run(struct linux_board *board) {
    while (wait_and_read(board)) {
        run_timers(board);
        while (node_run_tasks(&board->node))
            run_timers(board);
        wires_write(board);
        if (board->reset_wanted) {
            board->in_size = board->out_from = board->out_to = 0;
            start_node(board);
        }
    }
}

static void print_statistics(const struct linux_board *board) {
    const struct link *link = &board->node.link;
    const double us = 1e6 / BOARD_CLOCK_FREQ;
    double mean = board->timers ? (double)board->late_ticks_sum / (double)board->timers * us : 0;
    printf("{\"edges\": %" PRIu64 ", \"timers\": %" PRIu64 ", \"timer_late_us_mean\": %.1f, "
           "\"timer_late_us_max\": %.1f, \"bytes_in\": %" PRIu64 ", \"bytes_out\": %" PRIu64
           ", \"frames_in\": %" PRIu64 ", \"frames_out\": %" PRIu64 ", \"frames_bad\": %" PRIu64
           ", \"blocks\": %" PRIu32 ", \"blocks_damaged\": %" PRIu32 ", \"blocks_out_of_order\": %" PRIu32
           ", \"bytes_dropped\": %" PRIu32 ", \"responses_dropped\": %" PRIu32 ", \"is_shutdown\": %s}\n",
           board->edges, board->timers, mean, (double)board->late_ticks_max * us, board->bytes_in,
           board->bytes_out, board->frames_in, board->frames_out, board->frames_bad, link->blocks,
           link->losses, link->out_of_order, link->receive_dropped, link->transmit_dropped,
           board->node.is_shutdown ? "true" : "false");
}

static int open_signals(void) {
    sigset_t ends;
    sigemptyset(&ends);
    sigaddset(&ends, SIGTERM);
    sigaddset(&ends, SIGINT);
    sigprocmask(SIG_BLOCK, &ends, NULL);
    signal(SIGPIPE, SIG_IGN);
    prctl(PR_SET_PDEATHSIG, SIGTERM); // a node does not outlive who started it
    return signalfd(-1, &ends, SFD_CLOEXEC);
}

int main(int argc, char **argv) {
    struct linux_board *board = calloc(1, sizeof(*board));
    if (!board)
        return EXIT_FAILURE;
    int status = options_parse(&board->options, argc, argv);
    if (status)
        return status;
    board->random = board->options.seed * 2 + 1;
    board->rate_mHz = (uint64_t)(BOARD_CLOCK_FREQ * (1 + board->options.rate_ppm * 1e-6) * 1000 + 0.5);
    board->start_ns = monotonic_ns();
    board->signal_fd = open_signals();
    if (wires_open(board))
        return EXIT_FAILURE;
    if (edge_log_open(board)) {
        fprintf(stderr, "canductor-node: cannot write the log %s; name another file\n",
                board->options.edge_log);
        return EXIT_FAILURE;
    }
    start_node(board);
    printf("{\"ready\": true, \"uart\": \"%s\"}\n", board->options.uart ? board->options.uart : "");
    fflush(stdout);
    run(board);
    wires_close(board);
    edge_log_close(board);
    print_statistics(board);
    return EXIT_SUCCESS;
}
