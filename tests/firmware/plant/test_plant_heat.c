// SPDX-License-Identifier: Apache-2.0
// sources: firmware/plant/plant*.c
// Heat against a plain integration in small steps that shares nothing with it; sensors against their formula;
// faults; energy; what is no description.
#include "plant/plant.h"
#include "tests/check.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { BED_PIN = 1, HOT_PIN = 2, FAN_PIN = 3, BED_ADC = 16, HOT_ADC = 17, TACH_PIN = 18, ADC_MAX = 4095 };

static const uint64_t SECOND = 1000000000u, BEGIN = 0x4000000000000001u; // beyond what a double holds exactly

// A block with a cartridge in it and a sensor that lags, a part fan; a bed of its own.
static const char TEXT[] =
    "# a hotend and a bed\n"
    "plant node=toolhead seed=7 ambient=22\n"
    "body name=cartridge capacity=2.5 loss=0.001\n"
    "body name=block capacity=11 loss=0.09 start=40\n"
    "body name=bed capacity=400 loss=1.7\n"
    "couple a=cartridge b=block conductance=1.3\n"
    "fan name=part pin=PA3 rpm=5000 lag=0.4 tach=PB2 pulses=2\n"
    "cooling body=block node=- fan=part conductance=0.11\n"
    "heater name=hot pin=PA2 body=cartridge power=45\n"
    "heater name=bed pin=PA1 body=bed power=250 inverted=1\n"
    "sensor name=hot pin=PB1 node=- body=block lag=0.8 curve=beta pullup=4700 r0=100000 beta=4092\n"
    "sensor name=bed pin=PB0 node=- body=bed curve=steinhart pullup=4700 c1=0.7e-3 c2=2.2e-4 c3=1e-7 "
    "bits=16\n";

struct rig {
    struct plant plant;
    struct plant_page page;
};

static struct rig *new_rig(const char *text) {
    char error[PLANT_ERROR] = "";
    struct rig *rig = calloc(1, sizeof(*rig));
    CHECK(rig);
    if (plant_read(&rig->plant, text, strlen(text), ADC_MAX, 32768, error)) {
        fprintf(stderr, "%s\n", error);
        CHECK(0);
    }
    plant_start(&rig->plant, &rig->page, BEGIN);
    return rig;
}

static double value_of(struct rig *rig, enum plant_kind kind, const char *name) {
    int item = plant_page_find_item(&rig->page, kind, name);
    CHECK(item >= 0);
    return plant_page_load(&rig->page.items[item].value);
}

static double extra_of(struct rig *rig, enum plant_kind kind, const char *name) {
    int item = plant_page_find_item(&rig->page, kind, name);
    CHECK(item >= 0);
    return plant_page_load(&rig->page.items[item].extra);
}

static void set_fault(struct rig *rig, enum plant_kind kind, const char *name, enum plant_fault fault) {
    int item = plant_page_find_item(&rig->page, kind, name);
    CHECK(item >= 0);
    rig->page.items[item].fault = (uint32_t)fault;
}

static void check_near(double actual, double expected, double within) {
    if (!(fabs(actual - expected) <= within)) {
        fprintf(stderr, "%.9g, expected %.9g\n", actual, expected);
        CHECK(0);
    }
}

// ------------------------------------------------------------------------------------------ the other way

struct twin {
    double cartridge, block, bed, sensor, hot, fan; // hot and fan: duties
    double heat;
};

static void twin_slope(const struct twin *t, double bed_duty, double out[4]) {
    double over = 1.3 * (t->cartridge - t->block);
    out[0] = (45 * t->hot - 0.001 * (t->cartridge - 22) - over) / 2.5;
    out[1] = (over - (0.09 + 0.11 * t->fan) * (t->block - 22)) / 11;
    out[2] = (250 * bed_duty - 1.7 * (t->bed - 22)) / 400;
    out[3] = (t->block - t->sensor) / 0.8;
}

