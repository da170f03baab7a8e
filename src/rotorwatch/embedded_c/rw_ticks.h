/* From what was sensed in a tick, and whether the vehicle flew, to what the estimator takes: as motion/ticks.py assembles a flight. */
#ifndef RW_TICKS_H
#define RW_TICKS_H

#include "rw_contact.h"
#include "rw_sense.h"
#include "rw_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Inputs of the estimator: thrusts [n] in hover thrusts; angular accelerations [3], rad/s^2; n times the load factor; angular rates [3],
   rad/s; side forces forward and right, m/s^2; full thrust of a rotor in hover thrusts; mode; 1 at the first tick of a flight, 2 at a
   contact. */
enum rw_input {
    RW_U_THRUST = 0,
    RW_U_RATE_DOT = RW_ROTORS,
    RW_U_LOAD = RW_ROTORS + 3,
    RW_U_RATE = RW_ROTORS + 4,
    RW_U_SIDE = RW_ROTORS + 7,
    RW_U_FULL = RW_ROTORS + 9,
    RW_U_MODE = RW_ROTORS + 10,
    RW_U_AGAIN = RW_ROTORS + 11,
    RW_INPUTS = RW_ROTORS + 12
};

/* Ticks in the first second of a flight, at most; ticks of tumbling after which it does not hover again. */
#define RW_SETTLING (2 * RW_TICKS_BEFORE + 4)

typedef struct {
    rw_contact contact;
    rw_time flight;             /* s, start of the flight that settles, RW_LASTS without; of the one that ticks were made of */
    rw_time hop;
    rw_real settling[RW_SETTLING]; /* share of full thrust over load factor */
    rw_real hover;              /* share of full thrust that carries the vehicle */
    int32_t learned;            /* ticks of controlled flight since the last contact of this flight, -1 without one */
    int16_t settled;            /* of `settling` */
    int16_t tumbling;           /* ticks in a row */
    bool gone;                  /* the vehicle has tumbled in this flight: what follows is a fall */
    bool begun;
} rw_ticks;

/* A tick, and what the estimator takes: u, y (commanded roll, pitch, yaw and thrust, hover thrusts), valid: which of y count. */
typedef struct {
    rw_tick tick;
    rw_real u[RW_INPUTS], y[RW_AXES];
    bool valid[RW_AXES];
    rw_touch touch;
} rw_made;

void rw_ticks_init(rw_ticks *s);

/* Before the first tick whose time is after the `start` of a flight is made: every sensed tick with start <= when < start + 1 s, in order.
   What carries the vehicle is learned from them. Not for a flight of less than a second. */
void rw_ticks_settle(rw_ticks *s, const rw_sensed *row, rw_time start);

/* One sensed tick, in order, on the ground too. start: of the flight that it lies in (time >= start + 1 s and when <= its end), RW_LASTS
   else. */
void rw_ticks_make(rw_ticks *s, const rw_vehicle *v, const rw_plan *p, const rw_sensed *row, rw_time start, rw_made *out);

#ifdef __cplusplus
}
#endif

#endif
