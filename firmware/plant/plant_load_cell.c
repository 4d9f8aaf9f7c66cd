// SPDX-License-Identifier: Apache-2.0
// A load cell that carries the nozzle, with its HX711 or HX717 on two pins (their data sheets): DOUT is low
// while a conversion waits, each pulse of SCLK shifts out a bit of it, and DOUT is high after the last one.
//
// The force is stiffness times how deep the nozzle is pressed into the bed; a conversion has its mean over
// its period. A chip sleeps when SCLK is high for 60 us; this one after SLEEP_NS, as the computer of a
// virtual node may interrupt it for longer.
#include "plant/plant.h"

#include <math.h>

// What follows the bits of a reading chooses the next one: channel A at full gain, channel B, which is not
// connected, A at half gain, and B again.
static const double GAINS[] = {1, 0, 0.5, 0};
enum { BITS = 24, LEAST_PULSES = 25, SETTLE_PERIODS = 4, POINTS = 8, MISSED = 12 };
static const uint64_t SLEEP_NS = 500000;
static const double FULL_SCALE = 8388607.0, NS_PER_S = 1e9;

static uint32_t fault_of(const struct plant *plant, const struct plant_load_cell *cell) {
    int item = plant->first_load_cell + (int)(cell - plant->load_cells);
    return atomic_load_explicit(&plant->page->items[item].fault, memory_order_relaxed);
}

static double period_ns(const struct plant_load_cell *cell) {
    return NS_PER_S / cell->rate;
}

// When conversion NTH, from 1 on, is there.
static uint64_t made_ns(const struct plant_load_cell *cell, uint64_t nth) {
    return cell->woken_ns + (uint64_t)(((double)nth + SETTLE_PERIODS - 1) * period_ns(cell));
}

// How many conversions have been made since it woke.
static uint64_t made(const struct plant *plant, const struct plant_load_cell *cell, uint64_t ns) {
    uint32_t fault = fault_of(plant, cell);
    if (fault == PLANT_DEAD || fault == PLANT_OPEN)
        return cell->taken;
    double periods = (double)(int64_t)(ns - cell->woken_ns) / period_ns(cell) - SETTLE_PERIODS + 1;
    return periods < 1 ? 0 : (uint64_t)periods;
}

static int is_asleep(const struct plant *plant, const struct plant_load_cell *cell, uint64_t ns) {
    return plant->level[cell->sclk_pin] && ns - cell->rise_ns > SLEEP_NS;
}

static double force(struct plant *plant, const struct plant_load_cell *cell, uint64_t ns) {
    double depth = cell->place.bed < 0 ? 0 : plant_probe_depth_at(plant, &cell->place, ns);
    double seconds = (double)(int64_t)(ns - cell->start_ns) / NS_PER_S;
    double pressed = fault_of(plant, cell) == PLANT_NEVER ? 0 : fmax(depth, 0) * cell->stiffness;
    return pressed + cell->drift * seconds + cell->hum * sin(2 * M_PI * cell->hum_hz * seconds);
}

// The counts of conversion NTH.
static int32_t conversion(struct plant *plant, struct plant_load_cell *cell, uint64_t nth) {
    uint64_t end = made_ns(cell, nth);
    double sum = 0;
    for (int i = 0; i < POINTS; i++)
        sum += force(plant, cell, end - (uint64_t)((i + 0.5) / POINTS * period_ns(cell)));
    double grams = sum / POINTS;
    plant_page_store(&plant->page->items[plant->first_load_cell + (int)(cell - plant->load_cells)].value,
                     grams);
    double counts = (cell->zero + grams * cell->counts_per_gram) * GAINS[cell->gain];
    counts += cell->noise * plant_normal(plant, (uint64_t)(cell - plant->load_cells) + 2000, nth);
    if (fault_of(plant, cell) == PLANT_SHORTED)
        counts = FULL_SCALE;
    return (int32_t)fmin(fmax(round(counts), -FULL_SCALE - 1), FULL_SCALE);
}

void plant_load_cell_edge(struct plant *plant, struct plant_load_cell *cell, uint64_t ns, int level) {
    if (!level) {
        if (ns - cell->rise_ns > SLEEP_NS) {
            cell->woken_ns = ns;
            cell->taken = 0;
            cell->pulses = cell->gain = 0;
        }
        return;
    }
    cell->rise_ns = ns;
    uint64_t count = made(plant, cell, ns);
    int is_ready = count > cell->taken;
    if (is_ready && (cell->pulses == 0 || cell->pulses >= LEAST_PULSES)) {
        cell->taken = count;
        if (cell->pulses > BITS)
            cell->gain = (cell->pulses - LEAST_PULSES) & 3;
        cell->shown = (uint32_t)conversion(plant, cell, count);
        cell->pulses = 0;
    } else if (cell->pulses == 0) {
        return; // there is nothing to shift
    }
    if (fault_of(plant, cell) == PLANT_GARBLED && cell->pulses == MISSED && !cell->missed) {
        cell->missed = 1;
        return;
    }
    cell->missed = 0;
    cell->pulses++;
}

int plant_load_cell_level(struct plant *plant, const struct plant_load_cell *cell, uint64_t ns) {
    if (is_asleep(plant, cell, ns) || fault_of(plant, cell) == PLANT_OPEN)
        return 1;
    if (cell->pulses >= 1 && cell->pulses <= BITS)
        return (int)(cell->shown >> (BITS - cell->pulses) & 1);
    return made(plant, cell, ns) <= cell->taken;
}