// Runge and Kutta, in steps of 1 ms.
static void twin_run(struct twin *t, double bed_duty, int milliseconds) {
    static const double part[4] = {0, 0.0005, 0.0005, 0.001}, weight[4] = {1, 2, 2, 1};
    for (int i = 0; i < milliseconds; i++) {
        double k[4] = {0}, sum[4] = {0};
        for (int s = 0; s < 4; s++) {
            struct twin at = *t;
            at.cartridge += part[s] * k[0];
            at.block += part[s] * k[1];
            at.bed += part[s] * k[2];
            at.sensor += part[s] * k[3];
            twin_slope(&at, bed_duty, k);
            for (int j = 0; j < 4; j++)
                sum[j] += weight[s] * k[j] * 0.001 / 6;
        }
        t->cartridge += sum[0];
        t->block += sum[1];
        t->bed += sum[2];
        t->sensor += sum[3];
        t->heat += 45 * t->hot * 0.001;
    }
}

static void test_against_small_steps(void) {
    struct rig *rig = new_rig(TEXT);
    struct twin twin = {.cartridge = 22, .block = 40, .bed = 22, .sensor = 40};
    uint64_t ns = BEGIN, state = 5;
    plant_output(&rig->plant, ns, BED_PIN, 0); // driven for the first time: inverted, so it is on
    for (int i = 0; i < 400; i++) {
        state = state * 6364136223846793005u + 1442695040888963407u;
        int milliseconds = 1 + (int)(state >> 40) % 1500;
        switch (state >> 62) {
        case 0:
            twin.hot = (double)(state >> 33 & 1);
            plant_output(&rig->plant, ns, HOT_PIN, twin.hot > 0);
            break;
        case 1:
            twin.fan = (double)(state >> 45 & 0xFF) / 256;
            plant_pwm(&rig->plant, ns, FAN_PIN, (uint32_t)(state >> 45 & 0xFF) * 128);
            break;
        default:
            plant_sample(&rig->plant, ns, HOT_ADC, 0); // looking changes nothing
        }
        ns += (uint64_t)milliseconds * (SECOND / 1000);
        twin_run(&twin, 1, milliseconds);
        plant_update(&rig->plant, ns);
        check_near(value_of(rig, PLANT_BODY, "cartridge"), twin.cartridge, 1e-6);
        check_near(value_of(rig, PLANT_BODY, "block"), twin.block, 1e-6);
        check_near(value_of(rig, PLANT_BODY, "bed"), twin.bed, 1e-6);
        check_near(value_of(rig, PLANT_SENSOR, "hot"), twin.sensor, 1e-6);
        check_near(extra_of(rig, PLANT_HEATER, "hot"), twin.heat, 1e-6 * (1 + twin.heat));
    }
    CHECK(twin.heat > 1000 && twin.bed > 100);
    free(rig);
}

static void test_long_waits_end_in_balance(void) {
    struct rig *rig = new_rig(TEXT);
    plant_pwm(&rig->plant, BEGIN, HOT_PIN, 16384);
    plant_update(&rig->plant, BEGIN + 1000000 * SECOND);
    // 22.5 W leave by 1 mW/K from the cartridge and by 90 mW/K from the block behind 1.3 W/K.
    double block = value_of(rig, PLANT_BODY, "block") - 22, over = 0.09 * block / 1.3;
    check_near(0.09 * block + 0.001 * (block + over), 22.5, 1e-6);
    check_near(value_of(rig, PLANT_SENSOR, "hot"), block + 22, 1e-6);
    double energy = extra_of(rig, PLANT_HEATER, "hot");
    check_near(energy, 22.5e6, 1e-3);
    plant_update(&rig->plant, BEGIN); // time does not go back
    check_near(extra_of(rig, PLANT_HEATER, "hot"), energy, 0);
    free(rig);
}

