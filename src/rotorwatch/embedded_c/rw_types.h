/* What the parts of the diagnoser hand to each other: tick, estimate, event. Numbers, vehicle and plan are in rw_front.h.

   SI units. Body axes FRD: x forward, y right, z down. Rotors count from 0 here, as the autopilot's outputs do; a set of rotors is a mask
   whose bit k is rotor k. Thrusts are shares of full thrust unless a note says hover thrusts (1 carries the vehicle).
   rw_config.h, written by the export, says what the vehicle has:
     RW_ROTORS          how many rotors
     RW_PLACES          explanations that the estimator keeps side by side
     RW_HYPOTHESES      of the estimator, see rw_found
     RW_TICK_S          length of a tick, s
     RW_REACH           ticks that the estimator's bank looks back
     RW_OPPOSITE_PAIRS  pairs of rotors whose roll and pitch torques cancel, at least 1
     RW_MOTION_HZ       how often gyro and accelerometer are fed, Hz
     others             how much is kept: sizes of arrays in rw_front.h */
#ifndef RW_TYPES_H
#define RW_TYPES_H

#include "rw_front.h"

/* A set of rotors: bit k is rotor k. */
typedef uint16_t rw_rotors;
#if RW_ROTORS < 3 || RW_ROTORS > 16
#error "RW_ROTORS must be 3 to 16"
#endif

/* Rows of the effectiveness, and of all wrenches. */
#define RW_AXES 4
/* Numbers that the estimator takes of a tick: rw_made_inputs. */
#define RW_INPUTS (RW_ROTORS + 12)

/* What happened. */
enum rw_kind {
    RW_LOSS_OF_EFFECTIVENESS = 0, /* a rotor makes less thrust than its command asks for */
    RW_OUTPUT_OVERRIDE = 1,       /* an output does not follow the mixer: nothing is wrong with the rotor */
    RW_CONTACT = 2                /* something outside the vehicle pushed it */
};

/* What can be said at this moment. */
enum rw_verdict {
    RW_NOT_JUDGED = 0, /* not in the air for long enough yet */
    RW_HEALTHY = 1,    /* healthy so far */
    RW_FAULT = 2,      /* something happened, and to which rotor or output */
    RW_AMBIGUOUS = 3   /* something happened; several sets of rotors explain it */
};

/* One tick of the front end. */
typedef struct {
    rw_time time;         /* s, when everything in it was known */
    rw_time command_time; /* s, mean time of its commands */
    rw_time air_start;    /* s, since when the vehicle flies; RW_LASTS on the ground */
    int8_t mode;          /* RW_GROUND, RW_LEARN or RW_JUDGE */
    bool restart;         /* first tick of a flight */
    bool upset;           /* the vehicle tumbles, or has done so since it took off */
} rw_tick;

/* What the estimator made of that tick: its outputs as they are. Arrays row by row; H hypotheses: RW_ROTORS singles, then the pairs 0+1,
   0+2 ..., then RW_ROTORS recoveries, then disturbances. */
typedef struct {
    const rw_real *theta;       /* [n] loss, 0 healthy to 1 dead */
    const rw_real *theta_sd;    /* [n] its standard deviation */
    const bool *active;         /* [RW_PLACES * n] weak rotors of every explanation, the leader first */
    const rw_real *share;       /* [RW_PLACES] probability of every explanation */
    const rw_real *probability; /* [H] read where something is announced */
    const rw_real *log_odds;    /* [H] read where opposite rotors are suspected */
    const rw_real *onsets;      /* [RW_PLACES] ticks since the last jump of each explanation's rotors, after the step */
    rw_real since;              /* the same of the leader, as the tick says it */
    rw_real opposite_onset;     /* ticks since the shift that may be opposite rotors */
    rw_real opposite_loss[2];   /* loss of these */
    int32_t opposite;           /* hypothesis of them, -1 without */
    bool announced;             /* explanations were made at this tick */
} rw_found;

/* Sets of rotors that an event names beside its own at most. */
#define RW_ALTERNATIVES (RW_PLACES + 2 + RW_OPPOSITE_PAIRS)

/* Rotors that one announcement names at most. */
#if RW_ROTORS < 4
#define RW_TOGETHER RW_ROTORS
#else
#define RW_TOGETHER 4
#endif

/* One event. loss, lower, upper are of the rotors of the set in their order. */
typedef struct {
    rw_time onset;        /* s, when it began */
    rw_time detected;     /* s, when that was known */
    rw_time end;          /* s, RW_LASTS while it lasts */
    rw_real loss[RW_TOGETHER];      /* of effectiveness, 0 to 1 */
    rw_real lower[RW_TOGETHER];     /* 95 % interval */
    rw_real upper[RW_TOGETHER];
    rw_real probability;  /* of this set of rotors */
    rw_real size;         /* of a contact: g, or hover thrusts of one rotor where it turned the vehicle */
    rw_rotors rotors;     /* 0 of a contact */
    rw_rotors alternatives[RW_ALTERNATIVES]; /* sets that would look the same, the likeliest first */
    uint8_t alternative_count;
    uint8_t kind;         /* enum rw_kind */
    uint8_t detail;       /* of an override: RW_STUCK, RW_OFF, RW_OVERRIDDEN; of a contact: RW_TURNED, RW_PUSHED_SIDEWAYS, RW_PUSHED_UP */
} rw_event;

#endif
