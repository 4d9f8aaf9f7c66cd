// SPDX-License-Identifier: Apache-2.0
// The wires of a virtual node: a stream of can_frame records, a SocketCAN interface, or a pseudo-terminal.
#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <termios.h>
#include <unistd.h>

#include "boards/linux/linux_board.h"
#include "net/uart_stream.h"

DECL_CONSTANT("CANBUS_FREQUENCY", 1000000);

static int refuse(const char *what, const char *where, const char *advice) {
    fprintf(stderr, "canductor-node: cannot %s %s: %s; %s\n", what, where, strerror(errno), advice);
    return -1;
}

static int open_virtual(struct linux_board *board) {
    const char *path = board->options.can;
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (strlen(path) >= sizeof(address.sun_path)) {
        errno = ENAMETOOLONG;
        return refuse("connect to", path, "use a shorter path");
    }
    memcpy(address.sun_path, path, strlen(path));
    board->fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (board->fd < 0 || connect(board->fd, (struct sockaddr *)&address, sizeof(address)))
        return refuse("connect to the virtual bus", path, "start the bus first");
    return 0;
}

static int open_socketcan(struct linux_board *board) {
    const char *name = board->options.socketcan;
    struct sockaddr_can address = {.can_family = AF_CAN};
    board->fd = socket(PF_CAN, SOCK_RAW | SOCK_CLOEXEC, CAN_RAW);
    if (board->fd < 0)
        return refuse("use", name, "this kernel has no CAN; load can and can-raw");
    address.can_ifindex = (int)if_nametoindex(name);
    if (!address.can_ifindex || bind(board->fd, (struct sockaddr *)&address, sizeof(address)))
        return refuse("open the CAN interface", name, "create it and set it up first");
    return 0;
}

static int open_pty(struct linux_board *board) {
    const char *link = board->options.uart;
    board->fd = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (board->fd < 0 || grantpt(board->fd) || unlockpt(board->fd))
        return refuse("make", "a pseudo-terminal", "mount /dev/pts");
    const char *slave = ptsname(board->fd);
    // Kept open here too, so that the host may come and go.
    board->slave_fd = slave ? open(slave, O_RDWR | O_NOCTTY | O_CLOEXEC) : -1;
    struct termios line;
    if (board->slave_fd < 0 || tcgetattr(board->slave_fd, &line))
        return refuse("open", "the pseudo-terminal", "mount /dev/pts");
    cfmakeraw(&line);
    tcsetattr(board->slave_fd, TCSANOW, &line);
    unlink(link);
    if (symlink(slave, link))
        return refuse("make the link", link, "name a path that can be written");
    return 0;
}

int wires_open(struct linux_board *board) {
    board->fd = board->slave_fd = -1;
    int failed = board->options.can         ? open_virtual(board)
                 : board->options.socketcan ? open_socketcan(board)
                                            : open_pty(board);
    if (!failed)
        fcntl(board->fd, F_SETFL, O_NONBLOCK);
    return failed;
}

void wires_close(struct linux_board *board) {
    if (board->options.uart)
        unlink(board->options.uart);
    close(board->fd);
    if (board->slave_fd >= 0)
        close(board->slave_fd);
}

// ----------------------------------------------------------------------------------------------------
// reading

static void receive_frame(struct linux_board *board, const uint8_t *record) {
    struct can_frame frame;
    memcpy(&frame, record, sizeof(frame));
    if (frame.can_id > CAN_SFF_MASK || frame.len > CAN_MAX_DLEN) {
        board->frames_bad++;
        return;
    }
    board->frames_in++;
    can_stream_receive(&board->node, frame.can_id, frame.data, frame.len);
}

static void receive_records(struct linux_board *board) {
    size_t at = 0;
    for (; board->in_size - at >= sizeof(struct can_frame); at += sizeof(struct can_frame))
        receive_frame(board, board->in + at);
    board->in_size -= at;
    memmove(board->in, board->in + at, board->in_size);
}

void wires_read(struct linux_board *board) {
    ssize_t got = read(board->fd, board->in + board->in_size, sizeof(board->in) - board->in_size);
    if (got <= 0) {
        board->closed = got == 0 || (errno != EAGAIN && errno != EINTR);
        return;
    }
    board->bytes_in += (uint64_t)got;
    board->in_size += (size_t)got;
    if (!board->options.uart) {
        receive_records(board);
    } else {
        link_receive(&board->node, board->in, board->in_size);
        board->in_size = 0;
    }
}

// ----------------------------------------------------------------------------------------------------
// writing

static size_t room(const struct linux_board *board) {
    return sizeof(board->out) - (board->out_to - board->out_from);
}

static void queue(struct linux_board *board, const void *data, size_t size) {
    if (sizeof(board->out) - board->out_to < size) {
        memmove(board->out, board->out + board->out_from, board->out_to - board->out_from);
        board->out_to -= board->out_from;
        board->out_from = 0;
    }
    memcpy(board->out + board->out_to, data, size);
    board->out_to += size;
}

void wires_write(struct linux_board *board) {
    while (board->out_from < board->out_to) {
        // SocketCAN takes one record a call; a stream does not mind.
        size_t size = board->options.socketcan ? sizeof(struct can_frame) : board->out_to - board->out_from;
        ssize_t sent = write(board->fd, board->out + board->out_from, size);
        if (sent < 0) {
            board->closed |= errno != EAGAIN && errno != EINTR && errno != ENOBUFS;
            return;
        }
        board->bytes_out += (uint64_t)sent;
        board->out_from += (size_t)sent;
    }
    if (board->was_full) {
        board->was_full = false;
        link_transmit_ready(&board->node);
    }
}

bool board_can_send(struct node *node, uint32_t id, const uint8_t *data, uint8_t size) {
    struct linux_board *board = board_of(node);
    struct can_frame frame = {.can_id = id, .len = size};
    memcpy(frame.data, data, size);
    if (room(board) < sizeof(frame)) {
        board->was_full = true;
        return false;
    }
    queue(board, &frame, sizeof(frame));
    board->frames_out++;
    return true;
}

uint32_t board_uart_send(struct node *node, const uint8_t *data, uint32_t size) {
    struct linux_board *board = board_of(node);
    size_t taken = room(board) < size ? room(board) : size;
    board->was_full |= taken < size;
    queue(board, data, taken);
    return (uint32_t)taken;
}

// The virtual bus delivers everything; on SocketCAN the kernel filters.
void board_can_filter(struct node *node, const uint32_t *ids, uint8_t count) {
    struct linux_board *board = board_of(node);
    struct can_filter filters[3];
    for (uint8_t i = 0; i < count; i++)
        filters[i] =
            (struct can_filter){.can_id = ids[i], .can_mask = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG};
    if (board->options.socketcan)
        setsockopt(board->fd, SOL_CAN_RAW, CAN_RAW_FILTER, filters, count * (socklen_t)sizeof(*filters));
}

void board_can_status(struct node *node, struct board_can_status *status) {
    (void)node;
    *status = (struct board_can_status){0};
}
