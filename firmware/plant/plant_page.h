// SPDX-License-Identifier: Apache-2.0
// The page: what a node's plant shows to others while it runs, and where they write faults for it.
//
// It is plain memory, perhaps shared between processes (a mapped file), without locks: one writer, the
// plant's own node; only `fault` is for others to write. Times are true time (of virtual processes:
// CLOCK_MONOTONIC) in ns. The layout is for programs on one computer, nodes/virtual/plant_page.py reads it.
#ifndef BOARDS_PLANT_PAGE_H
#define BOARDS_PLANT_PAGE_H

#include <stdatomic.h>
#include <stdint.h>

enum {
    PLANT_STEPPERS = 16,
    PLANT_ITEMS = 96,
    PLANT_NAME = 64,      // with the zero at its end
    PLANT_HISTORY = 4096, // steps of each stepper that can be looked up; a power of two
};

#define PLANT_MAGIC 0x31544E4C50444E43u // "CNDPLNT1"

enum plant_kind {
    PLANT_NOTHING,
    PLANT_BODY,
    PLANT_HEATER,
    PLANT_FAN,
    PLANT_SENSOR,
    PLANT_SWITCH,
    PLANT_TMC,
    PLANT_COIL,
    PLANT_LOAD_CELL,
};

// What can be wrong with an item, by its kind.
enum plant_fault {
    PLANT_SOUND,
    // A sensor's wire is broken, its wires touch, it fell out of its body and has the surroundings'
    // temperature.
    PLANT_OPEN,
    PLANT_SHORTED,
    PLANT_FALLEN,
    // A heater's transistor conducts for ever, a heater's or a fan's wire is broken (a fan: it is blocked).
    PLANT_STUCK_ON,
    PLANT_DEAD,
    // A switch never closes, or is closed for ever.
    PLANT_NEVER,
    PLANT_ALWAYS,
    // A driver's answers are damaged on the way; it is warm, or so hot that it switched off. OPEN: its UART
    // hangs on nothing. SHORTED: a coil is, it switched off. DEAD: the motors' supply is missing.
    PLANT_GARBLED,
    PLANT_WARM,
    PLANT_OVERHEATED,
    // A load cell: OPEN or DEAD, its chip makes no readings; SHORTED, they are at full scale; NEVER, it feels
    // nothing of the bed; GARBLED, its chip misses a pulse of each reading.
    // A coil: OPEN, its chip does not answer; DEAD, it makes no readings; SHORTED, it flags them as bad.
    // A switch stays as it is, of a BLTouch the pin; it closes a fifth of a millimetre late.
    PLANT_STUCK,
    PLANT_LATE,
};

struct plant_step {
    _Atomic uint64_t ns;   // when it was made
    _Atomic int64_t count; // where the stepper stood then
};

struct plant_page_stepper {
    char name[PLANT_NAME];
    _Atomic uint64_t head; // steps made in all; the newest is steps[(head - 1) % PLANT_HISTORY]
    _Atomic int64_t count; // where it stands now
    _Atomic uint64_t lost; // steps that moved nothing: driver off, or against a stop
    uint64_t reserved;
    struct plant_step steps[PLANT_HISTORY];
};

// value and extra are doubles, as bits: of a body °C; of a heater its duty (0..1) and the heat it gave (J);
// of a fan its duty and the turns it made; of a sensor the °C it has and what its converter last gave; of a
// switch whether it is pressed and how often it has switched; of a driver the time (ns) until which its DIAG
// is high when no step follows, and its SG_RESULT; of a coil the frequency of its last reading (Hz);
// of a load cell the force of its last one (g).
struct plant_page_item {
    char name[PLANT_NAME];
    uint32_t kind;
    _Atomic uint32_t fault;
    _Atomic uint64_t value, extra;
};

struct plant_page {
    _Atomic uint64_t magic; // written last: what has it is complete
    uint32_t stepper_count, item_count;
    _Atomic uint64_t horizon_ns; // all steps before it are in; UINT64_MAX: there will be none
    _Atomic uint64_t updated_ns; // when the items were true
    struct plant_page_item items[PLANT_ITEMS];
    struct plant_page_stepper steppers[PLANT_STEPPERS];
};

_Static_assert(sizeof(struct plant_page_item) == PLANT_NAME + 24, "plant_page.py reads it");
_Static_assert(sizeof(struct plant_page_stepper) == PLANT_NAME + 32 + 16 * PLANT_HISTORY,
               "plant_page.py reads it");

// Puts a step to the others.
void plant_page_step(struct plant_page_stepper *stepper, uint64_t ns, int64_t count);
// Where the stepper stood at NS; beyond its history, where that begins.
int64_t plant_page_count_at(struct plant_page_stepper *stepper, uint64_t ns);
double plant_page_load(const _Atomic uint64_t *bits);
void plant_page_store(_Atomic uint64_t *bits, double value);
// The number of the stepper or item NAME, -1: there is none.
int plant_page_find_stepper(const struct plant_page *page, const char *name);
int plant_page_find_item(const struct plant_page *page, enum plant_kind kind, const char *name);

#endif
