// SPDX-License-Identifier: Apache-2.0
// A BLTouch by its data sheet: what the pulses of its control pin mean, where its pin is, what its sensor
// shows.
#include "plant/plant.h"

static const uint64_t MOVE_NS = 300000000;  // of the pin, up or down
static const uint64_t TOUCH_NS = 10000000;  // how long a touch is shown
static const uint64_t TOLERANCE_NS = 20000; // of a pulse
static const double PUSHED_IN = 1e-9;

enum command { NONE, PIN_DOWN, TOUCH_MODE, PIN_UP, SELF_TEST, STORE, MODE_5V, MODE_OD, RESET };

static int command_of(uint64_t ns) {
    static const struct {
        uint64_t ns;
        int command;
    } known[] = {
        {647000, PIN_DOWN}, {1162000, TOUCH_MODE}, {1475000, PIN_UP},  {1782000, SELF_TEST},
        {1884000, STORE},   {1988000, MODE_5V},    {2091000, MODE_OD}, {2194000, RESET},
    };
    for (size_t i = 0; i < sizeof(known) / sizeof(*known); i++)
        if (ns + TOLERANCE_NS >= known[i].ns && ns <= known[i].ns + TOLERANCE_NS)
            return known[i].command;
    return NONE;
}

// Lets the pin arrive. One that does not come out is an alarm.
static void arrive(struct plant *plant, struct plant_switch *it, uint64_t ns, int is_stuck) {
    struct plant_bltouch *touch = &it->bltouch;
    if (ns < touch->moved_ns || touch->out == touch->lowers)
        return;
    if (touch->lowers && (is_stuck || plant_probe_depth(plant, it, ns) > PUSHED_IN)) {
        touch->lowers = 0;
        touch->alarm = 1;
    } else if (!is_stuck) {
        touch->out = touch->lowers;
    }
}

static void act(struct plant_bltouch *touch, int command, uint64_t ns) {
    touch->command = command;
    if (command == RESET || command == SELF_TEST)
        touch->alarm = 0;
    if (command == TOUCH_MODE)
        touch->touch_mode = 1;
    if (touch->alarm || command == TOUCH_MODE || (command >= STORE && command <= MODE_OD))
        return;
    if (command != RESET) // a reset leaves touch mode as it is
        touch->touch_mode = 0;
    touch->lowers = command == PIN_DOWN;
    touch->moved_ns = ns + MOVE_NS;
}

void plant_bltouch_edge(struct plant *plant, struct plant_switch *it, uint64_t ns, int level) {
    struct plant_bltouch *touch = &it->bltouch;
    plant_switch_pressed(plant, it, ns);
    if (level) {
        touch->rise_ns = ns;
        return;
    }
    int heard = command_of(ns - touch->rise_ns);
    if (heard != NONE && heard == touch->heard && heard != touch->command) {
        plant_note(plant, ns, "bltouch", it->name, heard);
        act(touch, heard, ns);
    }
    touch->heard = heard;
}

int plant_bltouch_pressed(struct plant *plant, struct plant_switch *it, uint64_t ns, uint32_t fault) {
    struct plant_bltouch *touch = &it->bltouch;
    arrive(plant, it, ns, fault == PLANT_STUCK);
    if (touch->alarm)
        return 1;
    double needed = it->shift - (it->pressed ? it->hysteresis : 0.0) - PUSHED_IN;
    int pushed = touch->out && plant_probe_depth(plant, it, ns) >= needed;
    if (touch->touch_mode)
        return pushed || !touch->out;
    if (pushed && touch->lowers && fault != PLANT_STUCK) {
        touch->lowers = touch->out = 0; // it goes up by itself
        touch->pulse_ns = ns + TOUCH_NS;
    }
    return pushed || ns < touch->pulse_ns;
}
