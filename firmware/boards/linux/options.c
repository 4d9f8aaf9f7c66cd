// SPDX-License-Identifier: Apache-2.0
// The command line of a virtual node.
#include <errno.h>
#include <getopt.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "boards/linux/linux_board.h"

enum { EXIT_USAGE = 2, CHIP_ID_MAX = 64 };

static const char USAGE[] =
    "usage: canductor-node (--can PATH | --socketcan INTERFACE | --uart LINK) [--uuid HEX | --chip-id HEX]\n"
    "    [--rate-ppm X] [--start-clock N] [--jitter-us N] [--slice-us N] [--seed N] [--edge-log FILE]\n";

static const struct option OPTIONS[] = {
    {"can", required_argument, NULL, 'c'},         {"socketcan", required_argument, NULL, 's'},
    {"uart", required_argument, NULL, 'u'},        {"uuid", required_argument, NULL, 'i'},
    {"chip-id", required_argument, NULL, 'h'},     {"rate-ppm", required_argument, NULL, 'r'},
    {"start-clock", required_argument, NULL, 'k'}, {"jitter-us", required_argument, NULL, 'j'},
    {"slice-us", required_argument, NULL, 'l'},    {"seed", required_argument, NULL, 'd'},
    {"edge-log", required_argument, NULL, 'e'},    {NULL, 0, NULL, 0},
};

static int refuse(const char *option, const char *value, const char *wanted) {
    fprintf(stderr, "canductor-node: %s '%s' is not %s\n", option, value, wanted);
    return EXIT_USAGE;
}

static int read_whole(const char *text, uint64_t max, uint64_t *out) {
    char *end;
    errno = 0;
    unsigned long long value = strtoull(text, &end, 0);
    if (errno || end == text || *end || *text == '-' || value > max)
        return -1;
    *out = value;
    return 0;
}

// Reads hex digits into at most ROOM bytes; returns their number, or -1.
static int read_hex(const char *text, uint8_t *out, size_t room) {
    size_t digits = strlen(text);
    if (digits == 0 || digits % 2 || digits / 2 > room || strspn(text, "0123456789abcdefABCDEF") != digits)
        return -1;
    for (size_t i = 0; i < digits / 2; i++) {
        char pair[3] = {text[2 * i], text[2 * i + 1], 0};
        out[i] = (uint8_t)strtoul(pair, NULL, 16);
    }
    return (int)(digits / 2);
}

static int read_number(struct options *options, int which, const char *text) {
    uint64_t value;
    switch (which) {
    case 'k':
        if (read_whole(text, UINT64_C(1) << 47, &options->start_clock))
            return refuse("--start-clock", text, "a number of ticks up to 2^47");
        return 0;
    case 'j':
        if (read_whole(text, 1000000, &value))
            return refuse("--jitter-us", text, "a number of microseconds up to 1000000");
        options->jitter_us = (uint32_t)value;
        return 0;
    case 'l':
        if (read_whole(text, 100000, &value))
            return refuse("--slice-us", text, "a number of microseconds up to 100000");
        options->slice_us = (uint32_t)value;
        return 0;
    default:
        if (read_whole(text, UINT64_MAX, &options->seed))
            return refuse("--seed", text, "a whole number");
        return 0;
    }
}

static int read_identity(struct options *options, int which, const char *text) {
    uint8_t chip_id[CHIP_ID_MAX];
    if (which == 'i') {
        if (read_hex(text, options->uuid, CAN_UUID_SIZE) != CAN_UUID_SIZE)
            return refuse("--uuid", text, "12 hex digits");
        return 0;
    }
    int size = read_hex(text, chip_id, sizeof(chip_id));
    if (size < 0)
        return refuse("--chip-id", text, "an even number of hex digits, 128 at most");
    can_uuid_from_chip_id(chip_id, (size_t)size, options->uuid);
    return 0;
}

static int read_rate(struct options *options, const char *text) {
    char *end;
    options->rate_ppm = strtod(text, &end);
    if (end == text || *end || !(options->rate_ppm > -100000 && options->rate_ppm < 100000))
        return refuse("--rate-ppm", text, "a number between -100000 and 100000");
    return 0;
}

static int read_option(struct options *options, int which, char *text) {
    switch (which) {
    case 'c':
        options->can = text;
        return 0;
    case 's':
        options->socketcan = text;
        return 0;
    case 'u':
        options->uart = text;
        return 0;
    case 'e':
        options->edge_log = text;
        return 0;
    case 'r':
        return read_rate(options, text);
    case 'i':
    case 'h':
        return read_identity(options, which, text);
    case '?':
        fputs(USAGE, stderr); // getopt has said what is wrong
        return EXIT_USAGE;
    default:
        return read_number(options, which, text);
    }
}

int options_parse(struct options *options, int argc, char **argv) {
    *options = (struct options){.slice_us = 500, .seed = 1, .start_clock = 0};
    int which;
    while ((which = getopt_long(argc, argv, "", OPTIONS, NULL)) != -1) {
        int status = read_option(options, which, optarg);
        if (status)
            return status;
    }
    int wires = (options->can != NULL) + (options->socketcan != NULL) + (options->uart != NULL);
    if (wires != 1 || optind != argc) {
        fprintf(stderr, "canductor-node: give exactly one of --can, --socketcan and --uart\n%s", USAGE);
        return EXIT_USAGE;
    }
    return 0;
}
