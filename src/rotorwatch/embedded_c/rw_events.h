/* Losses of effectiveness from the estimator's ticks: what was announced, when it began, what became of it and how sure that is.

   What happened, and which explanations are left, is the estimator's; this only writes it down, as rotorwatch's default/events.py does
   of a whole flight. Nothing is looked up in the flight behind: of the ticks only those that the estimator's bank reaches are kept, and of
   the estimates of a weak rotor at most RW_ESTIMATES. An event may change until its flight is over: the explanation that leads may be
   overtaken (other rotors, or none: then it is no longer in the list). */
#ifndef RW_EVENTS_H
#define RW_EVENTS_H

#include "rw_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Losses that are kept, of all flights since rw_events_init; of more, those that ended first are forgotten. */
#ifndef RW_RECORDS
#define RW_RECORDS (2 * RW_ROTORS + 4)
#endif
/* Estimates of each rotor that say what a loss was that is over: default/events.py, ESTIMATES. */
#define RW_ESTIMATES 16
/* Ticks whose times are kept: as far as the bank reaches, and by what commands are older than their tick. */
#define RW_TICKS_KEPT (RW_REACH + 16)
/* Sets of rotors that one record weighs: of the explanations, or of all opposite pairs. */
#if RW_OPPOSITE_PAIRS > RW_PLACES
#define RW_SETS RW_OPPOSITE_PAIRS
#else
#define RW_SETS RW_PLACES
#endif

/* One loss of rotors that failed together and, as far as they did, ended together. */
typedef struct {
    rw_time onset, detected;
    rw_time end;                /* RW_LASTS while it lasts */
    rw_real loss[RW_TOGETHER];  /* of one that is over, and of a suspicion */
    rw_real sd[RW_TOGETHER];    /* of one that is over */
    rw_real share[RW_SETS];     /* probability of each of `sets` */
    rw_rotors sets[RW_SETS];    /* that may have failed, the record's own among them */
    rw_rotors rotors;
    rw_rotors hiding;           /* each of these may have failed together with rotor `hider`: the data do not say */
    uint8_t hider;
    uint8_t count;              /* of `sets` */
    bool suspicion;             /* a shift of thrust that opposite rotors share, or something else */
} rw_record;

/* The records, in the order in which they were made. */
typedef struct {
    rw_record records[RW_RECORDS];
    int8_t of[RW_ROTORS]; /* record of each weak rotor, -1 without */
    int8_t suspicion;     /* last record of a suspicion, -1 without */
    int8_t asked;         /* the same when the last announcement was made */
    uint8_t count;
    uint16_t forgotten;   /* records that found no room */
} rw_book;

/* Explanations as they were after a tick; the leader's set of rotors is active[0]. */
typedef struct {
    rw_time found;              /* s, since when this set leads */
    rw_real share[RW_PLACES];
    int32_t onset;              /* tick of the leader's last jump */
    rw_rotors active[RW_PLACES];
} rw_standing;

/* Estimates of one rotor, evenly spaced. */
typedef struct {
    int32_t tick[RW_ESTIMATES];
    rw_real theta[RW_ESTIMATES], sd[RW_ESTIMATES];
    uint32_t seen, step; /* judged ticks so far, and from one that is kept to the next */
    uint8_t kept;
} rw_course;

/* When what leads may have begun: tick of the jump, time of its commands, and last tick before that time. */
typedef struct {
    rw_time onset;
    int32_t tick, before;
} rw_onset;

typedef struct {
    rw_book book;                   /* what is settled: all before the last announcement */
    rw_standing latest, judged;     /* after the last tick, and after the last that was judged */
    rw_course courses[RW_ROTORS];
    rw_course then[RW_ROTORS];      /* the same before the last announcement */
    rw_onset onsets[RW_PLACES];     /* of the last announcement */
    rw_time time[RW_TICKS_KEPT];    /* ring by tick */
    rw_real age[RW_TICKS_KEPT];     /* s, by which commands are older than their tick */
    rw_time first_onset, judged_time;
    rw_real theta[RW_ROTORS], sd[RW_ROTORS]; /* at the last judged tick */
    int32_t tick, first;            /* number of the last tick, -1 before; of the first of this flight */
    rw_rotors before;               /* weak rotors before the last announcement */
    rw_rotors hiding;               /* as in rw_record, of the last announcement */
    uint8_t hider;
    bool announced;                 /* something has been in this flight */
    bool flown;                     /* a tick of this flight was judged */
} rw_events;

void rw_events_init(rw_events *s);

/* One more tick, in their order, on the ground as well, and what the estimator made of it. */
void rw_events_tick(rw_events *s, const rw_vehicle *v, const rw_tick *tick, const rw_found *found);

/* The losses so far, in the order in which they were noticed, into out[RW_RECORDS]; returns how many. */
int rw_events_losses(const rw_events *s, const rw_vehicle *v, rw_event *out);

#ifdef __cplusplus
}
#endif

#endif
