// SPDX-License-Identifier: Apache-2.0
// The loop of a node that is a Linux process: linux.h says how it treats time.
#define _GNU_SOURCE
#include "boards/linux/linux.h"

#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/signalfd.h>
#include <unistd.h>

// DISPATCH_MAX: timers in one go, so that a node with more to do than this machine can still hears its host.
enum { NS_PER_US = 1000, FAILED = 1, DISPATCH_MAX = 500000 };

static void start_node(struct linux_board *board) {
    struct node *node = &board->virtual.node;
    struct node_config config = {
        .clock_freq = virtual_variant.clock_freq,
        .move_count = virtual_variant.move_count,
        .clock_high = (uint32_t)(virtual_clock(&board->virtual) >> 32),
        .arena = board->arena,
        .arena_size = sizeof(board->arena),
        .legacy = board->options.legacy != 0,
    };
    memcpy(config.uuid, board->options.uuid, sizeof(config.uuid));
    virtual_pins_reset(&board->virtual);
    if (board->options.link != LINK_UART)
        can_stream_attach(node, &board->can);
    node_start(node, &config);
}

// A restart as by a power cycle, except that the clock goes on: the edge log stays readable.
static void restart_node(struct linux_board *board) {
    link_flush(board);
    board->reset_wanted = 0;
    board->resets++;
    start_node(board);
}

// Until nothing is left to do, so that what waited for room to write goes on before anyone sleeps.
static void run_tasks(struct linux_board *board) {
    struct node *node = &board->virtual.node;
    do {
        node_run_tasks(node);
        link_flush(board);
        if (board->reset_wanted)
            restart_node(board);
    } while (node->tasks_pending);
}

void board_reset(struct node *node) {
    ((struct linux_board *)node)->reset_wanted = 1;
}

// A 32-bit clock near the 64-bit clock NOW.
static uint64_t extend(uint64_t now, uint32_t clock) {
    return now + (uint64_t)(int64_t)(int32_t)(clock - (uint32_t)now);
}

static void dispatch_timers(struct linux_board *board) {
    struct node *node = &board->virtual.node;
    uint64_t now = clock_at(board, monotonic_ns());
    board->dispatching = 1;
    for (unsigned budget = DISPATCH_MAX; budget; budget--) {
        const struct timer *first = node->sched.first;
        if (!first || clock_before((uint32_t)now, first->waketime))
            break;
        board->dispatch_clock = extend(now, first->waketime);
        uint64_t late = now - board->dispatch_clock;
        board->late_sum += late;
        board->late_count++;
        if (late > board->late_max)
            board->late_max = late;
        sched_run_first(node);
        if (node->tasks_pending) // samples are handed on before the next ones come
            node_run_tasks(node);
    }
    board->dispatching = 0;
}

static uint64_t random_below(struct linux_board *board, uint64_t limit) {
    // splitmix64
    uint64_t z = (board->random += 0x9E3779B97F4A7C15u);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return limit ? (z ^ (z >> 31)) % limit : 0;
}

// Sleeps until input, room to write, a signal, HELD_UNTIL (if not 0) or the next timer, but at most once a
// slice for timers. Returns -1 on a signal, else whether there is input to read.
static int wait(struct linux_board *board, int signal_fd, uint64_t held_until) {
    uint64_t now = monotonic_ns();
    uint64_t clock = clock_at(board, now);
    uint64_t until = ns_of_clock(board, extend(clock, node_next_deadline(&board->virtual.node)));
    linux_plant_horizon(board, until++);
    uint64_t slice_end = now + board->options.slice_us * NS_PER_US;
    if (until < slice_end)
        until = slice_end;
    if (held_until && held_until < until)
        until = held_until;
    if (board->out_size && board->retry_ns && board->retry_ns < until)
        until = board->retry_ns;
    uint64_t update_ns = linux_plant_update(board, now);
    if (update_ns < until)
        until = update_ns;
    uint64_t wait_ns = until > now ? until - now : 0;
    struct timespec timeout = {.tv_sec = (time_t)(wait_ns / 1000000000u),
                               .tv_nsec = (long)(wait_ns % 1000000000u)};
    struct pollfd fds[2] = {{.fd = signal_fd, .events = POLLIN}, {.fd = board->fd}};
    fds[1].events = (short)((held_until ? 0 : POLLIN) | (board->out_size && !board->retry_ns ? POLLOUT : 0));
    // A hang-up is always reported: with input held back it would only spin.
    if (!fds[1].events)
        fds[1].fd = -1;
    if (ppoll(fds, 2, &timeout, NULL) < 0)
        return 0;
    return fds[0].revents ? -1 : (fds[1].revents & ~POLLOUT) != 0;
}

