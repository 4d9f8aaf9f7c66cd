// SPDX-License-Identifier: Apache-2.0
// The plant's edge to its board: which pin is what, faults, and the page.
#include "plant/plant.h"

#include <stdio.h>
#include <string.h>

void plant_note(const struct plant *plant, uint64_t ns, const char *kind, const char *name, double value) {
    if (plant->host.note)
        plant->host.note(plant->host.context, ns, kind, name, value);
}

int plant_find(struct plant *plant, struct plant_reference *reference, enum plant_kind kind) {
    const struct plant_page *page = plant->peers[reference->peer].page;
    if (reference->found < 0 && page)
        reference->found = kind == PLANT_NOTHING ? plant_page_find_stepper(page, reference->name)
                                                 : plant_page_find_item(page, kind, reference->name);
    return reference->found;
}

// Of an item of another node; OTHERWISE while that is not there.
static double peer_value(struct plant *plant, struct plant_reference *reference, enum plant_kind kind,
                         double otherwise) {
    int found = plant_find(plant, reference, kind);
    return found < 0 ? otherwise : plant_page_load(&plant->peers[reference->peer].page->items[found].value);
}

static uint32_t fault_of(const struct plant *plant, int item) {
    return atomic_load_explicit(&plant->page->items[item].fault, memory_order_relaxed);
}

// ------------------------------------------------------------------------------------------ what is driven

static void drive_heater(struct plant *plant, uint64_t ns, struct plant_heater *heater) {
    double duty = heater->fault == PLANT_STUCK_ON ? 1 : heater->fault == PLANT_DEAD ? 0 : heater->wanted;
    if (duty == heater->duty)
        return;
    plant_heat_advance(plant, ns);
    heater->duty = duty;
    plant_heat_changed(plant, heater->body);
    plant_page_store(&plant->page->items[plant->first_heater + (int)(heater - plant->heaters)].value, duty);
    plant_note(plant, ns, "power", heater->name, duty * heater->power);
}

static void set_cooling(struct plant *plant, uint64_t ns, struct plant_cooling *cooling, double duty) {
    if (cooling->duty == duty)
        return;
    plant_heat_advance(plant, ns);
    cooling->duty = duty;
    plant_heat_changed(plant, cooling->body);
}

static void drive_fan(struct plant *plant, uint64_t ns, struct plant_fan *fan) {
    double duty = fan->fault == PLANT_DEAD ? 0 : fan->wanted;
    if (duty == fan->duty)
        return;
    plant_fan_advance(fan, ns);
    fan->duty = duty;
    int number = (int)(fan - plant->fans);
    for (int i = 0; i < plant->cooling_count; i++)
        if (plant->coolings[i].fan.peer < 0 && plant->coolings[i].fan.found == number)
            set_cooling(plant, ns, &plant->coolings[i], duty);
    plant_page_store(&plant->page->items[plant->first_fan + number].value, duty);
    plant_note(plant, ns, "fan", fan->name, duty);
}

static void drive_pin(struct plant *plant, uint64_t ns, uint32_t pin, double duty) {
    for (int i = 0; i < plant->heater_count; i++)
        if (plant->heaters[i].pin == (int)pin) {
            plant->heaters[i].wanted = plant->heaters[i].inverted ? 1 - duty : duty;
            drive_heater(plant, ns, &plant->heaters[i]);
        }
    for (int i = 0; i < plant->fan_count; i++)
        if (plant->fans[i].pin == (int)pin) {
            plant->fans[i].wanted = plant->fans[i].inverted ? 1 - duty : duty;
            drive_fan(plant, ns, &plant->fans[i]);
        }
}

static void set_lines(struct plant *plant, uint64_t ns, uint32_t pin, int level) {
    for (int i = 0; i < plant->tmc_count; i++)
        if (plant->tmcs[i].tx_pin == (int)pin)
            plant_tmc_line(plant, &plant->tmcs[i], ns, level);
}

void plant_output(struct plant *plant, uint64_t ns, uint32_t pin, int level) {
    uint8_t value = level != 0;
    if (plant->level[pin] == value && !plant->floating[pin])
        return;
    int stepped = plant->level[pin] != value;
    plant->level[pin] = value;
    plant->floating[pin] = 0;
    if (!plant->writes[pin])
        return;
    set_lines(plant, ns, pin, value);
    if (stepped) {
        plant_motion_edge(plant, ns, pin, value);
        for (int i = 0; i < plant->switch_count; i++)
            if (plant->switches[i].control_pin == (int)pin)
                plant_bltouch_edge(plant, &plant->switches[i], ns, value);
        for (int i = 0; i < plant->load_cell_count; i++)
            if (plant->load_cells[i].sclk_pin == (int)pin)
                plant_load_cell_edge(plant, &plant->load_cells[i], ns, value);
    }
    drive_pin(plant, ns, pin, value);
}

