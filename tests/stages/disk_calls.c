/*
 * Records every call that changes the files of one folder, and makes one of them fail or kill the process.
 *
 * Loaded with LD_PRELOAD (tests/stages/disk_calls.py). Only that folder is looked at; it has no folders
 * inside. fsync is recorded but not passed on: what it promises is checked on the record, for any disk.
 *
 * The record is text, a call a line: create, cut and write name the file by its inode, rename, link and
 * unlink by its name, sync by its inode (0: the folder).
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

/* What happens to call number FAIL_AT; the rest pass. */
enum mode {
    MODE_NONE = 0,
    MODE_ERROR = 1,     /* it fails */
    MODE_ERROR_ON = 2,  /* it and all after it fail, but unlink with ENOSPC */
    MODE_SHORT = 3,     /* a write writes half, and the next call fails */
    MODE_KILL = 4,      /* the process is killed before it */
    MODE_KILL_TORN = 5, /* the process is killed after half of it, if it is a write */
};

void disk_arm(const char *path, const char *record_path, int what, long call, int error);
long disk_disarm(void);
void disk_mark(const char *text);

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static char folder[PATH_MAX];
static size_t folder_length;
static ino_t folder_inode;
static FILE *record;
static enum mode mode;
static long fail_at;
static int fail_error;
static long calls;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

void disk_arm(const char *path, const char *record_path, int what, long call, int error) {
    struct stat status;
    snprintf(folder, sizeof folder, "%s", path);
    folder_length = strlen(folder);
    folder_inode = stat(folder, &status) == 0 ? status.st_ino : 0;
    record = fopen(record_path, "w");
    mode = (enum mode)what;
    fail_at = call;
    fail_error = error;
    calls = 0;
}

long disk_disarm(void) {
    folder_length = 0;
    if (record) {
        fclose(record);
        record = NULL;
    }
    return calls;
}

static void note(const char *format, ...) {
    va_list arguments;
    if (!record) {
        return;
    }
    va_start(arguments, format);
    vfprintf(record, format, arguments);
    va_end(arguments);
    if (strchr(format, '\n')) {
        fflush(record);
    }
}

static void note_write(ino_t inode, off_t at, const unsigned char *data, ssize_t count) {
    static const char digits[] = "0123456789abcdef";
    if (!record) {
        return;
    }
    note("write %lu %ld ", (unsigned long)inode, (long)at);
    for (ssize_t n = 0; n < count; n++) {
        putc(digits[data[n] >> 4], record);
        putc(digits[data[n] & 15], record);
    }
    note("\n");
}

void disk_mark(const char *text) {
    pthread_mutex_lock(&lock);
    note("mark %s\n", text);
    pthread_mutex_unlock(&lock);
}

/* The name inside the folder that PATH, relative to DIRECTORY, leads to; NULL: it is elsewhere. */
static const char *inside(int directory, const char *path) {
    struct stat status;
    if (!folder_length || !path) {
        return NULL;
    }
    if (path[0] == '/') {
        return !strncmp(path, folder, folder_length) && path[folder_length] == '/' ? path + folder_length + 1
                                                                                   : NULL;
    }
    if (directory == AT_FDCWD || fstat(directory, &status) || status.st_ino != folder_inode) {
        return NULL;
    }
    return path;
}

/* The inode of FD if it is a file that was opened in the folder, 0: it is not; the folder itself is 0, too.
 */
static ino_t file_inside(int fd) {
    char link[64], target[PATH_MAX];
    struct stat status;
    ssize_t length;
    if (!folder_length || fstat(fd, &status) || !S_ISREG(status.st_mode)) {
        return 0;
    }
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    length = readlink(link, target, sizeof target - 1);
    if (length <= (ssize_t)folder_length || strncmp(target, folder, folder_length)) {
        return 0;
    }
    return status.st_ino;
}

/* Count a call; return 0 if it passes, 1 if half of it does, -1 with errno if it fails. */
static int turn(int is_write, int is_unlink) {
    long number = ++calls;
    switch (mode) {
    case MODE_ERROR:
        if (number != fail_at) {
            return 0;
        }
        break;
    case MODE_ERROR_ON:
        if (number < fail_at || (is_unlink && fail_error == ENOSPC)) {
            return 0;
        }
        break;
    case MODE_SHORT:
        if (number == fail_at && is_write) {
            return 1;
        }
        if (number != fail_at + 1) {
            return 0;
        }
        break;
    case MODE_KILL:
    case MODE_KILL_TORN:
        if (number != fail_at) {
            return 0;
        }
        if (mode == MODE_KILL_TORN && is_write) {
            return 1;
        }
        kill(getpid(), SIGKILL);
        break;
    case MODE_NONE:
    default:
        return 0;
    }
    errno = fail_error;
    return -1;
}

