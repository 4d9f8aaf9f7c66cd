// SPDX-License-Identifier: Apache-2.0
// The inductance-to-digital converter LDC1612, of which channel 0 has a coil: its readings go to the host in
// bulk, and while the host homes with it, one above a threshold triggers a stop group.
//
// A reading has 32 bits as the chip gives it: four error flags, then 28 bits of frequency. It is in steps of
// the reference clock / 2^28, so it rises as the coil comes near to metal. Readings that could not be had are
// LDC1612_LOST plus an error of the enumeration below.
//
// The chip is looked at every rest_ticks. With its INTB pin wired that costs nothing; else its status is
// read. A chip that has no reading for SILENT_LOOKS looks, that flags an error, or that does not answer on
// its bus ends homing at once: nobody knows where the bed is then.
#include "boards/board.h"
#include "objects/i2c.h"
#include "objects/sensor_bulk.h"
#include "objects/trsync.h"

DECL_STATIC_STRING(ldc1612_rest, "Invalid ldc1612 rest_ticks");
DECL_STATIC_STRING(invalid_input_pin, "Not a valid input pin");

// What is added to the error_reason of ldc1612_setup_home.
DECL_ENUMERATION("ldc1612_error:", "SENSOR_REPORTS_ERROR", 0);
DECL_ENUMERATION("ldc1612_error:", "I2C_STATUS_ERROR", 1);
DECL_ENUMERATION("ldc1612_error:", "I2C_DATA_ERROR", 2);
DECL_ENUMERATION("ldc1612_error:", "SENSOR_SILENT", 3);

DECL_RESPONSE(ldc1612_home_state, "ldc1612_home_state oid=%c homing=%c trigger_clock=%u");

enum ldc1612_error { SENSOR_REPORTS_ERROR, I2C_STATUS_ERROR, I2C_DATA_ERROR, SENSOR_SILENT };
enum {
    REG_DATA0_MSB = 0x00,
    REG_DATA0_LSB = 0x01,
    REG_STATUS = 0x18,
    STATUS_UNREAD_0 = 1 << 3,
    READING_SIZE = 4,
    REGISTER_SIZE = 2,
    SILENT_LOOKS = 10,
};
static const uint32_t LDC1612_LOST = 0xFFFFFFF0u;

struct ldc1612 {
    struct timer timer;
    struct i2c *i2c;
    struct trsync *trsync; // while homing
    struct sensor_bulk bulk;
    uint32_t rest_ticks, look_clock, intb_pin;
    uint32_t home_clock, trigger_clock, threshold;
    uint8_t must_look, has_intb, silent;
    uint8_t homing, trigger_reason, error_reason;
};

static const struct oid_type ldc1612_type = {"ldc1612"};

static enum timer_result look_event(struct node *node, struct timer *timer) {
    struct ldc1612 *ldc = (struct ldc1612 *)timer;
    ldc->must_look = 1;
    ldc->look_clock = timer->waketime;
    node_wake_tasks(node);
    timer->waketime += ldc->rest_ticks;
    return TIMER_AGAIN;
}

// ------------------------------------------------------------------------------------------------ the chip

static int read_register(struct node *node, const struct ldc1612 *ldc, uint8_t number, uint8_t *out) {
    return i2c_transfer(node, ldc->i2c, &number, 1, out, REGISTER_SIZE);
}

// Whether there is a new reading; -1: the chip cannot be asked.
static int has_reading(struct node *node, const struct ldc1612 *ldc) {
    uint8_t status[REGISTER_SIZE];
    if (ldc->has_intb)
        return !board_gpio_read(node, ldc->intb_pin);
    if (read_register(node, ldc, REG_STATUS, status))
        return -1;
    return (status[1] & STATUS_UNREAD_0) != 0;
}

static uint32_t take_reading(struct node *node, const struct ldc1612 *ldc) {
    uint8_t high[REGISTER_SIZE], low[REGISTER_SIZE], status[REGISTER_SIZE];
    if (read_register(node, ldc, REG_DATA0_MSB, high) || read_register(node, ldc, REG_DATA0_LSB, low))
        return LDC1612_LOST + I2C_DATA_ERROR;
    if (ldc->has_intb && read_register(node, ldc, REG_STATUS, status)) // releases INTB
        return LDC1612_LOST + I2C_STATUS_ERROR;
    return (uint32_t)high[0] << 24 | (uint32_t)high[1] << 16 | (uint32_t)low[0] << 8 | low[1];
}

// ---------------------------------------------------------------------------------------------- homing

static void end_homing(struct node *node, struct ldc1612 *ldc, uint8_t reason) {
    uint32_t irq = board_irq_save(node);
    if (ldc->homing) {
        ldc->homing = 0;
        ldc->trigger_clock = ldc->look_clock;
        trsync_trigger(node, ldc->trsync, reason);
    }
    board_irq_restore(node, irq);
}

static void check_home(struct node *node, struct ldc1612 *ldc, uint32_t reading) {
    if (!ldc->homing || clock_before(ldc->look_clock, ldc->home_clock))
        return;
    if (reading >= LDC1612_LOST)
        end_homing(node, ldc, (uint8_t)(ldc->error_reason + (reading - LDC1612_LOST)));
    else if (reading >> 28)
        end_homing(node, ldc, (uint8_t)(ldc->error_reason + SENSOR_REPORTS_ERROR));
    else if (reading > ldc->threshold)
        end_homing(node, ldc, ldc->trigger_reason);
}

