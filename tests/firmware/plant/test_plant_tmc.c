// SPDX-License-Identifier: Apache-2.0
// sources: firmware/plant/plant*.c
// Drivers with a UART: they answer and keep what was written, step as they are set, and feel a stop.
#include "plant/plant.h"
#include "tests/check.h"

#include <stdlib.h>
#include <string.h>

enum {
    STEP,
    DIR,
    UART = 2,
    DIAG = 16,
    BIT_NS = 25000,
    GCONF = 0,
    GSTAT = 1,
    IFCNT = 2,
    SLAVECONF = 3,
    IOIN = 6,
    TSTEP = 0x12,
    TPWMTHRS = 0x13,
    TCOOLTHRS = 0x14,
    SGTHRS = 0x40,
    SG_RESULT = 0x41,
    CHOPCONF = 0x6C,
    DRV_STATUS = 0x6F,
    SILENCE = -1,
    DAMAGED = -2,
    STEP_NS = 200000,
    MICROSTEPS = 16,
};
static const uint32_t GCONF_STEALTH = 0xC0, GCONF_SPREAD = 0xC4, CHOP_16 = 0x04000053, CHOP_32 = 0x03000053;

// The stop stands 100 microsteps below where the motor begins, which is a quarter of a full step off.
static const char TEXT[] = "plant node=n\n"
                           "stepper name=a step=PA0 dir=PA1\n"
                           "stepper name=b step=PA3 dir=PA4\n"
                           "axis name=x origin=1 min=0\n"
                           "term axis=x node=- stepper=a mm=0.01\n"
                           "tmc name=a chip=tmc2209 stepper=a tx=PA2 rx=PA2 address=1 microsteps=16\n"
                           "tmc name=b chip=tmc2208 stepper=b tx=PA2 rx=PA2 microsteps=16\n"
                           "diag pin=PB0 node=- tmc=a\n";

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
    rig->ns = 1000000;
    return rig;
}

// The data sheet's way, on the bits in their order.
static uint8_t crc_of(const uint8_t *data, int size) {
    uint32_t crc = 0;
    for (int bit = 0; bit < size * 8; bit++)
        crc = (crc << 1) ^ (((crc >> 7) & 1) != (uint32_t)(data[bit / 8] >> (bit % 8) & 1) ? 7u : 0u);
    return (uint8_t)crc;
}

static void put(struct rig *rig, int level) {
    plant_output(&rig->plant, rig->ns, UART, level);
    rig->ns += BIT_NS;
}

static void put_bytes(struct rig *rig, const uint8_t *data, int size) {
    for (int i = 0; i < size; i++) {
        put(rig, 0);
        for (int bit = 0; bit < 8; bit++)
            put(rig, data[i] >> bit & 1);
        put(rig, 1);
    }
}

static int get(struct rig *rig) {
    return plant_input(&rig->plant, rig->ns, UART, 0);
}

static void write_damaged(struct rig *rig, int address, int number, uint32_t value, uint8_t damage) {
    uint8_t data[8] = {5, (uint8_t)address, (uint8_t)(number | 0x80)};
    for (int i = 0; i < 4; i++)
        data[3 + i] = (uint8_t)(value >> (24 - 8 * i));
    data[7] = crc_of(data, 7) ^ damage;
    put_bytes(rig, data, 8);
}

static void write_register(struct rig *rig, int address, int number, uint32_t value) {
    write_damaged(rig, address, number, value, 0);
}

static int64_t answer(struct rig *rig, int number) {
    uint8_t data[8] = {0};
    for (int looks = 0; get(rig); looks++, rig->ns += BIT_NS / 5)
        if (looks > 5 * 150)
            return SILENCE;
    rig->ns += BIT_NS / 2;
    for (int bit = 0; bit < 80; bit++, rig->ns += BIT_NS) {
        if (bit % 10 == 0 || bit % 10 == 9)
            CHECK_EQUAL(get(rig), bit % 10 == 9);
        else
            data[bit / 10] |= (uint8_t)(get(rig) << (bit % 10 - 1));
    }
    if (data[7] != crc_of(data, 7))
        return DAMAGED;
    CHECK_EQUAL(data[0] & 15, 5);
    CHECK_EQUAL(data[1], 0xFF);
    CHECK_EQUAL(data[2], number);
    return (int64_t)data[3] << 24 | data[4] << 16 | data[5] << 8 | data[6];
}

