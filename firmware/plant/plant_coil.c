// SPDX-License-Identifier: Apache-2.0
// The coil of an eddy current probe with its LDC1612, as a device on an I2C bus: the registers that a host
// uses for channel 0, and readings whose frequency follows from the height of the coil above the bed.
//
// The frequency is far·(1 + gain·e^(-height / reach))·(1 + drift·(T - 25 °C)), averaged over a conversion,
// which here is its value in the middle of it. A reading is made when it is asked for; steps that came later
// do not count.
#include "plant/plant.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    REG_DATA0_MSB = 0x00,
    REG_DATA0_LSB = 0x01,
    REG_RCOUNT0 = 0x08,
    REG_SETTLECOUNT0 = 0x10,
    REG_CLOCK_DIVIDERS0 = 0x14,
    REG_STATUS = 0x18,
    REG_ERROR_CONFIG = 0x19,
    REG_CONFIG = 0x1A,
    REG_RESET_DEV = 0x1C,
    REG_DRIVE_CURRENT0 = 0x1E,
    REG_MANUFACTURER_ID = 0x7E,
    REG_DEVICE_ID = 0x7F,
    MANUFACTURER = 0x5449,
    DEVICE = 0x3055,
    STATUS_DRDY = 1 << 6,
    STATUS_UNREAD_0 = 1 << 3,
    CONFIG_SLEEP = 1 << 13,
    CONFIG_AUTO_AMP_OFF = 1 << 10,
    CONFIG_INTB_OFF = 1 << 7,
    CONFIG_AT_RESET = 0x2801,
    ERROR_AMPLITUDE_OUT = 1 << 11,
    ERROR_DRDY_TO_INT = 1 << 0,
    DATA_AMPLITUDE = 1 << 12,
    DATA_RANGE = 1 << 14,
    RESET = 1 << 15,
    DRIVE_SPREAD = 3, // further from the best drive than this the amplitude is out of its range
};

static const double SCALE = 268435456.0; // 2^28
static const double NS_PER_S = 1e9;

static uint32_t fault_of(const struct plant *plant, const struct plant_coil *coil) {
    int item = plant->first_coil + (int)(coil - plant->coils);
    return atomic_load_explicit(&plant->page->items[item].fault, memory_order_relaxed);
}

static double reference(const struct plant_coil *coil) {
    int divider = coil->registers[REG_CLOCK_DIVIDERS0] & 0x3FF;
    return coil->clock / (divider ? divider : 1);
}

static double conversion_ns(const struct plant_coil *coil) {
    return (coil->registers[REG_RCOUNT0] * 16.0 + 4) / reference(coil) * NS_PER_S;
}

// How many readings have been made since the chip was woken.
static uint64_t made(const struct plant *plant, const struct plant_coil *coil, uint64_t ns) {
    if (coil->registers[REG_CONFIG] & CONFIG_SLEEP || fault_of(plant, coil) == PLANT_DEAD)
        return coil->taken;
    double settle_ns = coil->registers[REG_SETTLECOUNT0] * 16.0 / reference(coil) * NS_PER_S;
    double since_ns = (double)(int64_t)(ns - coil->woken_ns) - settle_ns;
    return since_ns <= 0 ? 0 : (uint64_t)(since_ns / conversion_ns(coil));
}

static double frequency(struct plant *plant, struct plant_coil *coil, uint64_t ns) {
    double height = -plant_probe_depth_at(plant, &coil->place, ns);
    double celsius = coil->body < 0 ? plant->ambient : plant_body_temperature(plant, coil->body);
    double warmth = 1 + coil->drift * (celsius - 25);
    return coil->far * (1 + coil->gain * exp(-fmax(height, 0) / coil->reach)) * warmth;
}