static void test_a_restart_lets_go(void) {
    struct rig *rig = new_rig(TEXT);
    CHECK(value_of(rig, PLANT_HEATER, "bed") == 0); // inverted, but not driven yet
    plant_output(&rig->plant, BEGIN, BED_PIN, 0);
    plant_pwm(&rig->plant, BEGIN, HOT_PIN, 8192);
    CHECK(value_of(rig, PLANT_HEATER, "bed") == 1);
    CHECK(value_of(rig, PLANT_HEATER, "hot") == 0.25);
    plant_reset(&rig->plant, BEGIN + SECOND);
    CHECK(value_of(rig, PLANT_HEATER, "bed") == 0);
    CHECK(value_of(rig, PLANT_HEATER, "hot") == 0);
    free(rig);
}

// ------------------------------------------------------------------------------------------ sensors

static void test_curves(void) {
    struct rig *rig = new_rig(
        "plant node=n\nbody name=b capacity=10 loss=0.1 start=150\n"
        "sensor name=beta pin=PB0 node=- body=b curve=beta pullup=2200 r0=10000 t0=20 beta=3950 bits=16\n"
        "sensor name=sh pin=PB1 node=- body=b curve=steinhart pullup=4700 c1=0.722e-3 c2=2.168e-4 c3=8.9e-8\n"
        "sensor name=rtd pin=PB2 node=- body=b curve=rtd pullup=4700 r0=1000 a=3.9083e-3 b=-5.775e-7\n"
        "sensor name=amp pin=PB3 node=- body=b curve=linear zero=0.25 slope=0.001515\n");
    double kelvin = 150 + 273.15, ohm = 10000 * exp(3950 * (1 / kelvin - 1 / 293.15));
    CHECK_EQUAL(plant_sample(&rig->plant, BEGIN, 16, 0),
                lrint(rint(65535 * ohm / (ohm + 2200)) / 65535 * 4095));
    uint16_t value = plant_sample(&rig->plant, BEGIN, 17, 0);
    // Backwards, as a host does it: from the converter to ohm to kelvin.
    double share = value / 4095.0, l = log(4700 * share / (1 - share));
    check_near(1 / (0.722e-3 + 2.168e-4 * l + 8.9e-8 * l * l * l), kelvin, 0.2);
    double rtd = 1000 * (1 + 3.9083e-3 * 150 - 5.775e-7 * 150 * 150);
    CHECK_EQUAL(plant_sample(&rig->plant, BEGIN, 18, 0), lrint(4095 * rtd / (rtd + 4700)));
    CHECK_EQUAL(plant_sample(&rig->plant, BEGIN, 19, 0), lrint(4095 * (0.25 + 0.001515 * 150)));
    CHECK_EQUAL(plant_sample(&rig->plant, BEGIN, 20, 77), 77); // nothing of the plant's
    free(rig);
}

static void test_a_table(void) {
    static const double expected[][2] = {{-50, 0.8}, {10, 0.8},   {20, 0.7},
                                         {50, 0.4},  {100, 0.25}, {500, 0.1}};
    for (size_t i = 0; i < sizeof(expected) / sizeof(*expected); i++) {
        char text[400];
        snprintf(text, sizeof(text),
                 "plant node=n\nbody name=b capacity=1 loss=1 start=%g\n"
                 "sensor name=s pin=PB0 node=- body=b curve=table bits=16\n"
                 "point sensor=s celsius=10 ratio=0.8\npoint sensor=s celsius=50 ratio=0.4\n"
                 "point sensor=s celsius=150 ratio=0.1\n",
                 expected[i][0]);
        struct rig *rig = new_rig(text);
        check_near(plant_sample(&rig->plant, BEGIN, 16, 0), 4095 * expected[i][1], 0.6);
        free(rig);
    }
}

