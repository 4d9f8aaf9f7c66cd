// SPDX-License-Identifier: Apache-2.0
// A stepper driver of the kind TMC2208 or TMC2209, after its data sheet: registers behind a UART, microsteps,
// and StallGuard4, which raises DIAG when the motor cannot follow.
//
// The motor follows its field up to an angle: where the axis stands against its stop the rotor stays and the
// field goes on. Two full steps further it slips: the rotor falls to the field's place four full steps back.
#include "plant/plant.h"

#include <math.h>
#include <string.h>

enum {
    // Registers by their addresses.
    GCONF = 0x00,
    GSTAT = 0x01,
    IFCNT = 0x02,
    SLAVECONF = 0x03,
    IOIN = 0x06,
    IHOLD_IRUN = 0x10,
    TSTEP = 0x12,
    TPWMTHRS = 0x13,
    TCOOLTHRS = 0x14,
    SGTHRS = 0x40,
    SG_RESULT = 0x41,
    MSCNT = 0x6A,
    CHOPCONF = 0x6C,
    DRV_STATUS = 0x6F,
    PWMCONF = 0x70,

    SYNC = 0x05,
    TO_HOST = 0xFF,
    WRITE = 0x80,
    ASK_SIZE = 4,
    WRITE_SIZE = 8,
    FRAME_BITS = 10,
    SYNC_EDGES = 4, // from the first edge to the fourth after it are four bits
    MICROSTEPS_MAX = 256,
    PINS_MICROSTEPS = 8, // MS1 and MS2 low
    SLIP_STEPS = 4,
    TSTEP_MAX = 0xFFFFF,
    CRC_POLYNOMIAL = 0x07,
};
static const double CLOCK_PER_NS = 0.012; // 12 MHz
static const double ROUNDING = 1e-6;      // of a count
static const uint64_t SYNC_NS_MAX = 2000000;

// ------------------------------------------------------------------------------------------------- registers

static uint32_t bits(uint32_t value, unsigned shift, unsigned count) {
    return value >> shift & ((1u << count) - 1);
}

static uint64_t since(uint64_t ns, uint64_t before) {
    return ns > before ? ns - before : 0;
}

static int is_off(const struct plant_tmc *tmc) {
    return tmc->fault == PLANT_DEAD || tmc->fault == PLANT_OVERHEATED || tmc->fault == PLANT_SHORTED ||
           bits(tmc->registers[CHOPCONF], 0, 4) == 0;
}

static uint32_t microsteps_of(const struct plant_tmc *tmc) {
    if (!bits(tmc->registers[GCONF], 7, 1))
        return PINS_MICROSTEPS;
    uint32_t mres = bits(tmc->registers[CHOPCONF], 24, 4);
    return mres > 8 ? 1u : (uint32_t)MICROSTEPS_MAX >> mres;
}

static void power_up(struct plant_tmc *tmc) {
    memset(tmc->registers, 0, sizeof(tmc->registers));
    tmc->registers[GCONF] = 0x101;
    tmc->registers[GSTAT] = 1;
    tmc->registers[IHOLD_IRUN] = 0x1F10;
    tmc->registers[CHOPCONF] = 0x10000053;
    tmc->registers[PWMCONF] = 0xC10D0024;
    tmc->sg_result = tmc->free_load;
}

// Clocks between two of the smallest microsteps, when the last step was the last one until NS.
static uint32_t tstep_at(const struct plant_tmc *tmc, uint64_t ns) {
    double waited = (double)since(ns, tmc->step_ns) / tmc->step_size * CLOCK_PER_NS;
    double clocks = tmc->tstep > waited ? tmc->tstep : waited;
    return clocks < TSTEP_MAX ? (uint32_t)clocks : TSTEP_MAX;
}

