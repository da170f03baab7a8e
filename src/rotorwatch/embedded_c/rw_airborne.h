/* When the vehicle is in the air, from outputs, motion and the autopilot's own words: a walk over ticks of 0.05 s that only looks back.

   Start: the command is well above idle and the vehicle climbs or moves; or the command is high for long. End: the command stays low while
   the vehicle neither falls nor sinks fast, at once where the autopilot says landed or disarmed; or something other than the rotors
   carries the vehicle. A flight ends where the landing or the fall began to show, up to 4.5 s (mostly 1.5 s) before that is certain: what
   was judged since then has to be taken back. Samples of all kinds come in time order; ticks before a sample are walked first. */
#ifndef RW_AIRBORNE_H
#define RW_AIRBORNE_H

#include "rw_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* s, at most, by which an end lies before the moment at which it is known. */
#define RW_CONFIRM_S 4.5
/* Flights that are kept, the last ones. */
#ifndef RW_FLIGHTS
#define RW_FLIGHTS 4
#endif
/* Samples of half a second. */
#define RW_HALF_SECOND (RW_MOTION_HZ / 2 + 2)

/* What is known at one tick; NaN: not known. */
typedef struct {
    rw_real command; /* root mean square of the outputs, share of their range */
    rw_real climb;   /* m/s up */
    rw_real speed;   /* m/s, horizontal */
    rw_real force;   /* m/s^2, magnitude of the specific force, mean of half a second */
    rw_real upward;  /* m/s^2, its part along the rotors' thrust, the same */
    rw_real turning; /* rad/s, magnitude of the angular rate, the same */
    bool struck;     /* a specific force, just now, that rotors cannot make */
    int8_t landed;   /* the autopilot's last word: 1 or 0, -1 before the first */
    int8_t armed;
} rw_senses;

/* Half a second of a vector's magnitude, and of its part along the rotors' thrust; NaN where it is not known. */
typedef struct {
    rw_time time[RW_HALF_SECOND];
    rw_real size[RW_HALF_SECOND], upward[RW_HALF_SECOND];
    int16_t first, count;
} rw_half_second;

typedef struct {
    /* The walk */
    rw_half_second force, turning;
    double tick;           /* number of the next one */
    rw_time velocity_time; /* -RW_LASTS before the first */
    rw_time blow;          /* the last force that rotors cannot make */
    rw_time last;          /* of the outputs */
    rw_real climb, speed, command;
    int8_t landed, armed;
    bool walking; /* there are outputs */
    bool down;    /* it has said since the last output that it is on the ground */
    /* Who says whether it flies */
    rw_time since, high_since, low_since, lying_since; /* RW_LASTS: not so */
    rw_time first_blow, last_blow;
    rw_real idle, floor, hover, drift, height;
    bool idle_known, flying;
    /* Flights that are over; start: of the one that goes on, RW_LASTS on the ground */
    struct {
        rw_time start, end;
    } flights[RW_FLIGHTS];
    rw_time start;
    uint8_t flight_count;
} rw_airborne;

void rw_airborne_init(rw_airborne *a);

/* Outputs [n] at `time` s; valid: mask of those that were logged. */
void rw_airborne_outputs(rw_airborne *a, const rw_vehicle *v, rw_time time, const rw_real *output, rw_rotors valid);

/* Specific force [3], body FRD, m/s^2. */
void rw_airborne_accel(rw_airborne *a, rw_time time, const rw_real *force, bool valid);

/* Angular rate [3], body FRD, rad/s. */
void rw_airborne_gyro(rw_airborne *a, rw_time time, const rw_real *rate, bool valid);

/* Climb rate and horizontal speed, m/s; NaN: not known. */
void rw_airborne_velocity(rw_airborne *a, rw_time time, rw_real climb, rw_real speed);

/* The autopilot says that it has landed, or is armed: 1 or 0; -1: as before. */
void rw_airborne_state(rw_airborne *a, rw_time time, int landed, int armed);

/* All samples up to `time` s have come. */
void rw_airborne_until(rw_airborne *a, rw_time time);

/* The end of flight i of those that are over, s. */
rw_time rw_airborne_end(const rw_airborne *a, int i);

#ifdef __cplusplus
}
#endif

#endif