static void test_coarse_converters_and_noise(void) {
    static const char text[] =
        "plant node=n seed=%d\nbody name=b capacity=10 loss=0.1\n"
        "sensor name=coarse pin=PB0 node=- body=b curve=linear zero=0.5 slope=0 bits=4\n"
        "sensor name=noisy pin=PB1 node=- body=b curve=linear zero=0.5 slope=0 noise=3\n"
        "sensor name=full pin=PB2 node=- body=b curve=linear zero=0.999 slope=0 noise=50\n";
    char described[sizeof(text) + 16];
    double mean[2], spread[2];
    uint16_t first[2][16];
    for (int run = 0; run < 2; run++) {
        snprintf(described, sizeof(described), text, run + 1);
        struct rig *rig = new_rig(described), *again = new_rig(described);
        CHECK_EQUAL(plant_sample(&rig->plant, BEGIN, 16, 0), 8 * 4095 / 15); // 7.5 of 15 steps
        double sum = 0, squares = 0;
        for (int i = 0; i < 4000; i++) {
            uint16_t value = plant_sample(&rig->plant, BEGIN, 17, 0);
            CHECK_EQUAL(plant_sample(&again->plant, BEGIN, 17, 0), value); // the seed decides
            if (i < 16)
                first[run][i] = value;
            sum += value;
            squares += value * (double)value;
            CHECK(plant_sample(&rig->plant, BEGIN, 18, 0) <= ADC_MAX);
        }
        mean[run] = sum / 4000;
        spread[run] = sqrt(squares / 4000 - mean[run] * mean[run]);
        check_near(mean[run], 2047.5, 0.3);
        check_near(spread[run], 3.0, 0.2);
        free(again);
        free(rig);
    }
    CHECK(memcmp(first[0], first[1], sizeof(first[0])) != 0);
}

// ------------------------------------------------------------------------------------------ faults

static void test_faults(void) {
    struct rig *rig = new_rig(TEXT);
    uint64_t ns = BEGIN;
    plant_output(&rig->plant, ns, HOT_PIN, 1);
    set_fault(rig, PLANT_HEATER, "hot", PLANT_DEAD);
    plant_update(&rig->plant, ns += SECOND);
    double warm = value_of(rig, PLANT_BODY, "cartridge");
    plant_update(&rig->plant, ns += SECOND);
    CHECK(value_of(rig, PLANT_HEATER, "hot") == 0 && value_of(rig, PLANT_BODY, "cartridge") < warm);
    set_fault(rig, PLANT_HEATER, "hot", PLANT_STUCK_ON);
    plant_output(&rig->plant, ns, HOT_PIN, 0);
    plant_update(&rig->plant, ns);
    plant_update(&rig->plant, ns += 60 * SECOND);
    CHECK(value_of(rig, PLANT_HEATER, "hot") == 1 && value_of(rig, PLANT_BODY, "cartridge") > warm + 50);
    set_fault(rig, PLANT_HEATER, "hot", PLANT_SOUND);
    plant_update(&rig->plant, ns);
    CHECK(value_of(rig, PLANT_HEATER, "hot") == 0);

    set_fault(rig, PLANT_SENSOR, "hot", PLANT_OPEN);
    CHECK_EQUAL(plant_sample(&rig->plant, ns, HOT_ADC, 0), ADC_MAX);
    set_fault(rig, PLANT_SENSOR, "hot", PLANT_SHORTED);
    CHECK_EQUAL(plant_sample(&rig->plant, ns, HOT_ADC, 0), 0);
    double before = value_of(rig, PLANT_SENSOR, "hot");
    set_fault(rig, PLANT_SENSOR, "hot", PLANT_FALLEN);
    plant_update(&rig->plant, ns);
    plant_update(&rig->plant, ns += SECOND * 8 / 10);
    check_near(value_of(rig, PLANT_SENSOR, "hot") - 22, (before - 22) * exp(-1), 1e-6); // one lag later
    CHECK(value_of(rig, PLANT_BODY, "block") > 60);
    set_fault(rig, PLANT_SENSOR, "bed", PLANT_FALLEN); // without lag: at once
    plant_output(&rig->plant, ns, BED_PIN, 0);
    plant_update(&rig->plant, ns += 100 * SECOND);
    CHECK(value_of(rig, PLANT_SENSOR, "bed") == 22 && value_of(rig, PLANT_BODY, "bed") > 60);
    free(rig);
}