static uint32_t drv_status(const struct plant_tmc *tmc, uint64_t ns) {
    int stands = tstep_at(tmc, ns) >= TSTEP_MAX;
    uint32_t value = bits(tmc->registers[IHOLD_IRUN], stands ? 0 : 8, 5) << 16 | (uint32_t)stands << 31;
    if (!bits(tmc->registers[GCONF], 2, 1))
        value |= 1u << 30;
    if (tmc->fault == PLANT_WARM || tmc->fault == PLANT_OVERHEATED)
        value |= 1 | 1 << 8;
    if (tmc->fault == PLANT_OVERHEATED)
        value |= 1 << 1 | 7 << 9;
    if (tmc->fault == PLANT_SHORTED)
        value |= 1 << 2;
    return value;
}

static uint32_t read_register(const struct plant_tmc *tmc, uint8_t number, uint64_t ns) {
    switch (number) {
    case IFCNT:
        return tmc->written;
    case IOIN:
        return (uint32_t)(tmc->has_stallguard ? 0x21 : 0x20) << 24 | 1 << 6;
    case TSTEP:
        return tstep_at(tmc, ns);
    case SG_RESULT:
        return tmc->has_stallguard ? (uint32_t)tmc->sg_result : 0;
    case MSCNT:
        return (uint32_t)(tmc->field & 1023);
    case DRV_STATUS:
        return drv_status(tmc, ns);
    case GCONF:
    case GSTAT:
    case CHOPCONF:
    case PWMCONF:
        return tmc->registers[number];
    default:
        return 0; // write only
    }
}

static void write_register(struct plant_tmc *tmc, uint8_t number, uint32_t value) {
    tmc->written++;
    if (number == GSTAT)
        tmc->registers[GSTAT] &= ~value;
    else
        tmc->registers[number] = value;
}

// ------------------------------------------------------------------------------------------------------ DIAG

// Shows until when DIAG is high if no step follows: StallGuard acts in StealthChop, and between two speeds.
static void show(struct plant *plant, struct plant_tmc *tmc, uint64_t ns) {
    struct plant_page_item *item = &plant->page->items[plant->first_tmc + (int)(tmc - plant->tmcs)];
    const uint32_t *registers = tmc->registers;
    double until = 0;
    if (tmc->fault == PLANT_OVERHEATED || tmc->fault == PLANT_SHORTED)
        until = INFINITY;
    else if (tmc->has_stallguard && !is_off(tmc) && !bits(registers[GCONF], 2, 1) &&
             (uint32_t)tmc->sg_result <= 2 * bits(registers[SGTHRS], 0, 8)) {
        uint32_t slowest = bits(registers[TCOOLTHRS], 0, 20), fastest = bits(registers[TPWMTHRS], 0, 20);
        if (tmc->tstep <= slowest && tstep_at(tmc, ns) <= slowest && tmc->tstep > fastest)
            until = (double)tmc->step_ns + slowest * (double)tmc->step_size / CLOCK_PER_NS;
    }
    if (until > 0 && until != INFINITY && !tmc->stalled)
        plant_note(plant, ns, "stall", tmc->name, 1);
    tmc->stalled = until > 0;
    plant_page_store(&item->value, until);
    plant_page_store(&item->extra, tmc->sg_result);
}

int plant_diag_level(struct plant *plant, struct plant_diag *diag, uint64_t ns) {
    struct plant_page *page = plant->page;
    int found = diag->tmc.found;
    if (diag->tmc.peer >= 0) {
        if (plant->host.settle)
            plant->host.settle(plant->host.context, (unsigned)diag->tmc.peer, ns);
        page = plant->peers[diag->tmc.peer].page;
        found = plant_find(plant, &diag->tmc, PLANT_TMC);
        if (found < 0)
            return 0;
    } else {
        plant_tmc_look(plant, &plant->tmcs[found], ns);
        found += plant->first_tmc;
    }
    return (double)ns < plant_page_load(&page->items[found].value);
}

// ------------------------------------------------------------------------------------------------- datagrams

