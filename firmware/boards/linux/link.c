// SPDX-License-Identifier: Apache-2.0
// The wire of a Linux node: a virtual CAN bus (a Unix stream socket carrying struct can_frame records),
// SocketCAN, or a pseudo-terminal as UART. Nothing blocks; what waits to leave is bounded by OUT_BUFFER,
// behind which the core's own transmit buffer fills up and commands wait.
#define _GNU_SOURCE
#include "boards/linux/linux.h"

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

// SocketCAN says ENOBUFS while the interface's queue is full, and yet poll() calls the socket writable: only
// time helps. A full frame lasts 111 µs and more.
enum { NO_BUFFERS_NS = 300000, INTERFACE_DOWN_NS = 10000000 };

_Static_assert(sizeof(struct can_frame) == 16, "records of the virtual bus");

static int complain(const char *what, const char *target) {
    fprintf(stderr, "%s %s: %s\n", what, target, strerror(errno));
    return -1;
}

// --------------------------------------------------------------------------------------------------- opening

static int open_virtual_can(const char *path) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (strlen(path) >= sizeof(address.sun_path)) {
        errno = ENAMETOOLONG;
        return complain("cannot join the virtual CAN bus", path);
    }
    memcpy(address.sun_path, path, strlen(path) + 1);
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0 || connect(fd, (const struct sockaddr *)&address, sizeof(address)))
        return complain("cannot join the virtual CAN bus", path);
    return fd;
}

// Frames that are not for a node with NODE_ID need not even wake this process: a node that reads all that
// others say falls behind on a busy computer. Without an id it reads all plain frames, since its first data
// may follow the id at once. Narrower filters lose nothing: the kernel adds them before it drops the old
// ones.
static int filter_frames(int fd, uint8_t node_id) {
    const canid_t plain = CAN_EFF_FLAG | CAN_RTR_FLAG, id = CAN_SFF_MASK;
    const canid_t signal = id & ~(canid_t)(CAN_ID_URGENT_END - 1), pair = id & ~(canid_t)1;
    const struct can_filter all = {.can_id = 0, .can_mask = plain};
    const struct can_filter own[] = {
        {.can_id = 0, .can_mask = plain | signal},
        {.can_id = CAN_ID_ADMIN_REQUEST, .can_mask = plain | id},
        {.can_id = CAN_ID_TABLES, .can_mask = plain | id},
        {.can_id = can_stream_receive_id(node_id), .can_mask = plain | pair},
    };
    return node_id ? setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, own, sizeof(own))
                   : setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, &all, sizeof(all));
}

static int open_socketcan(const char *interface) {
    struct sockaddr_can address = {.can_family = AF_CAN};
    address.can_ifindex = (int)if_nametoindex(interface);
    if (!address.can_ifindex)
        return complain("cannot open the CAN interface", interface);
    int fd = socket(PF_CAN, SOCK_RAW | SOCK_CLOEXEC, CAN_RAW);
    if (fd < 0 || bind(fd, (const struct sockaddr *)&address, sizeof(address)))
        return complain("cannot open the CAN interface", interface);
    if (filter_frames(fd, 0))
        return complain("cannot set up the CAN interface", interface);
    return fd;
}