static void test_tachometer(void) {
    struct rig *rig = new_rig(TEXT);
    unsigned edges = 0;
    int level = plant_input(&rig->plant, BEGIN, TACH_PIN, 0);
    uint64_t ns = BEGIN;
    plant_output(&rig->plant, ns, FAN_PIN, 1);
    for (int i = 0; i < 30000; i++) { // 3 s in steps of 0.1 ms
        int now = plant_input(&rig->plant, ns += SECOND / 10000, TACH_PIN, 0);
        edges += now != level;
        level = now;
    }
    // The lag costs 0.4 s of turns; two pulses a turn are four edges.
    double turns = 5000 / 60.0 * (3 - 0.4 * (1 - exp(-3 / 0.4)));
    check_near(edges, 4 * turns, 2);
    plant_update(&rig->plant, ns);
    check_near(extra_of(rig, PLANT_FAN, "part"), turns, 1e-6);
    set_fault(rig, PLANT_FAN, "part", PLANT_DEAD);
    plant_update(&rig->plant, ns);
    plant_update(&rig->plant, ns += 10 * SECOND);
    check_near(extra_of(rig, PLANT_FAN, "part"), turns + 5000 / 60.0 * 0.4 * (1 - exp(-3 / 0.4)), 1e-6);
    free(rig);
}

// ------------------------------------------------------------------------------------------ of other nodes

static void test_body_and_fan_of_another_node(void) {
    struct rig *other = new_rig("plant node=other\nbody name=block capacity=10 loss=0.1 start=80\n"
                                "fan name=part pin=PA3\n");
    struct rig *rig =
        new_rig("plant node=n ambient=20\nbody name=own capacity=10 loss=0.1 start=100\n"
                "cooling body=own node=other fan=part conductance=0.9\n"
                "sensor name=far pin=PB0 node=other body=block lag=2 curve=linear zero=0 slope=0.001\n");
    plant_update(&rig->plant, BEGIN + SECOND); // nobody there yet
    check_near(value_of(rig, PLANT_SENSOR, "far"), 20, 1e-9);
    rig->plant.peers[0].page = &other->page;
    plant_update(&rig->plant, BEGIN + SECOND);
    plant_update(&rig->plant, BEGIN + 3 * SECOND);
    check_near(value_of(rig, PLANT_SENSOR, "far"), 80 - 60 * exp(-1), 1e-6);
    double before = value_of(rig, PLANT_BODY, "own");
    plant_output(&other->plant, BEGIN, 3, 1);
    plant_update(&rig->plant, BEGIN + 3 * SECOND);
    plant_update(&rig->plant, BEGIN + 13 * SECOND);
    check_near(value_of(rig, PLANT_BODY, "own"), 20 + (before - 20) * exp(-1), 1e-6); // 10 J/K by 1 W/K: 10 s
    free(rig);
    free(other);
}

// ------------------------------------------------------------------------------------------ no description

