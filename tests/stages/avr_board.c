// SPDX-License-Identifier: Apache-2.0
// An ATmega2560 with firmware from a HEX file, in libsimavr and in real time, on a pseudo-terminal.
//
//   avr_board HEX LINK DEAF_MS GONE_MS DTR
//
// LINK is a symbolic link to the pseudo-terminal. After a reset the board is deaf for DEAF_MS, as a boot
// loader is; with GONE_MS, LINK and the pseudo-terminal disappear for that time, as a USB device does, and
// come back with another number. With DTR 1 the board is also reset whenever the device is opened. It ends
// with its standard input.
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_hex.h>
#include <simavr/sim_interrupts.h>
#include <simavr/sim_irq.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum {
    FREQUENCY = 16000000,
    SLICE_CYCLES = 16000, // a millisecond
    BYTE_CYCLES = 640,    // ten bits at 250,000 baud
    BEHIND_NS_MAX = 50000000,
    RING = 4096,
};

struct ring {
    uint8_t bytes[RING];
    unsigned first, count;
};

static struct {
    avr_t *avr;
    avr_irq_t *uart_in;
    void (*core_reset)(struct avr_t *avr);
    const char *link;
    long deaf_ms, gone_ms;
    int dtr, was_reset, terminal, slave_open, accepts;
    struct ring to_node, to_host;
    avr_cycle_count_t next_byte;
} board;

static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void fail(const char *what) {
    perror(what);
    exit(1);
}

static void put(struct ring *ring, uint8_t byte) {
    if (ring->count < RING)
        ring->bytes[(ring->first + ring->count++) % RING] = byte;
}

// ------------------------------------------------------------------------------------------------ terminal

static void open_terminal(void) {
    struct termios settings;
    board.terminal = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (board.terminal < 0 || grantpt(board.terminal) || unlockpt(board.terminal))
        fail("pseudo-terminal");
    // A slave that was opened once: without that a master is not reported as hung up.
    int slave = open(ptsname(board.terminal), O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (slave < 0 || tcgetattr(slave, &settings))
        fail("slave");
    cfmakeraw(&settings);
    tcsetattr(slave, TCSANOW, &settings);
    close(slave);
    unlink(board.link);
    if (symlink(ptsname(board.terminal), board.link))
        fail(board.link);
}

// Returns whether the host has the device open now.
static int is_open(void) {
    struct pollfd master = {.fd = board.terminal};
    poll(&master, 1, 0);
    return !(master.revents & POLLHUP);
}

static void exchange(void) {
    uint8_t bytes[256];
    ssize_t count = read(board.terminal, bytes, sizeof(bytes));
    for (ssize_t i = 0; i < count; i++)
        put(&board.to_node, bytes[i]);
    while (board.to_host.count && board.slave_open) {
        if (write(board.terminal, &board.to_host.bytes[board.to_host.first], 1) != 1)
            break;
        board.to_host.first = (board.to_host.first + 1) % RING;
        board.to_host.count--;
    }
    if (!board.slave_open)
        board.to_host.count = 0;
}

// ------------------------------------------------------------------------------------------------ processor

static void byte_out(struct avr_irq_t *irq, uint32_t value, void *context) {
    (void)irq, (void)context;
    put(&board.to_host, (uint8_t)value);
}

static void accepts_more(struct avr_irq_t *irq, uint32_t value, void *context) {
    (void)irq, (void)value;
    board.accepts = context != NULL;
}

static void has_reset(struct avr_t *avr) {
    board.was_reset = 1;
    if (board.core_reset)
        board.core_reset(avr);
}

static void start(const char *hex) {
    uint32_t size = 0, at = 0, flags = 0;
    uint8_t *code = read_ihex_file(hex, &size, &at);
    avr_t *avr = board.avr = avr_make_mcu_by_name("atmega2560");
    if (!code || !avr || avr_init(avr))
        fail(hex);
    avr->frequency = FREQUENCY;
    avr->log = LOG_NONE;
    avr_loadcode(avr, code, size, at);
    avr->codeend = avr->flashend;
    board.core_reset = avr->reset;
    avr->reset = has_reset;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    board.uart_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), byte_out, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), accepts_more,
                            &board);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), accepts_more,
                            NULL);
    board.accepts = 1;
}

static void run_slice(void) {
    avr_t *avr = board.avr;
    avr_cycle_count_t end = avr->cycle + SLICE_CYCLES;
    while (avr->cycle < end && !board.was_reset) {
        struct ring *ring = &board.to_node;
        if (ring->count && board.accepts && avr->cycle >= board.next_byte) {
            avr_raise_irq(board.uart_in, ring->bytes[ring->first]);
            ring->first = (ring->first + 1) % RING;
            ring->count--;
            board.next_byte = avr->cycle + BYTE_CYCLES;
        }
        int state = avr_run(avr);
        // libsimavr serves no interrupt in "sei; nop; cli", where the processor does: it counts one too many.
        if (avr->sreg[S_I] && avr->interrupt_state > 0)
            avr_service_interrupts(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            fprintf(stderr, "the processor stopped in state %d\n", state);
            exit(1);
        }
    }
}

// ---------------------------------------------------------------------------------------------------- time

static void end_with_input(void) {
    struct pollfd input = {.fd = STDIN_FILENO, .events = POLLIN};
    char byte;
    if (poll(&input, 1, 0) > 0 && read(STDIN_FILENO, &byte, 1) <= 0) {
        unlink(board.link);
        exit(0);
    }
}

// The board does nothing for MS, and loses what it is sent.
static void be_deaf(long ms) {
    int64_t end = now_ns() + ms * 1000000;
    while (now_ns() < end) {
        end_with_input();
        usleep(2000);
        if (board.terminal >= 0)
            exchange();
        board.to_node.count = 0;
    }
}

static void after_reset(void) {
    board.was_reset = 0;
    board.to_node.count = board.to_host.count = 0;
    board.accepts = 1;
    if (board.gone_ms) {
        unlink(board.link);
        close(board.terminal);
        board.terminal = -1;
        be_deaf(board.gone_ms);
        open_terminal();
        board.slave_open = 0;
    }
    be_deaf(board.deaf_ms);
}

int main(int argc, char **argv) {
    if (argc != 6) {
        fprintf(stderr, "usage: %s HEX LINK DEAF_MS GONE_MS DTR\n", argv[0]);
        return 2;
    }
    board.link = argv[2];
    board.deaf_ms = atol(argv[3]), board.gone_ms = atol(argv[4]), board.dtr = atoi(argv[5]);
    start(argv[1]);
    open_terminal();
    int64_t due = now_ns();
    for (;;) {
        end_with_input();
        int opened = is_open() && !board.slave_open;
        board.slave_open = is_open();
        if (opened && board.dtr)
            avr_reset(board.avr);
        if (board.was_reset) {
            after_reset();
            due = now_ns();
        }
        exchange();
        run_slice();
        due += SLICE_CYCLES * INT64_C(1000000000) / FREQUENCY;
        int64_t ahead = due - now_ns();
        if (ahead > 0)
            usleep((useconds_t)(ahead / 1000));
        else if (ahead < -BEHIND_NS_MAX)
            due = now_ns(); // a busy computer: the board's time lags behind
    }
}