void plant_float(struct plant *plant, uint64_t ns, uint32_t pin) {
    plant->floating[pin] = 1;
    set_lines(plant, ns, pin, 1); // pulled up
}

void plant_pwm(struct plant *plant, uint64_t ns, uint32_t pin, uint32_t value) {
    drive_pin(plant, ns, pin, (double)value / plant->pwm_max);
}

void plant_reset(struct plant *plant, uint64_t ns) {
    memset(plant->level, 0, sizeof(plant->level));
    memset(plant->floating, 1, sizeof(plant->floating));
    for (int i = 0; i < plant->tmc_count; i++)
        plant_tmc_line(plant, &plant->tmcs[i], ns, 1);
    for (int i = 0; i < plant->heater_count; i++) {
        plant->heaters[i].wanted = 0;
        drive_heater(plant, ns, &plant->heaters[i]);
    }
    for (int i = 0; i < plant->fan_count; i++) {
        plant->fans[i].wanted = 0;
        drive_fan(plant, ns, &plant->fans[i]);
    }
}

// ------------------------------------------------------------------------------------------ what has changed

static int take_fault(struct plant *plant, uint64_t ns, int item, const char *name, uint32_t *known) {
    uint32_t fault = fault_of(plant, item);
    if (fault == *known)
        return 0;
    plant_heat_advance(plant, ns);
    *known = fault;
    plant_note(plant, ns, "fault", name, fault);
    return 1;
}

static void take_faults(struct plant *plant, uint64_t ns) {
    for (int i = 0; i < plant->heater_count; i++) {
        struct plant_heater *heater = &plant->heaters[i];
        if (take_fault(plant, ns, plant->first_heater + i, heater->name, &heater->fault))
            drive_heater(plant, ns, heater);
    }
    for (int i = 0; i < plant->fan_count; i++) {
        struct plant_fan *fan = &plant->fans[i];
        if (take_fault(plant, ns, plant->first_fan + i, fan->name, &fan->fault))
            drive_fan(plant, ns, fan);
    }
    for (int i = 0; i < plant->sensor_count; i++) {
        struct plant_sensor *sensor = &plant->sensors[i];
        if (take_fault(plant, ns, plant->first_sensor + i, sensor->name, &sensor->fault))
            plant->zones[sensor->zone].stale = 1;
    }
}

static void look_at_peers(struct plant *plant, uint64_t ns) {
    for (int i = 0; i < plant->peer_count && plant->host.refresh; i++)
        plant->host.refresh(plant->host.context, (unsigned)i, ns);
    for (int i = 0; i < plant->cooling_count; i++) {
        struct plant_cooling *cooling = &plant->coolings[i];
        if (cooling->fan.peer >= 0)
            set_cooling(plant, ns, cooling, peer_value(plant, &cooling->fan, PLANT_FAN, 0));
    }
    for (int i = 0; i < plant->sensor_count; i++) {
        struct plant_sensor *sensor = &plant->sensors[i];
        if (sensor->body.peer < 0)
            continue;
        double remote = peer_value(plant, &sensor->body, PLANT_BODY, plant->ambient);
        if (remote == sensor->remote)
            continue;
        plant_heat_advance(plant, ns);
        sensor->remote = remote;
        plant->zones[sensor->zone].stale = 1;
    }
    for (int i = 0; i < plant->bed_count; i++)
        if (plant->beds[i].body.name[0] && plant->beds[i].body.peer >= 0)
            plant->beds[i].remote = peer_value(plant, &plant->beds[i].body, PLANT_BODY, plant->ambient);
}

// Brings heat to NS. While it asks others, who may ask back, it has what it had.
static void refresh(struct plant *plant, uint64_t ns) {
    if (plant->refreshing)
        return;
    plant->refreshing = 1;
    take_faults(plant, ns);
    look_at_peers(plant, ns);
    plant_heat_advance(plant, ns);
    plant->refreshing = 0;
}

static void show(struct plant *plant, uint64_t ns) {
    struct plant_page_item *items = plant->page->items;
    for (int i = 0; i < plant->body_count; i++) {
        const struct plant_body *body = &plant->bodies[i];
        plant_page_store(&items[i].value, plant->zones[body->zone].x[body->state]);
    }
    for (int i = 0; i < plant->heater_count; i++)
        plant_page_store(&items[plant->first_heater + i].extra, plant->heaters[i].energy);
    for (int i = 0; i < plant->fan_count; i++) {
        plant_fan_advance(&plant->fans[i], ns);
        plant_page_store(&items[plant->first_fan + i].extra, plant->fans[i].turns);
    }
    for (int i = 0; i < plant->sensor_count; i++)
        plant_page_store(&items[plant->first_sensor + i].value,
                         plant_sensor_temperature(plant, &plant->sensors[i]));
    atomic_store_explicit(&plant->page->updated_ns, ns, memory_order_release);
}

