// SPDX-License-Identifier: Apache-2.0
// sources: firmware/plant/plant*.c
// Steps are counted as drivers count them, endstops switch by steppers of several nodes, and a history that
// is written and read at the same time never gives a count that was not.
#include "plant/plant.h"
#include "tests/check.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

enum { STEP, DIR, ENABLE, FALLING, FALLING_DIR, BOTH, BOTH_DIR, SWITCH_PIN = 16, LOW_SWITCH_PIN = 17 };

static const char TEXT[] = "plant node=n seed=3\n"
                           "stepper name=a step=PA0 dir=PA1 enable=PA2 enable_inverted=1\n"
                           "stepper name=falling step=PA3 dir=PA4 step_inverted=1 dir_inverted=1\n"
                           "stepper name=both step=PA5 dir=PA6 both_edges=1\n"
                           "axis name=x origin=10 min=-0.5 max=12\n"
                           "term axis=x node=- stepper=both mm=0.01\n"
                           "switch name=x pin=PB0 axis=x at=0 direction=-1 hysteresis=0.1\n"
                           "switch name=far pin=PB1 axis=x at=11 direction=1 inverted=1\n";

struct rig {
    struct plant plant;
    struct plant_page page;
    uint64_t ns;
};

static struct rig *new_rig(const char *text) {
    char error[PLANT_ERROR] = "";
    struct rig *rig = calloc(1, sizeof(*rig));
    CHECK(rig);
    if (plant_read(&rig->plant, text, strlen(text), 4095, 32768, error)) {
        fprintf(stderr, "%s\n", error);
        CHECK(0);
    }
    plant_start(&rig->plant, &rig->page, 0);
    return rig;
}

static void set(struct rig *rig, uint32_t pin, int level) {
    plant_output(&rig->plant, ++rig->ns, pin, level);
}

static void steps_both(struct rig *rig, int count) {
    set(rig, BOTH_DIR, count > 0);
    for (int i = 0; i < abs(count); i++)
        set(rig, BOTH, !rig->plant.level[BOTH]);
}

static void step_at(struct rig *rig, uint64_t ns, int direction) {
    plant_output(&rig->plant, ns, BOTH_DIR, direction > 0);
    plant_output(&rig->plant, ns, BOTH, !rig->plant.level[BOTH]);
}

static int64_t count_of(struct rig *rig, const char *name) {
    return rig->page.steppers[plant_page_find_stepper(&rig->page, name)].count;
}

static int pressed(struct rig *rig, uint32_t pin) {
    return plant_input(&rig->plant, rig->ns, pin, 0);
}

static void test_drivers(void) {
    struct rig *rig = new_rig(TEXT);
    for (int i = 0; i < 3; i++) {
        set(rig, STEP, 1);
        set(rig, STEP, 1); // no change, no step
        set(rig, STEP, 0);
    }
    CHECK_EQUAL(count_of(rig, "a"), -3);
    set(rig, DIR, 1);
    set(rig, STEP, 1);
    CHECK_EQUAL(count_of(rig, "a"), -2);
    set(rig, ENABLE, 1); // off
    set(rig, STEP, 0);
    set(rig, STEP, 1);
    CHECK_EQUAL(count_of(rig, "a"), -2);
    CHECK_EQUAL(rig->page.steppers[0].lost, 1);

    set(rig, FALLING, 1);
    CHECK_EQUAL(count_of(rig, "falling"), 0);
    set(rig, FALLING, 0);
    CHECK_EQUAL(count_of(rig, "falling"), 1);
    set(rig, FALLING_DIR, 1);
    set(rig, FALLING, 1);
    set(rig, FALLING, 0);
    CHECK_EQUAL(count_of(rig, "falling"), 0);

    steps_both(rig, 7);
    steps_both(rig, -9);
    CHECK_EQUAL(count_of(rig, "both"), -2);
    CHECK_EQUAL(rig->page.steppers[2].head, 16);
    plant_reset(&rig->plant, rig->ns); // pins float, and are low again afterwards: no step
    set(rig, BOTH, 0);
    CHECK_EQUAL(count_of(rig, "both"), -2);
    free(rig);
}