static int64_t read_register(struct rig *rig, int address, int number) {
    uint8_t data[4] = {5, (uint8_t)address, (uint8_t)number};
    data[3] = crc_of(data, 3);
    put_bytes(rig, data, 4);
    plant_float(&rig->plant, rig->ns, UART);
    return answer(rig, number);
}

static void set_fault(struct rig *rig, int tmc, enum plant_fault fault) {
    rig->page.items[rig->plant.first_tmc + tmc].fault = fault;
}

static void steps(struct rig *rig, int count, uint64_t step_ns) {
    plant_output(&rig->plant, rig->ns, DIR, count > 0);
    for (int i = 0; i < abs(count); i++) {
        rig->ns += step_ns;
        plant_output(&rig->plant, rig->ns, STEP, 1);
        plant_output(&rig->plant, rig->ns, STEP, 0);
    }
}

static int64_t place(const struct rig *rig) {
    return rig->page.steppers[0].count;
}

static int diag(struct rig *rig) {
    return plant_input(&rig->plant, rig->ns, DIAG, 0);
}

// As a host sets it up: microsteps by register, StealthChop, and StallGuard from STEP_NS · 4 a microstep on.
static struct rig *new_homing_rig(void) {
    struct rig *rig = new_rig();
    write_register(rig, 1, GCONF, GCONF_STEALTH);
    write_register(rig, 1, CHOPCONF, CHOP_16);
    write_register(rig, 1, SGTHRS, 70);
    write_register(rig, 1, TCOOLTHRS, STEP_NS * 4 / 1000 * 12 / 16);
    return rig;
}

// ------------------------------------------------------------------------------------------------ datagrams

static void test_registers(void) {
    struct rig *rig = new_rig();
    CHECK_EQUAL(read_register(rig, 1, IOIN) >> 24, 0x21);
    CHECK_EQUAL(read_register(rig, 0, IOIN) >> 24, 0x20);
    CHECK_EQUAL(read_register(rig, 2, IOIN), SILENCE);
    CHECK_EQUAL(read_register(rig, 1, GCONF), 0x101);
    write_register(rig, 1, GCONF, GCONF_STEALTH);
    write_register(rig, 1, CHOPCONF, 0x12345678);
    CHECK_EQUAL(read_register(rig, 1, CHOPCONF), 0x12345678);
    CHECK_EQUAL(read_register(rig, 0, CHOPCONF), 0x10000053);
    CHECK_EQUAL(read_register(rig, 1, IFCNT), 2);
    CHECK_EQUAL(read_register(rig, 0, IFCNT), 0);
    CHECK_EQUAL(read_register(rig, 1, TCOOLTHRS), 0); // write only
    CHECK_EQUAL(read_register(rig, 1, GSTAT), 1);
    write_register(rig, 1, GSTAT, 1);
    CHECK_EQUAL(read_register(rig, 1, GSTAT), 0);
    write_damaged(rig, 1, GCONF, 0, 1);
    CHECK_EQUAL(read_register(rig, 1, GCONF), GCONF_STEALTH);
    CHECK_EQUAL(read_register(rig, 1, IFCNT), 3);
    for (int i = 0; i < 253; i++)
        write_register(rig, 1, SLAVECONF, 0);
    CHECK_EQUAL(read_register(rig, 1, IFCNT), 0);
    free(rig);
}