void plant_update(struct plant *plant, uint64_t ns) {
    if (plant->refreshing)
        return;
    refresh(plant, ns);
    for (int i = 0; i < plant->tmc_count; i++)
        plant_tmc_look(plant, &plant->tmcs[i], ns);
    show(plant, ns);
}

// ------------------------------------------------------------------------------------------ what is read

// The drivers' line is low when any of them, or the node, has it low. -1: there is none at this pin.
static int line_level(struct plant *plant, uint64_t ns, uint32_t pin) {
    int level = -1;
    for (int i = 0; i < plant->tmc_count; i++)
        if (plant->tmcs[i].rx_pin == (int)pin)
            level = plant_tmc_answer(plant, &plant->tmcs[i], ns) && level;
    return level < 0 ? level : level != 0;
}

int plant_input(struct plant *plant, uint64_t ns, uint32_t pin, int level) {
    int any_pressed = 0, inverted = -1;
    for (int i = 0; i < plant->switch_count; i++)
        if (plant->switches[i].pin == (int)pin) { // several may be wired to one pin: any of them does it
            if (plant->switches[i].bed >= 0 && plant->beds[plant->switches[i].bed].body.name[0])
                refresh(plant, ns);
            any_pressed |= plant_switch_pressed(plant, &plant->switches[i], ns);
            inverted = plant->switches[i].inverted != 0;
        }
    if (inverted >= 0)
        return any_pressed != inverted;
    for (int i = 0; i < plant->diag_count; i++)
        if (plant->diags[i].pin == (int)pin)
            return plant_diag_level(plant, &plant->diags[i], ns);
    for (int i = 0; i < plant->coil_count; i++)
        if (plant->coils[i].intb_pin == (int)pin)
            return !plant_coil_ready(plant, &plant->coils[i], ns);
    for (int i = 0; i < plant->load_cell_count; i++)
        if (plant->load_cells[i].dout_pin == (int)pin)
            return plant_load_cell_level(plant, &plant->load_cells[i], ns);
    int line = line_level(plant, ns, pin);
    if (line >= 0)
        return line;
    for (int i = 0; i < plant->fan_count; i++)
        if (plant->fans[i].tach_pin == (int)pin)
            return plant_fan_tach(&plant->fans[i], ns);
    return level;
}

uint16_t plant_sample(struct plant *plant, uint64_t ns, uint32_t pin, uint16_t value) {
    for (int i = 0; i < plant->sensor_count; i++)
        if (plant->sensors[i].pin == (int)pin) {
            refresh(plant, ns);
            value = plant_sensor_sample(plant, &plant->sensors[i]);
            plant_page_store(&plant->page->items[plant->first_sensor + i].extra, value);
        }
    return value;
}

// ------------------------------------------------------------------------------------------ being made

static void add_item(struct plant_page *page, enum plant_kind kind, const char *name) {
    struct plant_page_item *item = &page->items[page->item_count++];
    snprintf(item->name, sizeof(item->name), "%s", name);
    item->kind = (uint32_t)kind;
    atomic_store(&item->fault, PLANT_SOUND);
    atomic_store(&item->value, 0);
    atomic_store(&item->extra, 0);
}

static int has_same_steppers(const struct plant *plant, const struct plant_page *page) {
    if (atomic_load(&page->magic) != PLANT_MAGIC || page->stepper_count != (uint32_t)plant->stepper_count)
        return 0;
    for (int i = 0; i < plant->stepper_count; i++)
        if (strncmp(page->steppers[i].name, plant->steppers[i].name, PLANT_NAME) != 0)
            return 0;
    return 1;
}

// Of what was described last of all.
static void add_sensors_of_probes(struct plant *plant, struct plant_page *page) {
    plant->first_coil = (int)page->item_count;
    for (int i = 0; i < plant->coil_count; i++)
        add_item(page, PLANT_COIL, plant->coils[i].name);
    plant->first_load_cell = (int)page->item_count;
    for (int i = 0; i < plant->load_cell_count; i++)
        add_item(page, PLANT_LOAD_CELL, plant->load_cells[i].name);
}