static void test_a_switch_with_travel_and_stops(void) {
    struct rig *rig = new_rig(TEXT);
    CHECK(!pressed(rig, SWITCH_PIN));
    CHECK(pressed(rig, LOW_SWITCH_PIN)); // inverted: high is free
    steps_both(rig, -999);
    CHECK(!pressed(rig, SWITCH_PIN));
    steps_both(rig, -1);
    CHECK(pressed(rig, SWITCH_PIN));
    steps_both(rig, 10);
    CHECK(pressed(rig, SWITCH_PIN));
    steps_both(rig, 1);
    CHECK(!pressed(rig, SWITCH_PIN));
    steps_both(rig, -211); // the stop stands 50 steps behind the switch
    CHECK_EQUAL(count_of(rig, "both"), -1050);
    CHECK_EQUAL(rig->page.steppers[2].lost, 150);
    steps_both(rig, 1050 + 99);
    CHECK(pressed(rig, LOW_SWITCH_PIN));
    steps_both(rig, 1);
    CHECK(!pressed(rig, LOW_SWITCH_PIN));
    steps_both(rig, 200);
    CHECK_EQUAL(count_of(rig, "both"), 200);

    rig->page.items[plant_page_find_item(&rig->page, PLANT_SWITCH, "x")].fault = PLANT_ALWAYS;
    CHECK(pressed(rig, SWITCH_PIN));
    rig->page.items[plant_page_find_item(&rig->page, PLANT_SWITCH, "far")].fault = PLANT_NEVER;
    CHECK(pressed(rig, LOW_SWITCH_PIN)); // free, inverted
    free(rig);
}

static void test_two_switches_on_one_pin(void) {
    struct rig *rig = new_rig("plant node=n\n"
                              "stepper name=both step=PA5 dir=PA6 both_edges=1\n"
                              "axis name=x\nterm axis=x node=- stepper=both mm=1\n"
                              "switch name=low pin=PB0 axis=x at=-3 direction=-1 inverted=1\n"
                              "switch name=high pin=PB0 axis=x at=3 direction=1 inverted=1\n");
    CHECK(pressed(rig, SWITCH_PIN)); // free is high
    steps_both(rig, 3);
    CHECK(!pressed(rig, SWITCH_PIN));
    steps_both(rig, -5);
    CHECK(pressed(rig, SWITCH_PIN));
    steps_both(rig, -1);
    CHECK(!pressed(rig, SWITCH_PIN));
    free(rig);
}

// A bed 0.3 mm high, tilted along X and bowed; a frame that a step tilts by 0.0001 along X.
static void test_a_bed_presses_the_probe(void) {
    struct rig *rig =
        new_rig("plant node=n\n"
                "stepper name=both step=PA5 dir=PA6 both_edges=1\n"
                "axis name=x origin=60\n"
                "axis name=y origin=40\n"
                "axis name=z origin=2.5\n"
                "term axis=z node=- stepper=both mm=0.01\n"
                "axis name=slope origin=0.001\n"
                "term axis=slope node=- stepper=both mm=0.0001\n"
                "bed name=bed z=0.3 x0=50 y0=50 tilt_x=0.01 bow=0.2 radius=100\n"
                "probe name=p pin=PB0 bed=bed x=x y=y z=z slope_x=slope offset_x=10 offset_y=-20 "
                "offset_z=1.5 hysteresis=0.03\n");
    // At the probe, x = 70 and y = 20: the bed is at 0.3 + 0.2 + 0.2·(1 - 0.13) = 0.674, so that it is
    // pressed at 2.174; the frame is at 2.57 + 0.017 a step there.
    steps_both(rig, -23);
    CHECK(!pressed(rig, SWITCH_PIN));
    steps_both(rig, -1);
    CHECK(pressed(rig, SWITCH_PIN));
    steps_both(rig, 1); // 2.179 is within the hysteresis
    CHECK(pressed(rig, SWITCH_PIN));
    steps_both(rig, 2);
    CHECK(!pressed(rig, SWITCH_PIN));
    rig->page.items[rig->plant.first_switch].fault = PLANT_ALWAYS;
    CHECK(pressed(rig, SWITCH_PIN));
    free(rig);
}

// The same bow of 0.2 mm, and 0.005 mm for each of the 20 K by which the body is warmer than the ambient.
static void test_a_warm_bed_bows(void) {
    struct rig *rig = new_rig("plant node=n\n"
                              "axis name=x origin=60\n"
                              "axis name=z origin=2\n"
                              "body name=plate capacity=1 loss=0 start=45\n"
                              "bed name=bed x0=50 bow=0.2 radius=100 body=plate warm_bow=0.005\n"
                              "probe name=p pin=PB0 bed=bed x=x y=x z=z offset_y=-60\n");
    double depth = plant_probe_depth(&rig->plant, &rig->plant.switches[0], 0);
    CHECK(fabs(depth - (0.3 * (1 - 0.01) - 2)) < 1e-9);
    free(rig);
}

