// SPDX-License-Identifier: Apache-2.0
// A process whose read() stops it, just before it reads, while the file HOLD is there: whoever stopped it
// knows what it has done by then, and gives it time and input.
#define _GNU_SOURCE
#include <signal.h>
#include <sys/syscall.h>
#include <unistd.h>

ssize_t read(int fd, void *out, size_t size) {
    if (access(HOLD, F_OK) == 0)
        raise(SIGSTOP);
    return syscall(SYS_read, fd, out, size);
}
