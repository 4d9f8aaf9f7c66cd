// SPDX-License-Identifier: Apache-2.0
// The plant of a node that is a process. Its page is a file beside its description, which the other nodes'
// processes map as well; what happens goes to a log.
//
// Steps of other nodes are seen exact to the sample. A process that the kernel wakes late makes its steps
// late, but for their own time; who samples a switch at T therefore waits until the others have come to T:
// each tells in its page up to when its steps are in. Whoever waits says first that it has come to T itself,
// so of two that wait for each other the earlier one goes on.
#define _GNU_SOURCE
#include "boards/linux/linux.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum {
    UPDATE_NS = 50 * 1000 * 1000,    // between two entries of temperatures
    PATIENCE_NS = 500 * 1000 * 1000, // a busy computer may let a process wait for long
    LOOK_NS = 20 * 1000,
    TEXT_MAX = 64 * 1024,
    PATH_SIZE = 4096,
};

uint64_t virtual_true_ns(struct virtual_board *virtual) {
    const struct linux_board *board = (const struct linux_board *)virtual;
    return board->dispatching ? ns_of_clock(board, board->dispatch_clock) : monotonic_ns();
}

static int complain(const char *what, const char *path, const char *why) {
    fprintf(stderr, "cannot %s %s: %s\n", what, path, why);
    return -1;
}

// ------------------------------------------------------------------------------------------------- files

// The file of NODE with SUFFIX, in the folder of the description.
static void path_of(const struct linux_board *board, const char *node, const char *suffix, char *out) {
    const char *plant = board->options.plant, *slash = strrchr(plant, '/');
    int folder = slash ? (int)(slash - plant) + 1 : 0;
    snprintf(out, PATH_SIZE, "%.*s%s%s", folder, plant, node, suffix);
}

// Maps the page of NODE; whoever comes first makes it, empty.
static struct plant_page *map_page(const struct linux_board *board, const char *node) {
    char path[PATH_SIZE];
    path_of(board, node, ".page", path);
    int fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0644);
    if (fd < 0 || ftruncate(fd, sizeof(struct plant_page))) {
        complain("make the page of the plant", path, strerror(errno));
        if (fd >= 0)
            close(fd);
        return NULL;
    }
    void *page = mmap(NULL, sizeof(struct plant_page), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    close(fd);
    if (page == MAP_FAILED) {
        complain("map the page of the plant", path, strerror(errno));
        return NULL;
    }
    return page;
}

// The whole file, to be freed; NULL after a sentence.
static char *read_text(const char *path, size_t *size) {
    FILE *file = fopen(path, "re");
    char *text = malloc(TEXT_MAX);
    *size = file && text ? fread(text, 1, TEXT_MAX, file) : 0;
    const char *why = !file          ? strerror(errno)
                      : !text        ? "out of memory"
                      : ferror(file) ? "cannot be read"
                                     : NULL;
    if (!why && *size == TEXT_MAX)
        why = "it is too long";
    if (file)
        fclose(file);
    if (!why)
        return text;
    complain("read the plant", path, why);
    free(text);
    return NULL;
}

// ------------------------------------------------------------------------------------------------- others

static uint64_t horizon_of(const struct plant_page *page) {
    return atomic_load_explicit(&page->horizon_ns, memory_order_acquire);
}

static void come_to(struct linux_board *board, uint64_t ns) {
    if (ns > horizon_of(board->plant.page))
        atomic_store_explicit(&board->plant.page->horizon_ns, ns, memory_order_release);
}

// A peer that has not started is not waited for, nor one that let us wait in vain since.
static void settle(void *context, unsigned number, uint64_t ns) {
    struct linux_board *board = context;
    const struct plant_page *page = board->plant.peers[number].page;
    uint64_t horizon = horizon_of(page);
    if (horizon >= ns || !horizon || horizon == board->plant_given_up[number])
        return;
    come_to(board, ns);
    board->plant_waits++;
    uint64_t end = monotonic_ns() + PATIENCE_NS;
    const struct timespec look = {.tv_nsec = LOOK_NS};
    while ((horizon = horizon_of(page)) < ns) {
        if (monotonic_ns() > end) {
            board->plant_given_up[number] = horizon;
            board->plant_misses++;
            return;
        }
        nanosleep(&look, NULL);
    }
}

void linux_plant_horizon(struct linux_board *board, uint64_t ns) {
    if (board->virtual.plant)
        atomic_store_explicit(&board->plant.page->horizon_ns, ns, memory_order_release);
}

// ------------------------------------------------------------------------------------------------- the log

static void note(void *context, uint64_t ns, const char *kind, const char *name, double value) {
    struct linux_board *board = context;
    if (board->plant_log)
        fprintf(board->plant_log, "%llu\t%s\t%s\t%.9g\n", (unsigned long long)ns, kind, name, value);
}

static void note_temperatures(struct linux_board *board, uint64_t ns) {
    const struct plant *plant = &board->plant;
    for (int i = 0; i < plant->body_count; i++)
        note(board, ns, "body", plant->bodies[i].name, plant_page_load(&plant->page->items[i].value));
    if (board->plant_log)
        fflush(board->plant_log);
}

uint64_t linux_plant_update(struct linux_board *board, uint64_t now) {
    if (!board->virtual.plant)
        return UINT64_MAX;
    if (now >= board->plant_update_ns) {
        plant_update(&board->plant, now);
        note_temperatures(board, now);
        board->plant_update_ns = now + UPDATE_NS;
    }
    return board->plant_update_ns;
}

// ------------------------------------------------------------------------------------------------- life

static int open_pages(struct linux_board *board) {
    struct plant *plant = &board->plant;
    struct plant_page *page = map_page(board, plant->node);
    if (!page)
        return -1;
    plant_start(plant, page, monotonic_ns());
    for (int i = 0; i < plant->peer_count; i++)
        if (!(plant->peers[i].page = map_page(board, plant->peers[i].node)))
            return -1;
    return 0;
}

static int open_log(struct linux_board *board) {
    char path[PATH_SIZE];
    if (!board->options.plant_log)
        return 0;
    path_of(board, board->plant.node, ".plantlog", path);
    board->plant_log = fopen(path, "we");
    return board->plant_log ? 0 : complain("write the plant's log", path, strerror(errno));
}

int linux_plant_open(struct linux_board *board) {
    if (!board->options.plant)
        return 0;
    size_t size;
    char error[PLANT_ERROR], *text = read_text(board->options.plant, &size);
    if (!text)
        return -1;
    int status = plant_read(&board->plant, text, size, VIRTUAL_ADC_MAX, VIRTUAL_PWM_MAX, error);
    free(text);
    if (status)
        return complain("use the plant", board->options.plant, error);
    if (open_pages(board) || open_log(board))
        return -1;
    board->plant.host = (struct plant_host){.context = board, .settle = settle, .note = note};
    board->virtual.plant = &board->plant;
    return 0;
}

void linux_plant_close(struct linux_board *board) {
    if (!board->virtual.plant)
        return;
    uint64_t now = monotonic_ns();
    board->plant_update_ns = 0;
    linux_plant_update(board, now);
    linux_plant_horizon(board, UINT64_MAX); // nobody is to wait for what comes no more
    if (board->plant_log)
        fclose(board->plant_log);
    board->virtual.plant = NULL;
}