// A delta whose rods and towers are all different; a step of one joint moves its nozzle sideways, too.
static void test_rods_hold_the_nozzle_of_a_delta(void) {
    struct rig *rig = new_rig("plant node=n\n"
                              "stepper name=both step=PA5 dir=PA6 both_edges=1\n"
                              "axis name=a origin=231.4534963619511\n"
                              "axis name=b origin=249.07925552553186\n"
                              "axis name=c origin=226.7409216035368\n"
                              "term axis=c node=- stepper=both mm=0.001\n"
                              "delta name=d a=a b=b c=c ax=-87 ay=-50 bx=88 by=-51 cx=1 cy=102 "
                              "rod_a=250 rod_b=260 rod_c=255\n"
                              "bed name=bed tilt_x=0.5 tilt_y=-0.25\n"
                              "probe name=p pin=PB0 bed=bed delta=d offset_x=2 offset_y=1\n");
    double heights[3], nozzle[3];
    for (int i = 0; i < 3; i++)
        heights[i] = plant_axis_position(&rig->plant, &rig->plant.axes[i], 0);
    plant_delta_nozzle(&rig->plant.deltas[0], heights, nozzle);
    const double wanted[3] = {10, -20, 3};
    for (int i = 0; i < 3; i++)
        CHECK(fabs(nozzle[i] - wanted[i]) < 1e-9);
    // The bed is at 6 - (-4.75) = 10.75 there: it presses until the nozzle is that high.
    CHECK(fabs(plant_probe_depth(&rig->plant, &rig->plant.switches[0], 0) - 7.75) < 1e-9);
    steps_both(rig, 1000);
    heights[2] += 1;
    plant_delta_nozzle(&rig->plant.deltas[0], heights, nozzle);
    for (int i = 0; i < 3; i++) {
        double x = rig->plant.deltas[0].x[i] - nozzle[0], y = rig->plant.deltas[0].y[i] - nozzle[1];
        double rod = rig->plant.deltas[0].rod[i], z = heights[i] - nozzle[2];
        CHECK(fabs(x * x + y * y + z * z - rod * rod) < 1e-6 && z > 0);
    }
    double bed = 0.5 * (nozzle[0] + 2) - 0.25 * (nozzle[1] + 1);
    CHECK(fabs(plant_probe_depth(&rig->plant, &rig->plant.switches[0], rig->ns) - (bed - nozzle[2])) < 1e-9);
    free(rig);
}

static void test_noise_moves_the_switch_between_approaches(void) {
    struct rig *rig = new_rig("plant node=n seed=3\n"
                              "stepper name=both step=PA5 dir=PA6 both_edges=1\n"
                              "axis name=x\nterm axis=x node=- stepper=both mm=0.001\n"
                              "switch name=x pin=PB0 axis=x at=0 direction=-1 noise=0.02\n");
    int64_t least = 1000, most = -1000;
    steps_both(rig, 100);
    for (int i = 0; i < 200; i++) {
        while (!pressed(rig, SWITCH_PIN))
            steps_both(rig, -1);
        int64_t at = count_of(rig, "both");
        least = at < least ? at : least;
        most = at > most ? at : most;
        CHECK(pressed(rig, SWITCH_PIN)); // within an approach it stays where it is
        while (pressed(rig, SWITCH_PIN))
            steps_both(rig, 1);
        steps_both(rig, 60);
    }
    CHECK(least >= -21 && least < -15 && most <= 20 && most > 15);
    free(rig);
}

// A corexy whose motors are on two other nodes: x = (a + b) / 2.
static void test_an_axis_of_two_other_nodes(void) {
    static const char motor[] = "plant node=%c\nstepper name=m step=PA5 dir=PA6 both_edges=1\n";
    struct rig *rig = new_rig("plant node=n\naxis name=x origin=1\n"
                              "term axis=x node=a stepper=m mm=0.005\nterm axis=x node=b stepper=m mm=0.005\n"
                              "switch name=x pin=PB0 axis=x at=0 direction=-1\n");
    char text[sizeof(motor)];
    struct rig *motors[2];
    CHECK(!plant_input(&rig->plant, 5000, SWITCH_PIN, 0)); // nobody there: it stays where it began
    for (int i = 0; i < 2; i++) {
        snprintf(text, sizeof(text), motor, 'a' + i);
        motors[i] = new_rig(text);
        rig->plant.peers[i].page = &motors[i]->page;
    }
    for (uint64_t ns = 1001; ns <= 1300; ns++) { // a down by 300; from its 151st step on b goes up: x stays
        step_at(motors[0], ns, -1);
        if (ns > 1150)
            step_at(motors[1], ns, 1);
        CHECK(!plant_input(&rig->plant, ns, SWITCH_PIN, 0));
    }
    for (uint64_t ns = 2001; ns <= 2100; ns++) // b down again: a + b = -200 at 2050
        step_at(motors[1], ns, -1);
    // Both are ahead of who looks; it sees what was.
    CHECK(!plant_input(&rig->plant, 2049, SWITCH_PIN, 0));
    CHECK(plant_input(&rig->plant, 2050, SWITCH_PIN, 0));
    CHECK(!plant_input(&rig->plant, 1300, SWITCH_PIN, 0));
    CHECK(plant_input(&rig->plant, 5000, SWITCH_PIN, 0));
    for (int i = 0; i < 2; i++)
        free(motors[i]);
    free(rig);
}