static uint8_t crc_of(const uint8_t *data, int size) {
    uint8_t crc = 0;
    for (int i = 0; i < size; i++) {
        uint8_t byte = data[i];
        for (int bit = 0; bit < 8; bit++, byte >>= 1)
            crc = (uint8_t)(crc << 1 ^ ((crc >> 7 ^ byte) & 1 ? CRC_POLYNOMIAL : 0));
    }
    return crc;
}

static double bit_ns(const struct plant_tmc *tmc) {
    return (double)(tmc->edge_ns[SYNC_EDGES] - tmc->edge_ns[0]) / SYNC_EDGES;
}

// The level at a time after the first edge, which is a falling one.
static int level_at(const struct plant_tmc *tmc, double ns_after) {
    int passed = 0;
    while (passed < tmc->edge_count && (double)(tmc->edge_ns[passed] - tmc->edge_ns[0]) <= ns_after)
        passed++;
    return passed % 2 == 0;
}

// Takes byte NUMBER of the datagram out of its edges; -1: its start or stop bit is none.
static int byte_at(const struct plant_tmc *tmc, int number) {
    int value = 0;
    for (int bit = 0; bit < FRAME_BITS; bit++)
        value |= level_at(tmc, (number * FRAME_BITS + bit + 0.5) * bit_ns(tmc)) << bit;
    return (value & 1) || !(value >> (FRAME_BITS - 1)) ? -1 : value >> 1 & 0xFF;
}

static void answer(struct plant_tmc *tmc, uint8_t number, uint64_t ns) {
    uint32_t value = read_register(tmc, number, ns);
    uint8_t *reply = tmc->reply;
    reply[0] = SYNC;
    reply[1] = TO_HOST;
    reply[2] = number;
    for (int i = 0; i < 4; i++)
        reply[3 + i] = (uint8_t)(value >> (24 - 8 * i));
    reply[7] = crc_of(reply, 7) ^ (tmc->fault == PLANT_GARBLED ? 0x10 : 0);
    // SENDDELAY: 8 bit times, and 16 more with each second of its values.
    const uint32_t bit_times = (bits(tmc->registers[SLAVECONF], 8, 4) / 2 * 2 + 1) * 8;
    const double delay = bit_times * bit_ns(tmc);
    tmc->reply_ns = ns + (uint64_t)delay;
    tmc->reply_bit_ns = bit_ns(tmc);
}

static void obey(struct plant *plant, struct plant_tmc *tmc, int size, uint64_t ns) {
    uint8_t data[WRITE_SIZE];
    for (int i = 0; i < size; i++) {
        int byte = byte_at(tmc, i);
        if (byte < 0)
            return;
        data[i] = (uint8_t)byte;
    }
    int deaf = tmc->fault == PLANT_DEAD || tmc->fault == PLANT_OPEN;
    if (deaf || bits(data[0], 0, 4) != SYNC || data[1] != tmc->address ||
        data[size - 1] != crc_of(data, size - 1))
        return;
    if (size == ASK_SIZE) {
        answer(tmc, data[2], ns);
        return;
    }
    uint32_t value = 0;
    for (int i = 3; i < 7; i++)
        value = value << 8 | data[i];
    write_register(tmc, data[2] & ~WRITE & 0xFF, value);
    show(plant, tmc, ns);
}

// Takes a datagram that is over by NS; its end shows in nothing but the time.
static void take_datagram(struct plant *plant, struct plant_tmc *tmc, uint64_t ns) {
    if (!tmc->edge_count)
        return;
    uint64_t elapsed = since(ns, tmc->edge_ns[0]);
    if (tmc->edge_count <= SYNC_EDGES) {
        if (elapsed > SYNC_NS_MAX)
            tmc->edge_count = 0;
        return;
    }
    double bit = bit_ns(tmc);
    if ((double)elapsed < (3 * FRAME_BITS - 0.5) * bit)
        return;
    int number = byte_at(tmc, 2);
    int size = number >= 0 && number & WRITE ? WRITE_SIZE : ASK_SIZE;
    if ((double)elapsed < (size * FRAME_BITS - 0.5) * bit)
        return;
    obey(plant, tmc, size, tmc->edge_ns[0] + (uint64_t)(size * FRAME_BITS * bit));
    tmc->edge_count = 0;
}