static int opened(int directory, const char *path, int flags, mode_t permissions) {
    const char *name = inside(directory, path);
    struct stat status;
    int fd, existed;
    if (!name || !(flags & (O_WRONLY | O_RDWR))) {
        return REAL(openat)(directory, path, flags, permissions);
    }
    pthread_mutex_lock(&lock);
    existed = !fstatat(directory, path, &status, AT_SYMLINK_NOFOLLOW);
    fd = turn(0, 0) < 0 ? -1 : REAL(openat)(directory, path, flags, permissions);
    if (fd >= 0 && !fstat(fd, &status)) {
        if (!existed) {
            note("create %lu %s\n", (unsigned long)status.st_ino, name);
        } else if (flags & O_TRUNC) {
            note("cut %lu 0\n", (unsigned long)status.st_ino);
        }
    }
    pthread_mutex_unlock(&lock);
    return fd;
}

#define OPEN(name, directory, before)                                                                        \
    int name(before const char *path, int flags, ...) {                                                      \
        va_list arguments;                                                                                   \
        mode_t permissions = 0;                                                                              \
        if (flags & (O_CREAT | O_TMPFILE)) {                                                                 \
            va_start(arguments, flags);                                                                      \
            permissions = va_arg(arguments, mode_t);                                                         \
            va_end(arguments);                                                                               \
        }                                                                                                    \
        return opened(directory, path, flags, permissions);                                                  \
    }
#define NOTHING
#define DIRECTORY int fd,
OPEN(open, AT_FDCWD, NOTHING)
OPEN(open64, AT_FDCWD, NOTHING)
OPEN(openat64, fd, DIRECTORY)

ssize_t write(int fd, const void *data, size_t count) {
    ino_t inode = file_inside(fd);
    ssize_t written = -1;
    struct stat status;
    off_t at;
    int passes;
    if (!inode) {
        return REAL(write)(fd, data, count);
    }
    pthread_mutex_lock(&lock);
    passes = turn(1, 0);
    if (passes >= 0) {
        at = fcntl(fd, F_GETFL) & O_APPEND && !fstat(fd, &status) ? status.st_size : lseek(fd, 0, SEEK_CUR);
        written = REAL(write)(fd, data, passes ? count / 2 : count);
        if (passes && mode == MODE_KILL_TORN) {
            kill(getpid(), SIGKILL);
        }
        if (mode == MODE_NONE) {
            note_write(inode, at, data, written);
        }
    }
    pthread_mutex_unlock(&lock);
    return written;
}

int fsync(int fd) {
    ino_t inode = file_inside(fd);
    struct stat status;
    int result;
    if (!inode && (!folder_length || fstat(fd, &status) || status.st_ino != folder_inode)) {
        return 0;
    }
    pthread_mutex_lock(&lock);
    result = turn(0, 0) < 0 ? -1 : 0;
    if (!result) {
        note("sync %lu\n", (unsigned long)inode);
    }
    pthread_mutex_unlock(&lock);
    return result;
}

int fchmod(int fd, mode_t permissions) {
    int fails = 0;
    if (file_inside(fd)) {
        pthread_mutex_lock(&lock);
        fails = turn(0, 0) < 0;
        pthread_mutex_unlock(&lock);
    }
    return fails ? -1 : REAL(fchmod)(fd, permissions);
}

static int renamed(int from_directory, const char *from, int to_directory, const char *to) {
    const char *before = inside(from_directory, from), *after = inside(to_directory, to);
    int result;
    if (!before || !after) {
        return REAL(renameat)(from_directory, from, to_directory, to);
    }
    pthread_mutex_lock(&lock);
    result = turn(0, 0) < 0 ? -1 : REAL(renameat)(from_directory, from, to_directory, to);
    if (!result) {
        note("rename %s\t%s\n", before, after);
    }
    pthread_mutex_unlock(&lock);
    return result;
}

int rename(const char *from, const char *to) {
    return renamed(AT_FDCWD, from, AT_FDCWD, to);
}

int renameat(int from_directory, const char *from, int to_directory, const char *to) {
    return renamed(from_directory, from, to_directory, to);
}

int linkat(int from_directory, const char *from, int to_directory, const char *to, int flags) {
    const char *before = inside(from_directory, from), *after = inside(to_directory, to);
    int result;
    if (!before || !after) {
        return REAL(linkat)(from_directory, from, to_directory, to, flags);
    }
    pthread_mutex_lock(&lock);
    result = turn(0, 0) < 0 ? -1 : REAL(linkat)(from_directory, from, to_directory, to, flags);
    if (!result) {
        note("link %s\t%s\n", before, after);
    }
    pthread_mutex_unlock(&lock);
    return result;
}

int unlinkat(int directory, const char *path, int flags) {
    const char *name = inside(directory, path);
    int result;
    if (!name) {
        return REAL(unlinkat)(directory, path, flags);
    }
    pthread_mutex_lock(&lock);
    result = turn(0, 1) < 0 ? -1 : REAL(unlinkat)(directory, path, flags);
    if (!result) {
        note("unlink %s\n", name);
    }
    pthread_mutex_unlock(&lock);
    return result;
}

int unlink(const char *path) {
    return unlinkat(AT_FDCWD, path, 0);
}