static void test_history_wraps(void) {
    struct plant_page_stepper *stepper = calloc(1, sizeof(*stepper));
    CHECK(stepper);
    CHECK_EQUAL(plant_page_count_at(stepper, 5), 0);
    for (int64_t i = 1; i <= 3 * PLANT_HISTORY; i++)
        plant_page_step(stepper, 10 * (uint64_t)i, -i);
    uint64_t last = 10 * 3 * PLANT_HISTORY;
    CHECK_EQUAL(plant_page_count_at(stepper, UINT64_MAX), -3 * PLANT_HISTORY);
    CHECK_EQUAL(plant_page_count_at(stepper, last - 1), -(3 * PLANT_HISTORY - 1));
    CHECK_EQUAL(plant_page_count_at(stepper, last - 30001), -(3 * PLANT_HISTORY - 3001));
    CHECK(plant_page_count_at(stepper, 0) < -2 * PLANT_HISTORY); // beyond: where the history begins
    free(stepper);
}

static void test_a_new_process_finds_the_machine_where_it_was(void) {
    struct rig *rig = new_rig(TEXT);
    char error[PLANT_ERROR];
    steps_both(rig, 5);
    CHECK(!plant_read(&rig->plant, TEXT, strlen(TEXT), 4095, 32768, error));
    plant_start(&rig->plant, &rig->page, 100);
    CHECK_EQUAL(count_of(rig, "both"), 5);
    static const char other[] = "plant node=n\nstepper name=new step=PA5 dir=PA6\n";
    CHECK(!plant_read(&rig->plant, other, strlen(other), 4095, 32768, error));
    plant_start(&rig->plant, &rig->page, 100);
    CHECK_EQUAL(count_of(rig, "new"), 0);
    free(rig);
}

// ------------------------------------------------------------------------------------------ two processes

enum { WRITTEN = 2000000 };

static void *write_steps(void *argument) {
    for (int64_t i = 1; i <= WRITTEN; i++)
        plant_page_step(argument, (uint64_t)i, 3 * i); // the count tells the time
    return NULL;
}

static void test_reading_while_it_is_written(void) {
    struct plant_page_stepper *stepper = calloc(1, sizeof(*stepper));
    CHECK(stepper);
    pthread_t writer;
    CHECK(!pthread_create(&writer, NULL, write_steps, stepper));
    uint64_t head = 0, looks = 0;
    while (head < WRITTEN) {
        head = atomic_load_explicit(&stepper->head, memory_order_acquire);
        uint64_t ns = head > 100 ? head - 100 : head;
        int64_t count = plant_page_count_at(stepper, ns);
        // The writer may be far ahead when this comes to look; then it is the oldest that is known.
        CHECK(count % 3 == 0 && count >= 3 * (int64_t)ns && count <= 3 * (int64_t)WRITTEN);
        uint64_t now = atomic_load_explicit(&stepper->head, memory_order_acquire);
        if (now - head < PLANT_HISTORY / 2)
            CHECK_EQUAL(count, 3 * (int64_t)ns);
        looks++;
    }
    CHECK(looks > 0);
    pthread_join(writer, NULL);
    free(stepper);
}

int main(void) {
    test_drivers();
    test_a_switch_with_travel_and_stops();
    test_two_switches_on_one_pin();
    test_a_bed_presses_the_probe();
    test_a_warm_bed_bows();
    test_rods_hold_the_nozzle_of_a_delta();
    test_noise_moves_the_switch_between_approaches();
    test_an_axis_of_two_other_nodes();
    test_history_wraps();
    test_a_new_process_finds_the_machine_where_it_was();
    test_reading_while_it_is_written();
    return 0;
}