static void make_page(struct plant *plant, struct plant_page *page) {
    int keep = has_same_steppers(plant, page);
    atomic_store(&page->magic, 0);
    page->stepper_count = (uint32_t)plant->stepper_count;
    for (int i = 0; i < plant->stepper_count && !keep; i++) {
        memset(&page->steppers[i], 0, sizeof(page->steppers[i]));
        memcpy(page->steppers[i].name, plant->steppers[i].name, PLANT_NAME);
    }
    page->item_count = 0;
    for (int i = 0; i < plant->body_count; i++)
        add_item(page, PLANT_BODY, plant->bodies[i].name);
    plant->first_heater = (int)page->item_count;
    for (int i = 0; i < plant->heater_count; i++)
        add_item(page, PLANT_HEATER, plant->heaters[i].name);
    plant->first_fan = (int)page->item_count;
    for (int i = 0; i < plant->fan_count; i++)
        add_item(page, PLANT_FAN, plant->fans[i].name);
    plant->first_sensor = (int)page->item_count;
    for (int i = 0; i < plant->sensor_count; i++)
        add_item(page, PLANT_SENSOR, plant->sensors[i].name);
    plant->first_switch = (int)page->item_count;
    for (int i = 0; i < plant->switch_count; i++)
        add_item(page, PLANT_SWITCH, plant->switches[i].name);
    plant->first_tmc = (int)page->item_count;
    for (int i = 0; i < plant->tmc_count; i++)
        add_item(page, PLANT_TMC, plant->tmcs[i].name);
    add_sensors_of_probes(plant, page);
    atomic_store(&page->horizon_ns, 0);
}

static void note_pins(struct plant *plant) {
    for (int i = 0; i < plant->stepper_count; i++) {
        const struct plant_stepper *stepper = &plant->steppers[i];
        plant->writes[stepper->step_pin] = plant->cares[stepper->dir_pin] = 1;
        if (stepper->enable_pin >= 0)
            plant->cares[stepper->enable_pin] = 1;
    }
    for (int i = 0; i < plant->heater_count; i++)
        plant->writes[plant->heaters[i].pin] = 1;
    for (int i = 0; i < plant->fan_count; i++) {
        plant->writes[plant->fans[i].pin] = 1;
        if (plant->fans[i].tach_pin >= 0)
            plant->reads[plant->fans[i].tach_pin] = 1;
    }
    for (int i = 0; i < plant->switch_count; i++) {
        plant->reads[plant->switches[i].pin] = 1;
        if (plant->switches[i].control_pin >= 0)
            plant->writes[plant->switches[i].control_pin] = 1;
    }
    for (int i = 0; i < plant->sensor_count; i++)
        plant->reads[plant->sensors[i].pin] = 1;
    for (int i = 0; i < plant->tmc_count; i++)
        plant->writes[plant->tmcs[i].tx_pin] = plant->reads[plant->tmcs[i].rx_pin] = 1;
    for (int i = 0; i < plant->diag_count; i++)
        plant->reads[plant->diags[i].pin] = 1;
    for (int i = 0; i < plant->coil_count; i++)
        if (plant->coils[i].intb_pin >= 0)
            plant->reads[plant->coils[i].intb_pin] = 1;
    for (int i = 0; i < plant->load_cell_count; i++) {
        plant->reads[plant->load_cells[i].dout_pin] = 1;
        plant->writes[plant->load_cells[i].sclk_pin] = 1;
    }
    for (int pin = 0; pin < PLANT_PINS; pin++)
        plant->cares[pin] |= plant->writes[pin];
}

int plant_read(struct plant *plant, const char *text, size_t size, uint32_t adc_max, uint32_t pwm_max,
               char *error) {
    memset(plant, 0, sizeof(*plant));
    plant->adc_max = adc_max;
    plant->pwm_max = pwm_max;
    memset(plant->floating, 1, sizeof(plant->floating));
    if (plant_parse(plant, text, size, error) || plant_heat_make(plant, error))
        return -1;
    note_pins(plant);
    for (int i = 0; i < plant->switch_count; i++) {
        struct plant_switch *it = &plant->switches[i];
        it->shift = it->noise * plant_even(plant, (uint64_t)it->pin, 0);
    }
    return 0;
}

void plant_start(struct plant *plant, struct plant_page *page, uint64_t ns) {
    plant->page = page;
    for (int i = 0; i < plant->zone_count; i++)
        plant->zones[i].at_ns = ns;
    for (int i = 0; i < plant->fan_count; i++)
        plant->fans[i].at_ns = ns;
    make_page(plant, page);
    for (int i = 0; i < plant->coil_count; i++)
        plant_coil_start(&plant->coils[i]);
    for (int i = 0; i < plant->load_cell_count; i++)
        plant->load_cells[i].start_ns = plant->load_cells[i].woken_ns = ns;
    for (int i = 0; i < plant->tmc_count; i++)
        plant_tmc_start(plant, &plant->tmcs[i], ns);
    show(plant, ns);
    atomic_store_explicit(&page->magic, PLANT_MAGIC, memory_order_release);
}
