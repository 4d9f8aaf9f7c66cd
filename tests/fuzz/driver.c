// SPDX-License-Identifier: Apache-2.0
// A small coverage-guided fuzzer for where libFuzzer is not installed: gcc's -fsanitize-coverage=trace-pc
// tells which edges an input takes, inputs that take new ones are kept and mutated further.
//
// Usage, as libFuzzer's: fuzz_motion [-max_total_time=S] [-runs=N] [-seed=N] FILE|FOLDER...
// What fails, or is at work when SIGTERM ends it, is written to ./crash-input.
#include <dirent.h>
#include <fcntl.h>
#include <sanitizer/common_interface_defs.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
void __sanitizer_cov_trace_pc(void);

enum { MAP = 1 << 16, INPUT_ROOM = 2048, MAX_CORPUS = 8192 };

static struct input {
    uint8_t *data;
    size_t size;
} corpus[MAX_CORPUS];
static size_t corpus_count;
static uint8_t taken[MAP], known[MAP]; // known: bit per magnitude of how often an edge was taken
static uintptr_t last_place;
static uint64_t random_state = 1;

void __sanitizer_cov_trace_pc(void) {
    uintptr_t place = (uintptr_t)__builtin_return_address(0);
    uint8_t *edge = &taken[(place ^ last_place << 3) & (MAP - 1)];
    *edge += *edge < 255;
    last_place = place;
}

static uint32_t below(uint32_t bound) {
    random_state = random_state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
    return (uint32_t)((random_state >> 33) * bound >> 31);
}

static int found_something(void) {
    int new = 0;
    for (int i = 0; i < MAP; i++) {
        if (!taken[i])
            continue;
        uint8_t magnitude = (uint8_t)(1 << (31 - __builtin_clz(taken[i])));
        new |= magnitude & ~known[i];
        known[i] |= magnitude;
    }
    return new;
}

static void keep(const uint8_t *data, size_t size) {
    size_t place = corpus_count < MAX_CORPUS ? corpus_count++ : below(MAX_CORPUS);
    free(corpus[place].data);
    corpus[place].data = malloc(size + 1);
    memcpy(corpus[place].data, data, size);
    corpus[place].size = size;
}

static const uint8_t *at_work;
static size_t at_work_size;

// The sanitizers call it, and what ends by a signal; nothing here may allocate.
static void write_crash(void) {
    int file = open("crash-input", O_WRONLY | O_CREAT | O_TRUNC, 0644);
    if (file >= 0 && write(file, at_work, at_work_size) == (ssize_t)at_work_size)
        close(file);
}

static void ended(int number) {
    write_crash();
    signal(number, SIG_DFL);
    raise(number);
}

static void try_input(const uint8_t *data, size_t size, int remember) {
    at_work = data;
    at_work_size = size;
    memset(taken, 0, sizeof taken);
    last_place = 0;
    LLVMFuzzerTestOneInput(data, size);
    if (found_something() || remember)
        keep(data, size);
}

static void load(const char *path) {
    struct dirent **entries;
    int count = scandir(path, &entries, NULL, alphasort); // in order: each run is the same
    if (count >= 0) {
        for (int i = 0; i < count; i++) {
            char name[4096];
            snprintf(name, sizeof name, "%s/%s", path, entries[i]->d_name);
            if (entries[i]->d_name[0] != '.')
                load(name);
            free(entries[i]);
        }
        free(entries);
        return;
    }
    uint8_t data[INPUT_ROOM];
    FILE *file = fopen(path, "rb");
    if (!file) {
        fprintf(stderr, "cannot read %s\n", path);
        exit(2);
    }
    size_t size = fread(data, 1, sizeof data, file);
    fclose(file);
    try_input(data, size, 1);
}

static const char *const TOKENS[] = {"\nG1 X",   " Y",       " Z", " E",  " F",  "\nG92 E0\n", "\nG92 X",
                                     "\nM204 S", "\nM204 P", " T", "\nA", "\nD", "\nH",        "\nR\3\n",
                                     "\nR\0\n",  "-",        ".",  "0.1", "100", "1e",         "99",
                                     "\n",       "0.00001",  ";",  "(",   ")"};

static void replace(uint8_t *data, size_t *size, size_t at, size_t cut, const void *with, size_t count) {
    if (cut > *size - at)
        cut = *size - at;
    if (*size - cut + count > INPUT_ROOM)
        return;
    memmove(data + at + count, data + at + cut, *size - at - cut);
    memcpy(data + at, with, count);
    *size = *size - cut + count;
}

static void mutate(uint8_t *data, size_t *size) {
    size_t at = below((uint32_t)*size + 1);
    const struct input *other = &corpus[below((uint32_t)corpus_count)];
    uint8_t byte = (uint8_t)(below(4) ? '0' + below(10) : below(256));
    switch (below(6)) {
    case 0:
        replace(data, size, at, 1, &byte, 1);
        break;
    case 1:
        replace(data, size, at, 0, &byte, 1);
        break;
    case 2:
        replace(data, size, at, 1 + below(below(16) + 1), &byte, 0);
        break;
    case 3: {
        const char *token = TOKENS[below(sizeof TOKENS / sizeof *TOKENS)];
        replace(data, size, at, below(2), token, strlen(token));
        break;
    }
    default: // a piece of another input
        if (other->size) {
            size_t from = below((uint32_t)other->size), count = 1 + below((uint32_t)(other->size - from));
            replace(data, size, at, below((uint32_t)count + 1), other->data + from, count);
        }
    }
}

int main(int argc, char **argv) {
    double seconds = 0, began = (double)time(NULL);
    unlink("crash-input");
    __sanitizer_set_death_callback(write_crash);
    signal(SIGABRT, ended);
    signal(SIGTERM, ended);
    uint64_t runs = 0, most = 0;
    for (int i = 1; i < argc; i++) {
        if (sscanf(argv[i], "-max_total_time=%lf", &seconds) == 1 ||
            sscanf(argv[i], "-runs=%lu", &most) == 1 || sscanf(argv[i], "-seed=%lu", &random_state) == 1)
            continue;
        if (argv[i][0] != '-')
            load(argv[i]);
    }
    static uint8_t data[INPUT_ROOM + 64];
    for (; corpus_count && (most == 0 || runs < most); runs++) {
        if (seconds > 0 && (double)time(NULL) - began >= seconds)
            break;
        const struct input *chosen = &corpus[below((uint32_t)corpus_count)];
        size_t size = chosen->size;
        memcpy(data, chosen->data, size);
        for (uint32_t count = 1 + below(5); count--;)
            mutate(data, &size);
        try_input(data, size, 0);
    }
    size_t edges = 0;
    for (int i = 0; i < MAP; i++)
        edges += known[i] != 0;
    printf("%lu runs in %.0f s, %zu edges, corpus of %zu, nothing failed\n", runs, (double)time(NULL) - began,
           edges, corpus_count);
    return 0;
}
