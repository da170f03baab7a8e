/* One list of all that happened, out of losses, overrides and contacts; what is new about it; and what can be said at this moment.

   A loss that begins while an output is overridden is the override, or what that does to the others. An override that begins in the fall
   that ends a flight, and a contact within a second of its end, are the fall and the landing. */
#ifndef RW_REPORT_H
#define RW_REPORT_H

#include "rw_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Contacts and falls that are kept, the last ones; events in one list, the last ones. */
#ifndef RW_CONTACTS
#define RW_CONTACTS 4
#endif
#ifndef RW_FALLS
#define RW_FALLS 4
#endif
#ifndef RW_EVENTS
#define RW_EVENTS 12
#endif

typedef struct {
    rw_time time;
    rw_real size;
    uint8_t push; /* RW_TURNED and so on */
} rw_knock;

typedef struct {
    struct {
        rw_time start, end;
    } falls[RW_FALLS];
    rw_knock knocks[RW_CONTACTS];
    rw_time air_start;  /* of the flight that goes on, RW_LASTS on the ground */
    rw_time fall_start; /* since when it tumbles, RW_LASTS where it does not */
    rw_time landed;     /* end of the last flight, -RW_LASTS before */
    rw_time now;        /* time of the last tick */
    uint8_t fall_count, knock_count;
} rw_report;

void rw_report_init(rw_report *r);

/* The next tick; its air_start is that of the flight it belongs to, up to one tick after its end. */
void rw_report_tick(rw_report *r, const rw_tick *tick);

/* The flight ended at `end` s. */
void rw_report_landed(rw_report *r, rw_time end);

/* Something pushed the vehicle at `time` s (RW_TURNED and so on), so much; the same time again: it was more. */
void rw_report_contact(rw_report *r, rw_time time, int push, rw_real size);

/* All events into out[RW_EVENTS], in the order in which they were detected; returns how many. losses: of rw_events_losses; overrides: of
   rw_deviations_found. */
int rw_report_events(const rw_report *r, const rw_event *losses, int loss_count, const rw_override *overrides, int override_count,
                     rw_event *out);

/* What can be said; judged: at least one tick has been judged. */
enum rw_verdict rw_report_verdict(const rw_event *events, int count, bool judged);

/* The event that matters most, or -1: sure ones before ambiguous ones; the first that is large, or an override that came before it. */
int rw_report_main(const rw_event *events, int count);

/* What is new about the list of events. */
enum rw_news_kind { RW_ANNOUNCED = 0, RW_CHANGED = 1, RW_WITHDRAWN = 2 };

/* An event as it was told last; number: from 1, of the event for as long as it is remembered. */
typedef struct {
    rw_event event;
    uint16_t number;
} rw_told;

typedef struct {
    rw_told told[RW_EVENTS];
    uint16_t numbers;
    uint8_t count;
} rw_changes;

/* One change; event: as it is now, or as it was told where it is withdrawn. */
typedef struct {
    const rw_event *event;
    uint16_t number;
    uint8_t kind; /* enum rw_news_kind */
} rw_news;

void rw_changes_init(rw_changes *c);

/* What is worth telling of the events as they are now, into news[2 * RW_EVENTS]; returns how many. gone[RW_EVENTS]: room for those that
   are withdrawn. settled: time in s before which nothing is taken back; an event that ended before and is missing was forgotten, not
   withdrawn. */
int rw_changes_of(rw_changes *c, const rw_event *events, int count, rw_time settled, rw_event *gone, rw_news *news);

#ifdef __cplusplus
}
#endif

#endif