void plant_tmc_line(struct plant *plant, struct plant_tmc *tmc, uint64_t ns, int level) {
    plant_tmc_look(plant, tmc, ns);
    if (level == tmc->line)
        return;
    tmc->line = level;
    if (tmc->edge_count || !level)
        tmc->edge_ns[tmc->edge_count++] = ns;
    if (tmc->edge_count == PLANT_TMC_EDGES)
        tmc->edge_count = 0; // no datagram has so many
}

int plant_tmc_answer(struct plant *plant, struct plant_tmc *tmc, uint64_t ns) {
    plant_tmc_look(plant, tmc, ns);
    if (!tmc->reply_ns || ns < tmc->reply_ns)
        return tmc->line;
    int at = (int)((double)(ns - tmc->reply_ns) / tmc->reply_bit_ns);
    if (at >= WRITE_SIZE * FRAME_BITS) {
        tmc->reply_ns = 0;
        return tmc->line;
    }
    int bit = at % FRAME_BITS;
    return bit == 0 ? 0 : bit == FRAME_BITS - 1 ? 1 : tmc->reply[at / FRAME_BITS] >> (bit - 1) & 1;
}

// --------------------------------------------------------------------------------------------------- motion

static int64_t floor_divide(int64_t a, int64_t b) {
    return a / b - (a % b < 0);
}

// Where the rotor would be if nothing held it, in the counts of its stepper.
static int64_t wanted(const struct plant_tmc *tmc) {
    return floor_divide(tmc->field * tmc->microsteps, MICROSTEPS_MAX);
}

// What the motors of AXIS want, and in STIFFNESS how much of the axis' way each count of them is worth.
static double wanted_place(struct plant *plant, struct plant_axis *axis, uint64_t ns, double *stiffness) {
    double place = axis->origin;
    for (int i = 0; i < axis->term_count; i++) {
        struct plant_term *term = &axis->terms[i];
        int number = term->stepper.peer < 0 ? plant->steppers[term->stepper.found].tmc : -1;
        if (number < 0) {
            place += term->mm * (double)plant_term_count(plant, term, ns);
            continue;
        }
        place += term->mm * (double)wanted(&plant->tmcs[number]);
        *stiffness += term->mm * term->mm;
    }
    return place;
}

// How many counts the stops hold a rotor back. Motors that move an axis together share it, as springs do.
static double held_back(struct plant *plant, const struct plant_tmc *tmc, uint64_t ns) {
    double counts = 0;
    for (int i = 0; i < plant->axis_count; i++) {
        struct plant_axis *axis = &plant->axes[i];
        double mm = 0, stiffness = 0;
        for (int t = 0; t < axis->term_count; t++)
            if (axis->terms[t].stepper.peer < 0 && axis->terms[t].stepper.found == tmc->stepper)
                mm = axis->terms[t].mm;
        if (mm == 0 || (isinf(axis->min) && isinf(axis->max)))
            continue;
        double place = wanted_place(plant, axis, ns, &stiffness);
        double beyond = place < axis->min ? axis->min - place : place > axis->max ? axis->max - place : 0;
        counts += beyond / stiffness * mm;
    }
    return counts;
}

// Lets all rotors go to where their fields and the stops have them.
static void follow(struct plant *plant, uint64_t ns) {
    for (int i = 0; i < plant->tmc_count; i++) {
        const struct plant_tmc *tmc = &plant->tmcs[i];
        struct plant_page_stepper *shown = &plant->page->steppers[tmc->stepper];
        double back = held_back(plant, tmc, ns);
        int64_t held = (int64_t)(back > 0 ? ceil(back - ROUNDING) : floor(back + ROUNDING));
        int64_t count = wanted(tmc) + held;
        if (count != atomic_load_explicit(&shown->count, memory_order_relaxed))
            plant_page_step(shown, ns, count);
    }
}

