// SPDX-License-Identifier: Apache-2.0
// acker FD can|bytes: the far end of bench/link.py, a process as a real node is.
#include "bench/acker.h"

#include <stdlib.h>

int main(int argc, char **argv) {
    static struct acker acker;
    if (argc != 3)
        return 2;
    acker.fd = atoi(argv[1]);
    acker.can = strcmp(argv[2], "can") == 0;
    acker_run(&acker);
    return 0;
}