// Reading NTH, as the chip shows it.
static uint32_t reading(struct plant *plant, struct plant_coil *coil, uint64_t nth) {
    double settle_ns = coil->registers[REG_SETTLECOUNT0] * 16.0 / reference(coil) * NS_PER_S;
    double middle_ns = settle_ns + ((double)nth - 0.5) * conversion_ns(coil);
    double hertz = frequency(plant, coil, coil->woken_ns + (uint64_t)middle_ns);
    hertz += coil->noise * plant_normal(plant, (uint64_t)(coil - plant->coils) + 1000, nth);
    int divider = coil->registers[REG_CLOCK_DIVIDERS0] >> 12;
    double value = hertz / (divider ? divider : 1) / reference(coil) * SCALE;
    uint32_t flags = 0;
    int drive = coil->registers[REG_DRIVE_CURRENT0] >> 11;
    if (abs(drive - coil->drive) > DRIVE_SPREAD || fault_of(plant, coil) == PLANT_SHORTED)
        flags |= coil->registers[REG_ERROR_CONFIG] & ERROR_AMPLITUDE_OUT ? DATA_AMPLITUDE : 0;
    if (value >= SCALE / 4)
        flags |= DATA_RANGE;
    plant_page_store(&plant->page->items[plant->first_coil + (int)(coil - plant->coils)].value, hertz);
    return flags << 16 | ((uint32_t)value & 0x0FFFFFFF);
}

static void reset(struct plant_coil *coil) {
    memset(coil->registers, 0, sizeof(coil->registers));
    coil->registers[REG_CONFIG] = CONFIG_AT_RESET;
    coil->registers[REG_RCOUNT0] = 0x0080;
}

static void write_register(struct plant_coil *coil, uint64_t ns, int number, uint16_t value) {
    uint16_t before = coil->registers[number];
    if (number == REG_RESET_DEV) {
        if (value & RESET)
            reset(coil);
        return;
    }
    coil->registers[number] = value;
    if (number != REG_CONFIG || value & CONFIG_SLEEP || !(before & CONFIG_SLEEP))
        return;
    coil->woken_ns = ns;
    coil->taken = 0;
    if (!(value & CONFIG_AUTO_AMP_OFF)) {
        uint16_t found = (uint16_t)(coil->drive << 6);
        coil->registers[REG_DRIVE_CURRENT0] =
            (uint16_t)((coil->registers[REG_DRIVE_CURRENT0] & 0xF83F) | found);
    }
}

static uint16_t read_register(struct plant *plant, struct plant_coil *coil, uint64_t ns, int number) {
    uint64_t count = made(plant, coil, ns);
    switch (number) {
    case REG_MANUFACTURER_ID:
        return MANUFACTURER;
    case REG_DEVICE_ID:
        return DEVICE;
    case REG_STATUS:
        return count > coil->taken ? STATUS_DRDY | STATUS_UNREAD_0 : 0;
    case REG_DATA0_MSB:
        if (count > coil->taken) {
            coil->taken = count;
            coil->latched = reading(plant, coil, count);
        }
        return (uint16_t)(coil->latched >> 16);
    case REG_DATA0_LSB:
        return (uint16_t)coil->latched;
    default:
        return coil->registers[number];
    }
}

int plant_coil_ready(const struct plant *plant, const struct plant_coil *coil, uint64_t ns) {
    int wired = !(coil->registers[REG_CONFIG] & CONFIG_INTB_OFF) &&
                coil->registers[REG_ERROR_CONFIG] & ERROR_DRDY_TO_INT;
    return wired && made(plant, coil, ns) > coil->taken;
}

void plant_coil_start(struct plant_coil *coil) {
    reset(coil);
}

int plant_i2c(struct plant *plant, uint64_t ns, uint32_t bus, uint8_t address, const uint8_t *write,
              size_t write_size, uint8_t *read, size_t read_size) {
    struct plant_coil *coil = NULL;
    for (int i = 0; i < plant->coil_count; i++)
        if (plant->coils[i].bus == (int)bus && plant->coils[i].address == address)
            coil = &plant->coils[i];
    if (!coil || fault_of(plant, coil) == PLANT_OPEN)
        return -1;
    if (write_size)
        coil->pointer = write[0] & 0x7F;
    if (write_size >= 3)
        write_register(coil, ns, coil->pointer, (uint16_t)(write[1] << 8 | write[2]));
    plant_heat_advance(plant, ns);
    uint16_t value = read_size ? read_register(plant, coil, ns, coil->pointer) : 0;
    for (size_t i = 0; i < read_size; i++)
        read[i] = (uint8_t)(i % 2 ? value : value >> 8);
    return 0;
}
