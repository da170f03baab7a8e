/* Outputs that part from the mixer: stuck at a value, off, or driven by something else. Sample by sample; times are non-decreasing.

   Two ways: each output against what the mixer asks of it (compared), and outputs alone (logged): one that is off, or does not move while
   all others fly and move. Loss of effectiveness never shows here: the commands are what is compared. */
#ifndef RW_DEPARTURES_H
#define RW_DEPARTURES_H

#include "rw_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Spells that are kept; of more, those that ended first are forgotten. */
#ifndef RW_OVERRIDES
#define RW_OVERRIDES (2 * RW_ROTORS)
#endif
/* Outputs of the last half second. */
#define RW_RECENT (RW_OUTPUT_HZ / 2 + 2)
/* Ways to find a spell: against the mixer; by the output alone: it does not move, is below its minimum, rests at its minimum. */
enum rw_way { RW_WAY_MIXER = 0, RW_WAY_STILL = 1, RW_WAY_BELOW = 2, RW_WAY_RESTS = 3, RW_WAYS = 4 };

/* One sample of outputs with what the mixer asks for, all in shares of full thrust but `output`. */
typedef struct {
    rw_time time;                 /* s, of the outputs */
    rw_time known;                /* s, when the mixer's inputs around it had come */
    rw_real demand[RW_ROTORS];    /* thrust of the outputs by the mixer's own curve */
    rw_real asked[RW_ROTORS];     /* what the mixer asks for, as if outputs had no limits */
    rw_real yaw[RW_ROTORS];       /* the part of `asked` that is for yaw */
    rw_real deviation[RW_ROTORS]; /* demand minus asked within the limits */
    rw_real output[RW_ROTORS];    /* in the outputs' unit */
    rw_real top;                  /* thrust of u_max */
    bool yaw_granted;             /* the mixer grants all of the yaw */
} rw_comparison;

/* A spell of an output that departs. */
typedef struct {
    rw_time onset;    /* s */
    rw_time detected; /* s */
    rw_time end;      /* s, RW_LASTS while it lasts */
    rw_real output;   /* where it was when it was noticed */
    rw_real asked;    /* share of full thrust that the mixer asked for then; negative where nothing says what it asks for */
    uint8_t rotor, kind, way; /* from 0; enum rw_departure; enum rw_way */
} rw_override;

/* A value that has stayed near `anchor` since. */
typedef struct {
    rw_time since;
    rw_real anchor;
    bool set;
} rw_rest;

/* What may become a spell, or is one. */
typedef struct {
    rw_time onset, well; /* RW_LASTS: none */
    rw_real low, high;
    int16_t count; /* samples in it, up to what is asked for */
    int8_t open;   /* place in `spells`, -1 without */
} rw_run;

typedef struct {
    rw_run runs[RW_WAYS][RW_ROTORS];
    rw_rest still[RW_ROTORS], rest[RW_ROTORS], alone[RW_ROTORS];
    rw_time last; /* of the comparisons */
    rw_real own[RW_ROTORS], own_at_rest[RW_ROTORS];
    double power, unexplained, all; /* sums over the whole flight: single precision would stop growing */
    uint32_t fitted, compared;
    rw_time recent_time[RW_RECENT];
    rw_real recent[RW_RECENT][RW_ROTORS];
    int16_t recent_first, recent_count;
    rw_override spells[RW_OVERRIDES];
    uint8_t spell_count;
    uint16_t forgotten; /* spells that found no room */
} rw_departures;

void rw_departures_init(rw_departures *s);

/* One more comparison; aloft: the vehicle flew then. */
void rw_departures_compared(rw_departures *s, const rw_vehicle *v, const rw_comparison *c, bool aloft);

/* One more sample of outputs [n] at `time` s, and the thrusts [n] of these; valid: all of them were logged. */
void rw_departures_logged(rw_departures *s, const rw_vehicle *v, rw_time time, const rw_real *output, const rw_real *thrust, bool valid,
                          bool aloft);

/* The vehicle was on the ground already at the samples that were taken back: times in s of the first comparison and of the first outputs
   among them, RW_LASTS without. What lasted until then ends there, as it would have had that been known. */
void rw_departures_landed(rw_departures *s, rw_time compared, rw_time logged);

/* The overrides so far, in the order in which they were noticed, into out[RW_OVERRIDES]; returns how many. */
int rw_departures_found(const rw_departures *s, const rw_vehicle *v, rw_override *out);

#ifdef __cplusplus
}
#endif

#endif
