// SPDX-License-Identifier: Apache-2.0
// The counters that instrumented sources set (c_source.py); a program writes them at its end.
#include <stdio.h>
#include <stdlib.h>

#ifndef MUTATION_HITS
#error "MUTATION_HITS is the number of statements"
#endif

unsigned char mutation_hits[MUTATION_HITS];

__attribute__((destructor)) static void write_hits(void) {
    const char *path = getenv("MUTATION_HITS_FILE");
    FILE *file = path ? fopen(path, "wb") : NULL;
    if (!file)
        return;
    fwrite(mutation_hits, 1, sizeof(mutation_hits), file);
    fclose(file);
}