static void test_what_is_no_plant(void) {
    static const char *const wrong[][2] = {
        {"", "line 1: plant node=NAME: is missing"},
        {"body name=b capacity=1 loss=1\n", "is missing"},
        {"plant node=n\nbaddy name=b\n", "line 2: baddy: there is no such kind of line"},
        {"plant node=n\nbody name=b capacity=1\n", "line 2: loss: is missing"},
        {"plant node=n\nbody name=b capacity=0 loss=1\n",
         "line 2: capacity=0: expected a number of 0.001 to 1e+09"},
        {"plant node=n\nbody name=b capacity=nan loss=1\n", "capacity=nan: expected a number"},
        {"plant node=n\nbody name=b capacity=1x loss=1\n", "expected a number"},
        {"plant node=n\nbody name=b capacity=1 loss=1 loss=2\n", "loss=2: given twice"},
        {"plant node=n\nbody name=b capacity=1 loss=1 colour=2\n", "colour=2: there is no such field here"},
        {"plant node=n\nbody name capacity=1 loss=1\n", "name: there is no such field here"},
        {"plant node=a-name-that-is-longer-than-a-name-may-be-and-was-made-so-to-see-what-is-said\n",
         "expected a name of 1 to 63 characters"},
        {"plant node=n\nheater name=h pin=PA0 body=b power=1\n", "body=b: expected a body described above"},
        {"plant node=n\nfan name=f pin=PJ0\n", "pin=PJ0: expected a pin, PA0 to PI15"},
        {"plant node=n\nfan name=f pin=PA16\n", "expected a pin"},
        {"plant node=n\nfan name=f pin=PA\n", "expected a pin"},
        {"plant node=n\nfan name=f pin=PA0 inverted=2\n", "expected 0 or 1"},
        {"plant node=n\nbody name=b capacity=1 loss=1\ncouple a=b b=b conductance=1\n", "a body with itself"},
        {"plant node=n\nbody name=b capacity=1 loss=1\ncooling body=b node=- fan=f conductance=1\n",
         "line 3: f: is not described above"},
        {"plant node=n\nbody name=b capacity=1 loss=1\nsensor name=s pin=PB0 node=- body=b curve=beta "
         "beta=4000\n",
         "its curve needs"},
        {"plant node=n\npoint sensor=s celsius=1 ratio=0\n", "line 2: s: is not described above"},
        {"plant node=n\nbody name=b capacity=1 loss=1\nsensor name=s pin=PB0 node=- body=b curve=table\n"
         "point sensor=s celsius=2 ratio=0\npoint sensor=s celsius=2 ratio=1\n",
         "line 5: s: a table whose temperatures do not rise"},
        {"plant node=n\nbody name=b capacity=1 loss=1\nsensor name=s pin=PB0 node=- body=b curve=round\n",
         "expected beta, steinhart, rtd, linear or table"},
        {"plant node=n\nbed name=b\nprobe name=p pin=PB0 bed=b\n", "p: needs x, y and z, or delta"},
        {"plant node=n\nbed name=b\nprobe name=p pin=PB0 bed=b delta=d\n",
         "expected a delta described above"},
        {"plant node=n\naxis name=a\ndelta name=d a=a b=a c=a ax=0 ay=0 bx=50 by=50 cx=99 cy=99 rod_a=200 "
         "rod_b=200 rod_c=200\n",
         "its towers stand on one line"},
    };
    struct rig *rig = calloc(1, sizeof(*rig));
    CHECK(rig);
    for (size_t i = 0; i < sizeof(wrong) / sizeof(*wrong); i++) {
        char error[PLANT_ERROR] = "";
        CHECK(plant_read(&rig->plant, wrong[i][0], strlen(wrong[i][0]), ADC_MAX, 32768, error));
        if (!strstr(error, wrong[i][1]))
            fprintf(stderr, "%s\n", error);
        CHECK(strstr(error, wrong[i][1]));
    }
    char many[4096] = "plant node=n\n", error[PLANT_ERROR];
    for (int i = 0; i <= PLANT_BODIES; i++)
        snprintf(many + strlen(many), 64, "body name=b%d capacity=1 loss=1\n", i);
    CHECK(plant_read(&rig->plant, many, strlen(many), ADC_MAX, 32768, error) &&
          strstr(error, "body: too many"));
    char longest[3000];
    memset(longest, 'x', sizeof(longest));
    CHECK(plant_read(&rig->plant, longest, sizeof(longest), ADC_MAX, 32768, error) &&
          strstr(error, "too long"));
    free(rig);
}

int main(void) {
    test_against_small_steps();
    test_long_waits_end_in_balance();
    test_a_restart_lets_go();
    test_curves();
    test_a_table();
    test_coarse_converters_and_noise();
    test_faults();
    test_tachometer();
    test_body_and_fan_of_another_node();
    test_what_is_no_plant();
    return 0;
}
