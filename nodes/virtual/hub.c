// SPDX-License-Identifier: Apache-2.0
// See hub.h.
#include "nodes/virtual/hub.h"
#include "nodes/can_bits.h"

#include <string.h>

enum { ID_MAX = 0x7FF, DATA_MAX = 8, LENGTH_AT = 4, DATA_AT = 8, OUTPUT_BYTES = HUB_OUTPUT * HUB_RECORD };

_Static_assert((HUB_INPUT & (HUB_INPUT - 1)) == 0, "free-running indices need a power of two");
_Static_assert((OUTPUT_BYTES & (OUTPUT_BYTES - 1)) == 0, "free-running indices need a power of two");

static const uint64_t NS_PER_S = 1000000000;

// ------------------------------------------------------------------------------------------------- records

static uint32_t record_id(const uint8_t *record) {
    uint32_t id; // flags stand above the 11 bits
    memcpy(&id, record, sizeof(id));
    return id;
}

static bool is_frame(const uint8_t *record) {
    return record_id(record) <= ID_MAX && record[LENGTH_AT] <= DATA_MAX;
}

// Receivers see the fields of a frame and zeros, never what else the sender's memory held.
static void copy_frame(uint8_t *out, const uint8_t *record) {
    memset(out, 0, HUB_RECORD);
    memcpy(out, record, LENGTH_AT + 1);
    memcpy(out + DATA_AT, record + DATA_AT, record[LENGTH_AT]);
}

// ------------------------------------------------------------------------------------------------- queues

static uint32_t input_count(const struct hub_client *client) {
    return client->input_tail - client->input_head;
}

static const struct hub_frame *input_head(const struct hub_client *client) {
    return &client->input[client->input_head % HUB_INPUT];
}

static bool output_full(const struct hub_client *client) {
    return client->state == HUB_PRESENT &&
           client->output_tail - client->output_head > OUTPUT_BYTES - HUB_RECORD;
}

static void output_push(struct hub_client *client, const uint8_t *record) {
    // The tail is always at the begin of a record, so none is split by the end of the ring.
    memcpy(client->output + client->output_tail % OUTPUT_BYTES, record, HUB_RECORD);
    client->output_tail += HUB_RECORD;
    client->counters.received++;
}

// ------------------------------------------------------------------------------------------------- clients

void hub_init(struct hub *hub, const struct hub_config *config) {
    memset(hub, 0, sizeof(*hub));
    hub->config = *config;
    hub->random = config->seed;
    hub->loss_threshold = (uint64_t)(config->loss * 4294967296.0);
    hub->on_wire = -1;
}

int hub_connect(struct hub *hub) {
    for (int i = 0; i < HUB_CLIENTS; i++) {
        struct hub_client *client = &hub->clients[i];
        if (client->state == HUB_FREE) {
            hub->places = i < hub->places ? hub->places : i + 1;
            memset(client, 0, sizeof(*client));
            client->state = HUB_PRESENT;
            return i;
        }
    }
    hub->counters.refused++;
    return -1;
}

// CLIENT stops the bus no longer, which does not make up for the time it stood still.
static void unstick(struct hub *hub, struct hub_client *client, uint64_t now_ns) {
    if (client->stuck_ns == 0)
        return;
    client->stuck_ns = 0;
    hub->free_ns = hub->free_ns > now_ns ? hub->free_ns : now_ns;
}

void hub_leave(struct hub *hub, int client, uint64_t now_ns) {
    if (hub->clients[client].state != HUB_PRESENT)
        return;
    hub->clients[client].state = HUB_LEAVING;
    unstick(hub, &hub->clients[client], now_ns);
}

bool hub_finished(const struct hub *hub, int client) {
    const struct hub_client *gone = &hub->clients[client];
    return gone->state == HUB_EXPELLED || (gone->state == HUB_LEAVING && input_count(gone) == 0);
}

void hub_release(struct hub *hub, int client) {
    hub->clients[client].state = HUB_FREE;
}

// ------------------------------------------------------------------------------------------------- input

size_t hub_room(const struct hub *hub, int client) {
    const struct hub_client *from = &hub->clients[client];
    return (HUB_INPUT - input_count(from)) * HUB_RECORD - from->partial_size;
}

static void take_record(struct hub *hub, struct hub_client *from, uint64_t ready_ns) {
    if (!is_frame(from->partial)) {
        from->counters.rejected++;
        hub->counters.rejected++;
        return;
    }
    struct hub_frame *frame = &from->input[from->input_tail++ % HUB_INPUT];
    frame->ready_ns = ready_ns;
    copy_frame(frame->record, from->partial);
}

void hub_receive(struct hub *hub, int client, const uint8_t *data, size_t size, uint64_t now_ns) {
    struct hub_client *from = &hub->clients[client];
    if (from->state != HUB_PRESENT && from->state != HUB_LEAVING)
        return;
    // What had no room last time was ready then: it must not lose its place because of a late reader.
    uint64_t ready_ns = from->backlog_ns ? from->backlog_ns : now_ns;
    bool fills = size == hub_room(hub, client);
    while (size > 0) {
        size_t part = HUB_RECORD - from->partial_size;
        part = part < size ? part : size;
        memcpy(from->partial + from->partial_size, data, part);
        from->partial_size += (uint32_t)part;
        data += part;
        size -= part;
        if (from->partial_size == HUB_RECORD) {
            from->partial_size = 0;
            take_record(hub, from, ready_ns);
        }
    }
    from->backlog_ns = fills ? now_ns : 0;
}

// ------------------------------------------------------------------------------------------------- the bus