static void test_the_answer_waits_as_it_is_set(void) {
    struct rig *rig = new_rig();
    static const int delays[] = {0, 1, 2, 3, 15}, bit_times[] = {8, 8, 24, 24, 120};
    for (int i = 0; i < 5; i++) {
        write_register(rig, 1, SLAVECONF, (uint32_t)delays[i] << 8);
        uint8_t data[4] = {5, 1, IFCNT};
        data[3] = crc_of(data, 3);
        put_bytes(rig, data, 4);
        uint64_t end = rig->ns;
        rig->ns = end + (uint64_t)bit_times[i] * BIT_NS - 1000;
        CHECK(get(rig));
        rig->ns += 2000;
        CHECK(!get(rig));
        rig->ns += 100 * BIT_NS;
        CHECK(get(rig));
    }
    free(rig);
}

static void test_noise_is_forgotten(void) {
    struct rig *rig = new_rig();
    put(rig, 0); // a spike
    put(rig, 1);
    rig->ns += 100 * BIT_NS;
    CHECK_EQUAL(read_register(rig, 1, IFCNT), 0);
    srand(1);
    for (int i = 0; i < 100000; i++)
        put(rig, rand() & 1);
    put(rig, 1);
    rig->ns += 1000 * BIT_NS;
    get(rig);
    CHECK(read_register(rig, 1, IFCNT) >= 0);
    put_bytes(rig, (const uint8_t[]){5, 1}, 2); // half a datagram, then the board restarts
    plant_reset(&rig->plant, rig->ns);
    rig->ns += 1000 * BIT_NS;
    CHECK(read_register(rig, 1, IFCNT) >= 0);
    free(rig);
}

static void test_faults(void) {
    struct rig *rig = new_homing_rig();
    write_register(rig, 1, GSTAT, 7);
    set_fault(rig, 0, PLANT_OPEN);
    CHECK_EQUAL(read_register(rig, 1, GCONF), SILENCE);
    set_fault(rig, 0, PLANT_GARBLED);
    CHECK_EQUAL(read_register(rig, 1, GCONF), DAMAGED);
    set_fault(rig, 0, PLANT_WARM);
    CHECK_EQUAL(read_register(rig, 1, DRV_STATUS) & 3, 1);
    CHECK_EQUAL(read_register(rig, 1, GSTAT), 0);
    CHECK(!diag(rig));
    set_fault(rig, 0, PLANT_OVERHEATED);
    CHECK_EQUAL(read_register(rig, 1, DRV_STATUS) & 3, 3);
    CHECK_EQUAL(read_register(rig, 1, GSTAT), 2);
    CHECK(diag(rig));
    steps(rig, 32, STEP_NS);
    CHECK_EQUAL(place(rig), 0);
    CHECK_EQUAL(rig->page.steppers[0].lost, 32);
    set_fault(rig, 0, PLANT_SHORTED);
    CHECK_EQUAL(read_register(rig, 1, DRV_STATUS) & 7, 4);
    set_fault(rig, 0, PLANT_DEAD);
    CHECK_EQUAL(read_register(rig, 1, GCONF), SILENCE);
    set_fault(rig, 0, PLANT_SOUND);
    CHECK_EQUAL(read_register(rig, 1, GSTAT), 1);
    CHECK_EQUAL(read_register(rig, 1, GCONF), 0x101);
    free(rig);
}

// --------------------------------------------------------------------------------------------------- motion

static void test_steps_are_as_long_as_it_is_set(void) {
    struct rig *rig = new_rig();
    steps(rig, 8, STEP_NS); // its pins say an eighth of a full step
    CHECK_EQUAL(place(rig), MICROSTEPS);
    write_register(rig, 1, GCONF, GCONF_STEALTH);
    write_register(rig, 1, CHOPCONF, CHOP_16);
    steps(rig, 8, STEP_NS);
    CHECK_EQUAL(place(rig), MICROSTEPS + 8);
    write_register(rig, 1, CHOPCONF, CHOP_32);
    steps(rig, -9, STEP_NS);
    CHECK_EQUAL(place(rig), MICROSTEPS + 3); // rounded down
    steps(rig, 1, STEP_NS);
    CHECK_EQUAL(place(rig), MICROSTEPS + 4);
    write_register(rig, 1, CHOPCONF, CHOP_16 | 1u << 29); // on both edges
    steps(rig, 2, STEP_NS);
    CHECK_EQUAL(place(rig), MICROSTEPS + 8);
    write_register(rig, 1, GCONF, GCONF_STEALTH | 1 << 3); // the other way round
    steps(rig, 2, STEP_NS);
    CHECK_EQUAL(place(rig), MICROSTEPS + 4);
    write_register(rig, 1, CHOPCONF, CHOP_16 & ~15u); // switched off
    steps(rig, 2, STEP_NS);
    CHECK_EQUAL(place(rig), MICROSTEPS + 4);
    free(rig);
}

