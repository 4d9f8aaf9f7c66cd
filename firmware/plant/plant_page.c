// SPDX-License-Identifier: Apache-2.0
// Reading and writing a page without locks: see plant_page.h.
#include "plant/plant_page.h"

#include <string.h>

enum {
    // Slots in front of the writer that a reader leaves alone: they may be overwritten while it looks.
    MARGIN = 64,
    READS_MAX = 8, // a reader that is overtaken so often takes what it has
};

void plant_page_step(struct plant_page_stepper *stepper, uint64_t ns, int64_t count) {
    uint64_t head = atomic_load_explicit(&stepper->head, memory_order_relaxed);
    struct plant_step *step = &stepper->steps[head % PLANT_HISTORY];
    atomic_store_explicit(&step->ns, ns, memory_order_relaxed);
    atomic_store_explicit(&step->count, count, memory_order_relaxed);
    atomic_store_explicit(&stepper->count, count, memory_order_relaxed);
    atomic_store_explicit(&stepper->head, head + 1, memory_order_release);
}

// Walks back from the newest step to the first that was made by NS. The slot before the oldest one holds, as
// good as any, where the history begins.
static int64_t walk_back(struct plant_page_stepper *stepper, uint64_t head, uint64_t ns) {
    uint64_t room = PLANT_HISTORY - MARGIN;
    uint64_t oldest = head > room ? head - room : 0;
    int64_t later = 0;
    for (uint64_t at = head; at > oldest; at--) {
        struct plant_step *step = &stepper->steps[(at - 1) % PLANT_HISTORY];
        int64_t count = atomic_load_explicit(&step->count, memory_order_relaxed);
        if (atomic_load_explicit(&step->ns, memory_order_relaxed) <= ns)
            return count;
        later = count;
    }
    // All steps known are later than NS. Before the very first one it stood at 0; that one may be overwritten
    // by now.
    atomic_thread_fence(memory_order_acquire);
    uint64_t now = atomic_load_explicit(&stepper->head, memory_order_relaxed);
    return oldest || now > PLANT_HISTORY ? later : 0;
}

int64_t plant_page_count_at(struct plant_page_stepper *stepper, uint64_t ns) {
    int64_t count = 0;
    for (unsigned i = 0; i < READS_MAX; i++) {
        uint64_t head = atomic_load_explicit(&stepper->head, memory_order_acquire);
        count = walk_back(stepper, head, ns);
        atomic_thread_fence(memory_order_acquire);
        if (atomic_load_explicit(&stepper->head, memory_order_relaxed) - head < MARGIN)
            break;
    }
    return count;
}

double plant_page_load(const _Atomic uint64_t *bits) {
    uint64_t raw = atomic_load_explicit(bits, memory_order_relaxed);
    double value;
    memcpy(&value, &raw, sizeof(value));
    return value;
}

void plant_page_store(_Atomic uint64_t *bits, double value) {
    uint64_t raw;
    memcpy(&raw, &value, sizeof(raw));
    atomic_store_explicit(bits, raw, memory_order_relaxed);
}

static int is_complete(const struct plant_page *page) {
    return atomic_load_explicit(&page->magic, memory_order_acquire) == PLANT_MAGIC;
}

int plant_page_find_stepper(const struct plant_page *page, const char *name) {
    if (!is_complete(page))
        return -1;
    for (uint32_t i = 0; i < page->stepper_count && i < PLANT_STEPPERS; i++)
        if (strncmp(page->steppers[i].name, name, PLANT_NAME) == 0)
            return (int)i;
    return -1;
}

int plant_page_find_item(const struct plant_page *page, enum plant_kind kind, const char *name) {
    if (!is_complete(page))
        return -1;
    for (uint32_t i = 0; i < page->item_count && i < PLANT_ITEMS; i++)
        if (page->items[i].kind == (uint32_t)kind && strncmp(page->items[i].name, name, PLANT_NAME) == 0)
            return (int)i;
    return -1;
}
