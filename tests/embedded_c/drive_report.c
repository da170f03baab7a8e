/* Rows of doubles from stdin to rw_report, rw_changes and rw_text. kind 0: a tick; 1: landed; 2: a contact; 3: what has happened so far,
   with losses and overrides as they are then: prints events, verdict, the main one, and news with their texts. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rows.h"
#include "rw_text.h"

static rw_report report;
static rw_changes changes;

static void tell(void)
{
    static rw_event losses[RW_EVENTS], events[RW_EVENTS], gone[RW_EVENTS];
    static rw_override overrides[RW_OVERRIDES];
    static rw_news news[2 * RW_EVENTS];
    const rw_time settled = one();
    const bool judged = one() > 0.5;
    const int loss_count = (int)one();
    for (int i = 0; i < loss_count; i++) {
        rw_event *e = &losses[i];
        memset(e, 0, sizeof *e);
        e->onset = one();
        e->detected = one();
        e->end = one();
        for (int k = 0; k < 2; k++) {
            e->loss[k] = (rw_real)one();
            e->lower[k] = (rw_real)one();
            e->upper[k] = (rw_real)one();
        }
        e->rotors = (rw_rotors)one();
        e->alternative_count = (uint8_t)one();
        for (int k = 0; k < e->alternative_count; k++) e->alternatives[k] = (rw_rotors)one();
    }
    const int override_count = (int)one();
    for (int i = 0; i < override_count; i++) {
        rw_override *o = &overrides[i];
        memset(o, 0, sizeof *o);
        o->rotor = (uint8_t)one();
        o->kind = (uint8_t)one();
        o->onset = one();
        o->detected = one();
        o->end = one();
    }
    const int count = rw_report_events(&report, losses, loss_count, overrides, override_count, events);
    printf("found\n%d %d\n", rw_report_verdict(events, count, judged), rw_report_main(events, count));
    for (int i = 0; i < count; i++) {
        const rw_event *e = &events[i];
        printf("event %d %d %.17g %.17g %.17g %.9g\n", e->kind, e->rotors, e->onset, e->detected, e->end, (double)e->size);
    }
    const int told = rw_changes_of(&changes, events, count, settled, gone, news);
    for (int i = 0; i < told; i++) {
        char text[RW_TEXT];
        const int length = rw_text_words(&news[i], text);
        printf("news %d %d %d %d|%s\n", news[i].kind, news[i].number, rw_text_severity(&news[i]), length, text);
    }
}

int main(void)
{
    double kind;
    rw_report_init(&report);
    rw_changes_init(&changes);
    while (fread(&kind, sizeof kind, 1, stdin) == 1) {
        if (kind < 0.5) {
            rw_tick tick;
            memset(&tick, 0, sizeof tick);
            tick.time = one();
            tick.air_start = one();
            tick.upset = one() > 0.5;
            rw_report_tick(&report, &tick);
        } else if (kind < 1.5) {
            rw_report_landed(&report, one());
        } else if (kind < 2.5) {
            const rw_time time = one();
            const int push = (int)one();
            rw_report_contact(&report, time, push, (rw_real)one());
        } else {
            tell();
        }
    }
    return 0;
}