static void test_a_stop_is_felt_and_left_again(void) {
    struct rig *rig = new_homing_rig();
    steps(rig, -100, STEP_NS);
    CHECK(!diag(rig));
    CHECK_EQUAL(read_register(rig, 1, SG_RESULT), 300);
    int64_t at_stop = place(rig);
    int felt = 0;
    while (!diag(rig) && felt < 2 * MICROSTEPS) {
        steps(rig, -1, STEP_NS);
        felt++;
    }
    CHECK_EQUAL(felt, 13); // where the field's next full step begins, 13 behind the stop
    CHECK_EQUAL(place(rig), at_stop);
    CHECK_EQUAL(rig->page.steppers[0].lost, 0);
    rig->ns += 20 * STEP_NS; // at rest it is not felt
    CHECK(!diag(rig));
    steps(rig, felt, STEP_NS);
    CHECK_EQUAL(place(rig), at_stop);
    steps(rig, 1, STEP_NS);
    CHECK_EQUAL(place(rig), at_stop + 1);
    free(rig);
}

static void test_pushed_on_it_falls_back_four_full_steps(void) {
    struct rig *rig = new_homing_rig();
    steps(rig, -100 - 31, STEP_NS);
    CHECK_EQUAL(place(rig), -100);
    steps(rig, -1, STEP_NS);
    CHECK_EQUAL(place(rig), -100 + 2 * MICROSTEPS);
    CHECK_EQUAL(rig->page.steppers[0].lost, 4 * MICROSTEPS);
    free(rig);
}

// Motors of a corexy, both pressing: along the stop nothing holds them, and nothing gets lost.
static void test_two_motors_share_a_stop(void) {
    static const char text[] = "plant node=n\n"
                               "stepper name=a step=PA0 dir=PA1\n"
                               "stepper name=b step=PA3 dir=PA4\n"
                               "axis name=x min=-0.005\n"
                               "term axis=x node=- stepper=a mm=0.005\n"
                               "term axis=x node=- stepper=b mm=0.005\n"
                               "tmc name=a chip=tmc2209 stepper=a tx=PA2 rx=PA2 microsteps=8\n"
                               "tmc name=b chip=tmc2209 stepper=b tx=PA2 rx=PA2 address=1 microsteps=8\n";
    struct rig *rig = calloc(1, sizeof(*rig));
    char error[PLANT_ERROR];
    CHECK(rig && !plant_read(&rig->plant, text, strlen(text), 4095, 32768, error));
    plant_start(&rig->plant, &rig->page, 0);
    static const int moves[][3] = {{-1, -1, 10}, {1, -1, 50}, {-1, 1, 100}, {1, 1, 15}};
    for (size_t i = 0; i < sizeof(moves) / sizeof(*moves); i++) {
        plant_output(&rig->plant, rig->ns, DIR, moves[i][0] > 0);
        plant_output(&rig->plant, rig->ns, 4, moves[i][1] > 0);
        for (int n = 0; n < moves[i][2]; n++)
            for (int level = 1; level >= 0; level--)
                for (uint32_t pin = 0; pin <= 3; pin += 3)
                    plant_output(&rig->plant, rig->ns += STEP_NS, pin, level);
        int64_t a = rig->page.steppers[0].count, b = rig->page.steppers[1].count;
        CHECK(a + b >= -1);
        if (i == 1)
            CHECK_EQUAL(a - b, 100);
    }
    CHECK_EQUAL(rig->page.steppers[0].lost + rig->page.steppers[1].lost, 0);
    CHECK_EQUAL(rig->page.steppers[0].count, -10 + 50 - 100 + 15);
    CHECK_EQUAL(rig->page.steppers[1].count, -10 - 50 + 100 + 15);
    free(rig);
}