static int64_t lag_of(const struct plant *plant, const struct plant_tmc *tmc) {
    return wanted(tmc) -
           atomic_load_explicit(&plant->page->steppers[tmc->stepper].count, memory_order_relaxed);
}

static void slip(struct plant *plant, uint64_t ns) {
    for (int i = 0; i < plant->tmc_count; i++) {
        struct plant_tmc *tmc = &plant->tmcs[i];
        int64_t lag = lag_of(plant, tmc), most = (int64_t)2 * tmc->microsteps;
        if (lag < most && lag > -most)
            continue;
        plant_steps_lost(plant, ns, tmc->stepper, (uint64_t)SLIP_STEPS * (uint64_t)tmc->microsteps);
        tmc->field -= (int64_t)(lag > 0 ? SLIP_STEPS : -SLIP_STEPS) * MICROSTEPS_MAX;
        follow(plant, ns);
    }
}

void plant_tmc_step(struct plant *plant, struct plant_tmc *tmc, uint64_t ns, int direction) {
    plant_tmc_look(plant, tmc, ns);
    if (is_off(tmc)) {
        plant_steps_lost(plant, ns, tmc->stepper, 1);
        return;
    }
    tmc->step_size = (int)(MICROSTEPS_MAX / microsteps_of(tmc));
    tmc->tstep = (double)since(ns, tmc->step_ns) / tmc->step_size * CLOCK_PER_NS;
    tmc->step_ns = ns;
    int64_t full_step = floor_divide(tmc->field, MICROSTEPS_MAX);
    tmc->field += (int64_t)(bits(tmc->registers[GCONF], 3, 1) ? -direction : direction) * tmc->step_size;
    follow(plant, ns);
    if (floor_divide(tmc->field, MICROSTEPS_MAX) != full_step) {
        double load = fabs((double)lag_of(plant, tmc)) / tmc->microsteps; // 1: a full step behind
        tmc->sg_result = load < 1 ? tmc->free_load * (1 - load) : 0;
    }
    slip(plant, ns);
    show(plant, tmc, ns);
}

int plant_tmc_both_edges(const struct plant_tmc *tmc) {
    return (int)bits(tmc->registers[CHOPCONF], 29, 1);
}

// ------------------------------------------------------------------------------------------------------ life

void plant_tmc_look(struct plant *plant, struct plant_tmc *tmc, uint64_t ns) {
    take_datagram(plant, tmc, ns);
    struct plant_page_item *item = &plant->page->items[plant->first_tmc + (int)(tmc - plant->tmcs)];
    uint32_t fault = atomic_load_explicit(&item->fault, memory_order_relaxed);
    if (fault == tmc->fault)
        return;
    if (tmc->fault == PLANT_DEAD)
        power_up(tmc);
    tmc->fault = fault;
    if (fault == PLANT_OVERHEATED || fault == PLANT_SHORTED)
        tmc->registers[GSTAT] |= 1 << 1;
    plant_note(plant, ns, "fault", tmc->name, fault);
    show(plant, tmc, ns);
}

void plant_tmc_start(struct plant *plant, struct plant_tmc *tmc, uint64_t ns) {
    power_up(tmc);
    tmc->line = 1;
    tmc->step_ns = ns;
    tmc->step_size = MICROSTEPS_MAX / PINS_MICROSTEPS;
    tmc->tstep = TSTEP_MAX;
    int64_t count = atomic_load_explicit(&plant->page->steppers[tmc->stepper].count, memory_order_relaxed);
    tmc->field = count * MICROSTEPS_MAX / tmc->microsteps;
    show(plant, tmc, ns);
}