// splitmix64: every seed is a good one.
static uint32_t next_random(struct hub *hub) {
    uint64_t z = hub->random += 0x9E3779B97F4A7C15;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9;
    z = (z ^ z >> 27) * 0x94D049BB133111EB;
    return (uint32_t)((z ^ z >> 31) >> 32);
}

static bool takes_part(const struct hub_client *client) {
    return (client->state == HUB_PRESENT || client->state == HUB_LEAVING) && input_count(client) > 0;
}

// When the next frame can start, or HUB_NEVER.
static uint64_t next_start(const struct hub *hub) {
    uint64_t ready_ns = HUB_NEVER;
    for (int i = 0; i < hub->places; i++) {
        const struct hub_client *client = &hub->clients[i];
        if (takes_part(client) && input_head(client)->ready_ns < ready_ns)
            ready_ns = input_head(client)->ready_ns;
    }
    return ready_ns > hub->free_ns ? ready_ns : hub->free_ns;
}

// The client whose head wins among those ready at START_NS; there is at least one.
static int arbitrate(const struct hub *hub, uint64_t start_ns) {
    int winner = -1;
    uint32_t winner_id = UINT32_MAX;
    for (int k = 1; k <= hub->places; k++) {
        int i = (hub->last_winner + k) % hub->places; // the last winner comes last among equals
        const struct hub_client *client = &hub->clients[i];
        if (!takes_part(client))
            continue;
        const struct hub_frame *head = input_head(client);
        if (head->ready_ns <= start_ns && record_id(head->record) < winner_id) {
            winner = i;
            winner_id = record_id(head->record);
        }
    }
    return winner;
}

// Whether every receiver has room. Those who have not are held responsible from now on.
static bool all_have_room(struct hub *hub, int sender, uint64_t now_ns) {
    bool room = true;
    for (int i = 0; i < hub->places; i++) {
        struct hub_client *client = &hub->clients[i];
        if (i == sender || !output_full(client))
            continue;
        if (client->stuck_ns == 0)
            client->stuck_ns = now_ns;
        if (now_ns - client->stuck_ns >= hub->config.stuck_limit_ns) {
            client->state = HUB_EXPELLED;
            hub->counters.expelled++;
            unstick(hub, client, now_ns);
            continue;
        }
        room = false;
    }
    return room;
}

static void start_frame(struct hub *hub, int client, uint64_t start_ns) {
    const uint8_t *record = input_head(&hub->clients[client])->record;
    uint32_t bits = can_frame_bits(record_id(record), record[LENGTH_AT], record + DATA_AT);
    uint64_t duration_ns = 0;
    if (hub->config.bitrate) {
        // The rest of the division is carried on, so that no rate drifts by its rounding.
        uint64_t carry = start_ns == hub->free_ns ? hub->bit_carry : 0;
        uint64_t scaled = bits * NS_PER_S + carry;
        duration_ns = scaled / hub->config.bitrate;
        hub->bit_carry = scaled % hub->config.bitrate;
    }
    hub->on_wire = hub->last_winner = client;
    hub->free_ns = start_ns + duration_ns;
    hub->counters.frames++;
    hub->counters.bits += bits;
    hub->counters.busy_ns += duration_ns;
}

static void end_frame(struct hub *hub) {
    struct hub_client *sender = &hub->clients[hub->on_wire];
    const uint8_t *record = input_head(sender)->record;
    sender->counters.sent++;
    if (next_random(hub) < hub->loss_threshold) {
        hub->counters.lost++;
    } else {
        for (int i = 0; i < hub->places; i++)
            if (i != hub->on_wire && hub->clients[i].state == HUB_PRESENT)
                output_push(&hub->clients[i], record);
    }
    sender->input_head++;
    hub->on_wire = -1;
}

void hub_run(struct hub *hub, uint64_t now_ns) {
    for (;;) {
        if (hub->on_wire >= 0) {
            if (hub->free_ns > now_ns)
                return;
            end_frame(hub);
        }
        uint64_t start_ns = next_start(hub);
        if (start_ns > now_ns)
            return;
        int winner = arbitrate(hub, start_ns);
        if (!all_have_room(hub, winner, now_ns))
            return;
        // Expelling someone may have moved the time at which the bus was free.
        start_frame(hub, winner, start_ns > hub->free_ns ? start_ns : hub->free_ns);
    }
}

uint64_t hub_deadline(const struct hub *hub) {
    if (hub->on_wire >= 0)
        return hub->free_ns;
    uint64_t start_ns = next_start(hub);
    if (start_ns == HUB_NEVER)
        return HUB_NEVER;
    uint64_t expel_ns = HUB_NEVER;
    for (int i = 0; i < hub->places; i++) {
        const struct hub_client *client = &hub->clients[i];
        if (client->state == HUB_PRESENT && client->stuck_ns &&
            client->stuck_ns + hub->config.stuck_limit_ns < expel_ns)
            expel_ns = client->stuck_ns + hub->config.stuck_limit_ns;
    }
    return expel_ns == HUB_NEVER ? start_ns : expel_ns;
}

// ------------------------------------------------------------------------------------------------- output

size_t hub_output(const struct hub *hub, int client, const uint8_t **data) {
    const struct hub_client *to = &hub->clients[client];
    uint32_t at = to->output_head % OUTPUT_BYTES, size = to->output_tail - to->output_head;
    *data = to->output + at;
    return size < OUTPUT_BYTES - at ? size : OUTPUT_BYTES - at;
}

void hub_taken(struct hub *hub, int client, size_t size, uint64_t now_ns) {
    struct hub_client *to = &hub->clients[client];
    to->output_head += (uint32_t)size;
    if (size > 0)
        unstick(hub, to, now_ns);
}