static void add(struct node *node, struct ldc1612 *ldc, uint32_t oid, uint32_t reading) {
    uint8_t bytes[READING_SIZE] = {(uint8_t)(reading >> 24), (uint8_t)(reading >> 16),
                                   (uint8_t)(reading >> 8), (uint8_t)reading};
    check_home(node, ldc, reading);
    sensor_bulk_add(node, &ldc->bulk, oid, bytes, READING_SIZE);
}

static void look(struct node *node, struct ldc1612 *ldc, uint32_t oid) {
    int found = has_reading(node, ldc);
    ldc->must_look = 0;
    if (found > 0) {
        ldc->silent = 0;
        add(node, ldc, oid, take_reading(node, ldc));
    } else if (found < 0) {
        add(node, ldc, oid, LDC1612_LOST + I2C_STATUS_ERROR);
    } else if (++ldc->silent >= SILENT_LOOKS) {
        ldc->silent = 0;
        add(node, ldc, oid, LDC1612_LOST + SENSOR_SILENT);
    }
}

void ldc1612_task(struct node *node) {
    struct ldc1612 *ldc;
    for (unsigned oid = 0; (ldc = oid_next(node, &oid, &ldc1612_type));)
        if (ldc->must_look)
            look(node, ldc, oid - 1);
}
DECL_TASK(ldc1612_task);

// -------------------------------------------------------------------------------------------- commands

static struct ldc1612 *create(struct node *node, const struct wire_arg *args) {
    struct i2c *i2c = i2c_find(node, args[1].value);
    if (!i2c)
        return NULL;
    struct ldc1612 *ldc = oid_create(node, args[0].value, &ldc1612_type, sizeof(*ldc));
    if (!ldc)
        return NULL;
    ldc->i2c = i2c;
    ldc->timer.function = look_event;
    return ldc;
}

void command_config_ldc1612(struct node *node, const struct wire_arg *args) {
    create(node, args);
}
DECL_COMMAND(command_config_ldc1612, "config_ldc1612 oid=%c i2c_oid=%c", 0);

void command_config_ldc1612_with_intb(struct node *node, const struct wire_arg *args) {
    if (board_gpio_in(node, args[2].value, 1)) {
        node_shutdown(node, STRING(invalid_input_pin));
        return;
    }
    struct ldc1612 *ldc = create(node, args);
    if (!ldc)
        return;
    ldc->intb_pin = args[2].value;
    ldc->has_intb = 1;
}
DECL_COMMAND(command_config_ldc1612_with_intb, "config_ldc1612_with_intb oid=%c i2c_oid=%c intb_pin=%c", 0);

// Begins to take readings, or with 0 ends it.
void command_query_ldc1612(struct node *node, const struct wire_arg *args) {
    struct ldc1612 *ldc = oid_find(node, args[0].value, &ldc1612_type);
    if (!ldc)
        return;
    if (args[1].value >= 1u << 31) {
        node_shutdown(node, STRING(ldc1612_rest));
        return;
    }
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &ldc->timer);
    ldc->rest_ticks = args[1].value;
    ldc->must_look = ldc->silent = 0;
    if (ldc->rest_ticks) {
        sensor_bulk_reset(&ldc->bulk);
        sched_add_timer_in(node, &ldc->timer, ldc->rest_ticks);
    }
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_query_ldc1612, "query_ldc1612 oid=%c rest_ticks=%u", 0);

void command_query_status_ldc1612(struct node *node, const struct wire_arg *args) {
    const struct ldc1612 *ldc = oid_find(node, args[0].value, &ldc1612_type);
    if (!ldc)
        return;
    uint32_t clock = board_clock(node);
    uint32_t pending = has_reading(node, ldc) > 0 ? READING_SIZE : 0;
    sensor_bulk_status(node, &ldc->bulk, args[0].value, clock, board_clock(node) - clock, pending);
}
DECL_COMMAND(command_query_status_ldc1612, "query_status_ldc1612 oid=%c", 0);

// From CLOCK on a reading above THRESHOLD triggers the stop group; trigger_reason 0 ends that.
void command_ldc1612_setup_home(struct node *node, const struct wire_arg *args) {
    struct ldc1612 *ldc = oid_find(node, args[0].value, &ldc1612_type);
    if (!ldc)
        return;
    ldc->homing = 0;
    if (!args[4].value)
        return;
    ldc->trsync = trsync_find(node, args[3].value);
    if (!ldc->trsync)
        return;
    ldc->home_clock = args[1].value;
    ldc->threshold = args[2].value;
    ldc->trigger_reason = (uint8_t)args[4].value;
    ldc->error_reason = (uint8_t)args[5].value;
    ldc->homing = 1;
}
DECL_COMMAND(command_ldc1612_setup_home,
             "ldc1612_setup_home oid=%c clock=%u threshold=%u trsync_oid=%c trigger_reason=%c "
             "error_reason=%c",
             0);

void command_query_ldc1612_home_state(struct node *node, const struct wire_arg *args) {
    const struct ldc1612 *ldc = oid_find(node, args[0].value, &ldc1612_type);
    if (ldc)
        RESPOND(node, ldc1612_home_state, INT(args[0].value), INT(ldc->homing), INT(ldc->trigger_clock));
}
DECL_COMMAND(command_query_ldc1612_home_state, "query_ldc1612_home_state oid=%c", 0);

void ldc1612_shutdown(struct node *node) {
    struct ldc1612 *ldc;
    for (unsigned oid = 0; (ldc = oid_next(node, &oid, &ldc1612_type));) {
        sched_delete_timer(node, &ldc->timer);
        ldc->homing = ldc->must_look = 0;
        ldc->rest_ticks = 0;
    }
}
DECL_SHUTDOWN_HOOK(ldc1612_shutdown);
