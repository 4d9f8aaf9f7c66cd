// SPDX-License-Identifier: Apache-2.0
// The states of a link as a table: the only place that defines which state follows which. docs/link-states.md
// is generated from it.
#include "nodes/link/core/link.h"

enum link_state link_following(enum link_state state, enum link_event event) {
    static const uint8_t following[LINK_STATES][LINK_EVENTS] = {
        //                   TAKEN            REFUSED          SILENCE
        [LINK_PROBING] = {LINK_CONFIRMING, LINK_CONFIRMING, LINK_LOST},
        [LINK_CONFIRMING] = {LINK_RUNNING, LINK_CONFIRMING, LINK_LOST},
        [LINK_RUNNING] = {LINK_RUNNING, LINK_RUNNING, LINK_LOST},
        [LINK_LOST] = {LINK_LOST, LINK_LOST, LINK_LOST},
    };
    return (enum link_state)following[state][event];
}
