// SPDX-License-Identifier: Apache-2.0
// sources: firmware/plant/plant*.c
// A BLTouch: two equal pulses are a command, its pin goes down and up, its touch and its alarm are shown.
#include "plant/plant.h"
#include "tests/check.h"

#include <stdlib.h>
#include <string.h>

enum {
    STEP,
    DIR,
    CONTROL = 2,
    SENSOR = 16,
    MS = 1000000,
    DOWN = 647,
    TOUCH_MODE = 1162,
    UP = 1475,
    SELF_TEST = 1782,
    RESET = 2194,
};

// The nozzle begins 2 mm above where its pin, when it is down, touches the bed.
static const char TEXT[] = "plant node=n\n"
                           "stepper name=a step=PA0 dir=PA1\n"
                           "axis name=x\n"
                           "axis name=z origin=3\n"
                           "term axis=z node=- stepper=a mm=0.5\n"
                           "bed name=bed\n"
                           "probe name=p pin=PB0 control=PA2 bed=bed x=x y=x z=z offset_z=1\n";

struct rig {
    struct plant plant;
    struct plant_page page;
    uint64_t ns;
};

static struct rig *new_rig(void) {
    char error[PLANT_ERROR] = "";
    struct rig *rig = calloc(1, sizeof(*rig));
    CHECK(rig);
    CHECK(!plant_read(&rig->plant, TEXT, strlen(TEXT), 4095, 32768, error));
    plant_start(&rig->plant, &rig->page, 0);
    rig->ns = MS;
    return rig;
}

static void pulse(struct rig *rig, unsigned us) {
    plant_output(&rig->plant, rig->ns, CONTROL, 1);
    plant_output(&rig->plant, rig->ns + us * 1000, CONTROL, 0);
    rig->ns += 20 * MS;
}

static void command(struct rig *rig, unsigned us) {
    for (int i = 0; i < 20; i++)
        pulse(rig, us);
}

static int is_triggered(struct rig *rig) {
    return plant_input(&rig->plant, rig->ns, SENSOR, 0);
}

// Moves the nozzle by so many halves of a millimetre.
static void move(struct rig *rig, int halves) {
    plant_output(&rig->plant, rig->ns, DIR, halves > 0);
    for (int i = 0; i < abs(halves); i++) {
        plant_output(&rig->plant, ++rig->ns, STEP, 1);
        plant_output(&rig->plant, ++rig->ns, STEP, 0);
    }
}

static void test_a_touch_is_a_pulse_and_the_pin_goes_up(struct rig *rig) {
    command(rig, DOWN);
    CHECK(!is_triggered(rig));
    move(rig, -4);
    CHECK(is_triggered(rig));
    rig->ns += 9 * MS;
    CHECK(is_triggered(rig));
    rig->ns += 2 * MS;
    CHECK(!is_triggered(rig)); // though the nozzle is as low
    command(rig, DOWN);        // is being done
    CHECK(!is_triggered(rig));
    command(rig, TOUCH_MODE);
    CHECK(is_triggered(rig)); // the pin is up
}

static void test_touch_mode_shows_where_the_pin_is(struct rig *rig) {
    command(rig, TOUCH_MODE);
    CHECK(is_triggered(rig));
    command(rig, DOWN);
    command(rig, TOUCH_MODE);
    CHECK(!is_triggered(rig));
    move(rig, -4);
    CHECK(is_triggered(rig));
    rig->ns += 100 * MS;
    CHECK(is_triggered(rig)); // as long as it lasts
    move(rig, 1);
    CHECK(!is_triggered(rig));
    command(rig, UP);
    CHECK(!is_triggered(rig)); // no touch mode any more
}

static void test_a_pin_that_cannot_come_out_is_an_alarm_until_a_reset(struct rig *rig) {
    move(rig, -5);
    command(rig, DOWN);
    CHECK(is_triggered(rig));
    move(rig, 5);
    command(rig, UP);
    CHECK(is_triggered(rig));
    command(rig, RESET);
    CHECK(!is_triggered(rig));
    command(rig, DOWN);
    CHECK(!is_triggered(rig));
    atomic_store(&rig->page.items[rig->plant.first_switch].fault, PLANT_STUCK);
    command(rig, UP);
    command(rig, TOUCH_MODE);
    CHECK(!is_triggered(rig)); // the pin stayed down
    atomic_store(&rig->page.items[rig->plant.first_switch].fault, PLANT_SOUND);
    command(rig, SELF_TEST);
    command(rig, TOUCH_MODE);
    CHECK(is_triggered(rig));
}

static void test_single_and_unknown_pulses_are_no_commands(struct rig *rig) {
    pulse(rig, DOWN);
    for (int i = 0; i < 20; i++)
        pulse(rig, i % 2 ? DOWN + 15 : 900); // never two of them in turn
    move(rig, -4);
    CHECK(!is_triggered(rig));
}

static void test_it_takes_a_while_to_come_out(struct rig *rig) {
    pulse(rig, DOWN);
    pulse(rig, DOWN);
    move(rig, -4);
    CHECK(!is_triggered(rig));
    move(rig, 4);
    command(rig, DOWN);
    move(rig, -4);
    CHECK(is_triggered(rig));
}

int main(void) {
    void (*tests[])(struct rig *) = {
        test_a_touch_is_a_pulse_and_the_pin_goes_up,
        test_touch_mode_shows_where_the_pin_is,
        test_a_pin_that_cannot_come_out_is_an_alarm_until_a_reset,
        test_single_and_unknown_pulses_are_no_commands,
        test_it_takes_a_while_to_come_out,
    };
    for (size_t i = 0; i < sizeof(tests) / sizeof(*tests); i++) {
        struct rig *rig = new_rig();
        tests[i](rig);
        free(rig);
    }
    return 0;
}