static int felt_with(uint8_t number, uint32_t value, uint64_t step_ns) {
    struct rig *rig = new_homing_rig();
    write_register(rig, 1, number, value);
    int felt = 0;
    for (int i = 0; i < 131; i++) {
        steps(rig, -1, step_ns);
        felt |= diag(rig);
    }
    free(rig);
    return felt;
}

static void test_it_is_felt_only_as_the_chip_can(void) {
    CHECK(felt_with(SGTHRS, 70, STEP_NS));
    CHECK(felt_with(SGTHRS, 70, STEP_NS * 39 / 10));
    CHECK(!felt_with(SGTHRS, 70, STEP_NS * 41 / 10)); // too slow
    CHECK(!felt_with(GCONF, GCONF_SPREAD, STEP_NS));
    CHECK(!felt_with(TCOOLTHRS, 0, STEP_NS));
    CHECK(!felt_with(TPWMTHRS, STEP_NS / 1000 * 12 / 16 + 1, STEP_NS)); // so fast it is in SpreadCycle
    CHECK(felt_with(TPWMTHRS, STEP_NS / 1000 * 12 / 16 - 1, STEP_NS));
    CHECK(!felt_with(CHOPCONF, 0, STEP_NS));
    CHECK(felt_with(SGTHRS, 150, STEP_NS));
}

static void test_another_node_sees_diag(void) {
    static const char text[] = "plant node=other\ndiag pin=PB0 node=n tmc=a\n";
    struct rig *rig = new_homing_rig(), *other = calloc(1, sizeof(*other));
    char error[PLANT_ERROR];
    CHECK(other && !plant_read(&other->plant, text, strlen(text), 4095, 32768, error));
    plant_start(&other->plant, &other->page, 0);
    CHECK(!plant_input(&other->plant, rig->ns, DIAG, 0)); // its page is not there yet
    other->plant.peers[0].page = &rig->page;
    steps(rig, -100, STEP_NS);
    CHECK(!plant_input(&other->plant, rig->ns, DIAG, 0));
    steps(rig, -29, STEP_NS);
    CHECK(plant_input(&other->plant, rig->ns, DIAG, 0));
    CHECK(!plant_input(&other->plant, rig->ns + 20 * STEP_NS, DIAG, 0));
    free(other);
    free(rig);
}

static void test_descriptions_are_checked(void) {
    static const char *const wrong[][2] = {
        {"tmc name=a chip=tmc1 stepper=a tx=PA2 rx=PA2 microsteps=16", "expected tmc2208 or tmc2209"},
        {"tmc name=a chip=tmc2209 stepper=c tx=PA2 rx=PA2 microsteps=16", "a stepper described above"},
        {"tmc name=a chip=tmc2209 stepper=a tx=PA2 rx=PA2", "microsteps: is missing"},
        {"diag pin=PB0 node=- tmc=a", "is not described above"},
    };
    struct plant *plant = malloc(sizeof(*plant));
    CHECK(plant);
    char text[400], error[PLANT_ERROR];
    for (size_t i = 0; i < sizeof(wrong) / sizeof(*wrong); i++) {
        snprintf(text, sizeof(text), "plant node=n\nstepper name=a step=PA0 dir=PA1\n%s\n", wrong[i][0]);
        CHECK(plant_read(plant, text, strlen(text), 4095, 32768, error));
        CHECK(strstr(error, wrong[i][1]));
    }
    free(plant);
}

int main(void) {
    test_registers();
    test_the_answer_waits_as_it_is_set();
    test_noise_is_forgotten();
    test_faults();
    test_steps_are_as_long_as_it_is_set();
    test_a_stop_is_felt_and_left_again();
    test_pushed_on_it_falls_back_four_full_steps();
    test_two_motors_share_a_stop();
    test_it_is_felt_only_as_the_chip_can();
    test_another_node_sees_diag();
    test_descriptions_are_checked();
    return 0;
}
