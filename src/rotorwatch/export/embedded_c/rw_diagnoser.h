/* The whole: samples in, events out. Which rotor lost effectiveness, how much, since when, how sure.

   Feed every sample in the order of its time, of all kinds together, then poll. Feeding a sample of time t says that all older ones have
   come. The assessment of a moment is final, but for events that a poll reports as changed or withdrawn: ticks that may still turn out to lie on
   the ground (a descent on little thrust, a knock) wait until that is known, up to some seconds, and are assessed then.

     static rw_diagnoser d;
     rw_diagnoser_init(&d, &rw_vehicle_default, &rw_plan_default);
     rw_diagnoser_gyro(&d, t, rate, true); ... rw_diagnoser_outputs(&d, t, output, all, 1);
     int n = rw_diagnoser_poll(&d, notifications);

   Nothing is allocated and nothing global changes: any number of them can run at once. A feed does all the work that is due by its
   sample. Where no call may take long, the samples are put in line, and the work is done in pieces, with the same results to the bit:

     rw_diagnoser_defer(&d);
     rw_diagnoser_gyro(&d, t, rate, true); ...
     while (micros() - begin < budget && rw_diagnoser_work(&d)) {}

   Ticks that have waited are worked off three times as fast as they come, at a landing, too: no call takes more than one of them. */
#ifndef RW_DIAGNOSER_H
#define RW_DIAGNOSER_H

#include "rw_engine.h"

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/* A set of rotors: bit k is rotor k, from 0. */
typedef uint16_t rw_rotors;
#if RW_ROTORS < 3 || RW_ROTORS > 16
#error "RW_ROTORS must be 3 to 16"
#endif

/* Characters of a text with the 0 at its end, as long as a MAVLink STATUSTEXT. */
#define RW_TEXT 51

/* A change of an event. event: as it is now, or as it was where it is withdrawn. */
typedef struct {
    const rw_event *event;
    uint16_t number; /* from 1, of the event for as long as it is remembered */
    uint8_t kind;    /* RW_ANNOUNCED, RW_CHANGED, RW_WITHDRAWN */
} rw_notification;

/* A sample that waits in line, and how many numbers it has at most. */
#define RW_NUMBERS (RW_ROTORS > 4 ? RW_ROTORS : 4)
typedef struct {
    rw_time time;
    int32_t kind;
    rw_real x[RW_NUMBERS];
} rw_sample;

/* One vehicle; what is known of it may stay in flash. */
typedef struct {
    const rw_vehicle *vehicle;
    const rw_plan *plan;
    rw_engine engine;
    volatile rw_sample line[RW_SAMPLES + 1];
    volatile uint16_t first, next; /* of the line */
    volatile uint32_t lost;
    bool deferred;
} rw_diagnoser;

/* Of rw_config.c: the vehicle, what is known of it before take-off, and the rates that the library was exported for. */
extern const rw_vehicle rw_vehicle_default;
extern const rw_plant rw_plant_default;
extern const rw_plan rw_plan_default;

/* v and p must outlive d. */
void rw_diagnoser_init(rw_diagnoser *d, const rw_vehicle *v, const rw_plan *p);

/* Its size, for a caller who has the memory only where it is wanted: rw_diagnoser_init of a block of so many bytes, aligned for a double. */
size_t rw_diagnoser_size(void);

/* From now on samples are only put in line, RW_SAMPLES of them at most; more are lost, and counted. One thread may feed while another
   one of the same core does all the rest; a feed takes no time to speak of. */
void rw_diagnoser_defer(rw_diagnoser *d);
uint32_t rw_diagnoser_lost(const rw_diagnoser *d);

/* A piece of the work that is due by the samples in line; false where there is none. Events and losses do not depend on when it is called. */
bool rw_diagnoser_work(rw_diagnoser *d);

/* Times of all feeds: seconds of one steady clock, such as that since boot, never that of the day; call them in the order of time.
   A sample with a number that is not finite counts as not valid, but for the velocity: NaN there says that it is not known. */

/* Angular rate [3], rad/s; specific force [3], m/s^2, -9.8 along z at rest; both body FRD. */
void rw_diagnoser_gyro(rw_diagnoser *d, rw_time time, const rw_real *rate, bool valid);
void rw_diagnoser_accel(rw_diagnoser *d, rw_time time, const rw_real *force, bool valid);

/* Outputs [n] to the motors in the unit of rw_vehicle.u_min, u_max; known: mask of those that are valid. */
void rw_diagnoser_outputs(rw_diagnoser *d, rw_time time, const rw_real *output, rw_rotors known);

/* What the rate controller demands of the mixer [4], where it is known: roll, pitch, yaw, throttle. */
void rw_diagnoser_control(rw_diagnoser *d, rw_time time, const rw_real *control, bool valid);

/* Where they are known: filtered battery voltage as a share of full; attitude [4], body to world, scalar first; velocity [3], north, east,
   down, m/s, or climb rate and horizontal speed alone, which do not say how the air meets the rotors; whether the autopilot reports landed, armed: 1 or 0, -1: nothing new. */
void rw_diagnoser_battery(rw_diagnoser *d, rw_time time, rw_real ratio);
void rw_diagnoser_attitude(rw_diagnoser *d, rw_time time, const rw_real *q);
void rw_diagnoser_velocity_ned(rw_diagnoser *d, rw_time time, const rw_real *velocity);
void rw_diagnoser_velocity(rw_diagnoser *d, rw_time time, rw_real climb, rw_real speed);
void rw_diagnoser_state(rw_diagnoser *d, rw_time time, int landed, int armed);

/* All samples up to `time` s have come and nothing comes after them: the end of a log. */
void rw_diagnoser_finish(rw_diagnoser *d, rw_time time);

/* What is new since the last poll, into notifications[2 * RW_EVENTS]; returns how many. Its events stay until the next poll. */
int rw_diagnoser_poll(rw_diagnoser *d, rw_notification *notifications);

/* After a poll: all events; the place of the one that matters most, or -1; the verdict: RW_NOT_ASSESSED, RW_HEALTHY, RW_FAULT or
   RW_AMBIGUOUS, and in a word or two: "healthy so far". */
int rw_diagnoser_events(const rw_diagnoser *d, const rw_event **events);
int rw_diagnoser_main(const rw_diagnoser *d);
int rw_diagnoser_verdict(const rw_diagnoser *d);
const char *rw_diagnoser_verdict_text(const rw_diagnoser *d);

/* Loss of a rotor, from 0, as the estimator has it now: 0 healthy to 1 dead. */
rw_real rw_diagnoser_loss(const rw_diagnoser *d, int rotor);

/* What control allocation may rely on, as of the last poll: effectiveness with its interval, rotors to leave out, the odds of that decision.
   It does not flap: see rw_engine.h. `revision` changes with it. */
const rw_reliance *rw_diagnoser_reliance(const rw_diagnoser *d);

/* The mixer for that, into factors[4 * RW_ROTORS]: thrust of each rotor, a row each, for a unit of the rate controller's roll, pitch, yaw
   and throttle, by which the vehicle answers as it does healthy by rw_vehicle.mixer. RW_TURNS; RW_LEVEL, where yaw has to be given up; or RW_UNABLE, where it must not be used. */
int rw_diagnoser_factors(const rw_diagnoser *d, rw_real *factors);

/* "rotorwatch: rotor 3 lost 32 % (28-36)" into text[RW_TEXT]; returns its severity: RW_CRITICAL, RW_WARNING or RW_NOTICE. */
int rw_diagnoser_words(const rw_notification *notification, char *text);

#ifdef __cplusplus
}
#endif

#endif