// Keeps the slave side open too: the host may come and go without the terminal hanging up.
static int open_uart(struct linux_board *board, const char *link) {
    char name[128];
    struct termios raw;
    int fd = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (fd < 0 || grantpt(fd) || unlockpt(fd) || ptsname_r(fd, name, sizeof(name)))
        return complain("cannot make a pseudo-terminal for", link);
    board->slave_fd = open(name, O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (board->slave_fd < 0 || tcgetattr(board->slave_fd, &raw))
        return complain("cannot open the pseudo-terminal for", link);
    cfmakeraw(&raw);
    if (tcsetattr(board->slave_fd, TCSANOW, &raw))
        return complain("cannot set up the pseudo-terminal for", link);
    if ((unlink(link) && errno != ENOENT) || symlink(name, link))
        return complain("cannot make the link", link);
    return fd;
}

int link_open(struct linux_board *board) {
    const char *target = board->options.target;
    board->slave_fd = -1;
    switch (board->options.link) {
    case LINK_VIRTUAL_CAN:
        board->fd = open_virtual_can(target);
        break;
    case LINK_SOCKETCAN:
        board->fd = open_socketcan(target);
        break;
    default:
        board->fd = open_uart(board, target);
    }
    if (board->fd >= 0 && fcntl(board->fd, F_SETFL, O_NONBLOCK))
        return complain("cannot set up", target);
    return board->fd < 0 ? -1 : 0;
}

void link_close(struct linux_board *board) {
    close(board->fd);
    if (board->options.link != LINK_UART)
        return;
    close(board->slave_fd);
    unlink(board->options.target);
}

// The descriptor failed with errno. A board outlives a bus that is dead for a while, and so does this one;
// only an interface that is gone does not come back.
static void handle_failure(struct linux_board *board) {
    int socketcan = board->options.link == LINK_SOCKETCAN;
    if (errno == EAGAIN || errno == EINTR)
        return;
    if (socketcan && (errno == ENOBUFS || errno == ENETDOWN)) {
        board->retry_ns = monotonic_ns() + (errno == ENOBUFS ? NO_BUFFERS_NS : INTERFACE_DOWN_NS);
        return;
    }
    if (socketcan && !board->failed) {
        complain("cannot go on without the CAN interface", board->options.target);
        board->failed = 1;
    }
    board->closed = 1;
}

// ------------------------------------------------------------------------------------------------- receiving

// Gives SIZE bytes of a UART to the node in pieces its receive buffer takes.
static void receive_bytes(struct linux_board *board, const uint8_t *data, size_t size) {
    struct node *node = &board->virtual.node;
    while (size) {
        size_t piece = size < WIRE_BLOCK_MAX ? size : WIRE_BLOCK_MAX;
        node_receive(node, data, piece);
        node_run_tasks(node);
        data += piece;
        size -= piece;
    }
}

// Gives whole frames to the node; returns the bytes used.
static size_t receive_frames(struct linux_board *board, const uint8_t *data, size_t size) {
    size_t used = 0;
    struct can_frame frame;
    for (; size - used >= sizeof(frame); used += sizeof(frame)) {
        memcpy(&frame, data + used, sizeof(frame));
        if (frame.can_id > CAN_SFF_MASK || frame.can_dlc > CAN_FRAME_MAX)
            continue; // extended, remote or error frames are not ours
        board->frames_in++;
        can_stream_receive(&board->virtual.node, frame.can_id, frame.data, frame.can_dlc);
        node_run_tasks(&board->virtual.node);
    }
    return used;
}

void link_read(struct linux_board *board) {
    ssize_t got = read(board->fd, board->in + board->in_size, sizeof(board->in) - board->in_size);
    if (got == 0)
        board->closed = 1;
    if (got < 0)
        handle_failure(board);
    if (got <= 0)
        return;
    board->bytes_in += (uint64_t)got;
    board->in_size += (size_t)got;
}

void link_hand_over(struct linux_board *board) {
    size_t used = board->in_size;
    if (board->options.link == LINK_UART)
        receive_bytes(board, board->in, board->in_size);
    else
        used = receive_frames(board, board->in, board->in_size);
    const uint8_t node_id = board->can.node_id;
    if (board->options.link == LINK_SOCKETCAN && node_id != board->filtered_id &&
        !filter_frames(board->fd, node_id))
        board->filtered_id = node_id;
    board->in_size -= used;
    memmove(board->in, board->in + used, board->in_size);
}

// ---------------------------------------------------------------------------------------------- transmitting

void link_flush(struct linux_board *board) {
    size_t sent = 0;
    if (board->retry_ns && monotonic_ns() < board->retry_ns)
        return;
    board->retry_ns = 0;
    while (sent < board->out_size) {
        size_t size = board->out_size - sent;
        if (board->options.link == LINK_SOCKETCAN)
            size = sizeof(struct can_frame); // one write is one frame
        ssize_t done = write(board->fd, board->out + sent, size);
        if (done < 0 && errno == EINTR)
            continue;
        if (done < 0)
            handle_failure(board);
        if (done <= 0)
            break;
        sent += (size_t)done;
    }
    if (!sent)
        return;
    board->bytes_out += sent;
    board->out_size -= sent;
    memmove(board->out, board->out + sent, board->out_size);
    if (board->refused)
        node_wake_tasks(&board->virtual.node);
    board->refused = 0;
}

// Where a frame with ID goes: urgent ones before the data, but not before what is already half written.
static size_t place_for(const struct linux_board *board, uint32_t id) {
    if (id >= CAN_ID_URGENT_END)
        return board->out_size;
    size_t at = board->out_size % sizeof(struct can_frame);
    for (struct can_frame frame; at < board->out_size; at += sizeof(frame)) {
        memcpy(&frame, board->out + at, sizeof(frame));
        if (frame.can_id >= CAN_ID_URGENT_END)
            break;
    }
    return at;
}

int board_can_send(struct node *node, uint32_t id, const uint8_t *data, size_t size) {
    struct linux_board *board = (struct linux_board *)node;
    struct can_frame frame = {.can_id = id, .can_dlc = (uint8_t)size};
    if (OUT_BUFFER - board->out_size < sizeof(frame)) {
        board->refused = 1;
        return -1;
    }
    memcpy(frame.data, data, size);
    size_t at = place_for(board, id);
    memmove(board->out + at + sizeof(frame), board->out + at, board->out_size - at);
    memcpy(board->out + at, &frame, sizeof(frame));
    board->out_size += sizeof(frame);
    board->frames_out++;
    return 0;
}

size_t board_uart_send(struct node *node, const uint8_t *data, size_t size) {
    struct linux_board *board = (struct linux_board *)node;
    size_t room = OUT_BUFFER - board->out_size;
    if (size > room) {
        board->refused = 1;
        size = room;
    }
    memcpy(board->out + board->out_size, data, size);
    board->out_size += size;
    return size;
}