static void run(struct linux_board *board, int signal_fd) {
    uint64_t held_until = 0; // jitter: input that is there is read only then
    while (!board->closed) {
        dispatch_timers(board);
        run_tasks(board);
        int readable = wait(board, signal_fd, held_until);
        if (readable < 0)
            break;
        if (held_until) {
            readable = monotonic_ns() >= held_until;
            held_until = readable ? 0 : held_until;
        } else if (readable && board->options.jitter_us) {
            held_until = monotonic_ns() + random_below(board, board->options.jitter_us * NS_PER_US + 1);
            readable = 0;
        }
        if (readable) {
            // The host may have sent the input while timers ran, relying on those that were due by then,
            // which free the queue's slots: on a chip they would have come first.
            link_read(board);
            dispatch_timers(board);
            link_hand_over(board);
        }
    }
    link_flush(board);
}

static void print_statistics(const struct linux_board *board) {
    const struct node_stats *stats = &board->virtual.node.stats;
    double us_per_tick = 1e6 / board->rate;
    double mean = board->late_count ? (double)board->late_sum / (double)board->late_count : 0;
    printf("{\"edges\":%llu,\"bytes_in\":%llu,\"bytes_out\":%llu,\"frames_in\":%llu,\"frames_out\":%llu,"
           "\"timers\":%llu,\"late_us_max\":%.1f,\"late_us_mean\":%.1f,\"resets\":%llu,\"blocks\":%u,"
           "\"lost\":%u,\"out_of_order\":%u,\"overflow_bytes\":%u,\"tx_dropped\":%u,\"plant_waits\":%llu,"
           "\"plant_misses\":%llu,\"is_shutdown\":%s}\n",
           (unsigned long long)board->virtual.edges_total, (unsigned long long)board->bytes_in,
           (unsigned long long)board->bytes_out, (unsigned long long)board->frames_in,
           (unsigned long long)board->frames_out, (unsigned long long)board->late_count,
           (double)board->late_max * us_per_tick, mean * us_per_tick, (unsigned long long)board->resets,
           stats->rx_blocks, stats->rx_lost, stats->rx_out_of_order, stats->rx_overflow_bytes,
           stats->tx_dropped, (unsigned long long)board->plant_waits, (unsigned long long)board->plant_misses,
           board->virtual.node.shutdown.active ? "true" : "false");
    fflush(stdout);
}

// Prints TEXT as a JSON string.
static void print_quoted(const char *text) {
    putchar('"');
    for (; *text; text++)
        if (*text == '"' || *text == '\\')
            printf("\\%c", *text);
        else if ((unsigned char)*text < ' ')
            printf("\\u%04x", (unsigned)*text);
        else
            putchar(*text);
    putchar('"');
}

static void print_ready(const struct linux_board *board) {
    printf("{\"ready\":true");
    if (board->options.link == LINK_UART) {
        printf(",\"uart\":");
        print_quoted(board->options.target);
    }
    puts("}");
    fflush(stdout);
}

int main(int argc, char **argv) {
    struct linux_board *board = calloc(1, sizeof(*board));
    if (!board)
        return FAILED;
    int status = options_parse(&board->options, argc, argv);
    if (status)
        return status;
    prctl(PR_SET_PDEATHSIG, SIGTERM);
    signal(SIGPIPE, SIG_IGN);
    sigset_t ending;
    sigemptyset(&ending);
    sigaddset(&ending, SIGTERM);
    sigaddset(&ending, SIGINT);
    sigprocmask(SIG_BLOCK, &ending, NULL);
    int signal_fd = signalfd(-1, &ending, SFD_CLOEXEC);

    board->rate = virtual_variant.clock_freq * (1.0 + board->options.rate_ppm * 1e-6);
    board->random = board->options.seed;
    board->start_clock = board->options.start_clock;
    board->start_ns = monotonic_ns();
    if (signal_fd < 0 || link_open(board) || edge_log_open(board) || linux_plant_open(board))
        return FAILED;
    start_node(board);
    print_ready(board);
    run(board, signal_fd);
    linux_plant_close(board);
    edge_log_close(board);
    link_close(board);
    print_statistics(board);
    status = board->failed ? FAILED : 0;
    free(board);
    return status;
}
