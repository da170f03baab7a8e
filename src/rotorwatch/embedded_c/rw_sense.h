/* From samples to ticks: commands, motion and side force of every tick, as motion/ticks.py senses them. A tick is told as soon as its
   last motion has been sampled; it needs nothing that is sampled later. */
#ifndef RW_SENSE_H
#define RW_SENSE_H

#include "rw_contact.h"
#include "rw_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* The fastest rates at which gyro and accelerometer are fed, Hz: of rw_config.h. Faster samples are averaged by who feeds them. */
#ifndef RW_GYRO_HZ
#define RW_GYRO_HZ 100
#endif
#ifndef RW_ACCEL_HZ
#define RW_ACCEL_HZ 100
#endif
/* Samples that are kept: 0.4 s of the gyro, 0.9 s of the accelerometer; ticks that may wait for motion; attitudes. */
#define RW_GYRO_KEPT (RW_GYRO_HZ * 4 / 10 + 4)
#define RW_ACCEL_KEPT (RW_ACCEL_HZ * 9 / 10 + 4)
#define RW_WAITING 8
#define RW_LEVELS 8

/* How a flight is cut into ticks; const, it may stay in flash. motion/ticks.py, Plan. */
typedef struct {
    rw_time dt;             /* s, length of a tick */
    rw_time lag;            /* s, by which motion follows commands */
    rw_time phase;          /* s, of the ticks' ends; 0 but for commands as slow as ticks */
    rw_time ready;          /* s after lift-off, before which nothing is judged */
    rw_time gyro_half;      /* s, half of the time over which it is averaged */
    rw_time accel_half;
    int16_t gyro_least;     /* samples in that time, below which it is not known */
    int16_t accel_least;
    int16_t side_least;     /* the same of half a second of the accelerometer */
    rw_real hover;          /* share of full thrust that carries the vehicle, where healthy flights have told, else 0 */
    bool gyro, accel;       /* there is one */
    bool rebuilt;           /* thrusts come from the rate controller's output, which is fed faster than the outputs */
} rw_plan;

/* A tick as it was sensed. */
typedef struct {
    rw_time time;               /* s, when everything in it is known */
    rw_time when;               /* s, mean time of its commands */
    int32_t number;             /* ticks are numbered from the first command on; in a long gap some are left out */
    rw_real share[RW_ROTORS];   /* mean share of full thrust */
    rw_real rate[3];            /* angular rate, rad/s */
    rw_real rate_dot[3];        /* angular acceleration, rad/s^2 */
    rw_real load;               /* specific force up over g */
    rw_real push[2];            /* specific force forward and right, of this tick, m/s^2 */
    rw_real side[2];            /* the same over half a second; 0 where not known */
    rw_real shake;              /* vibration so far, m/s^2 */
    rw_real level;              /* cosine of the tilt, 1 where it is not known */
    bool some;                  /* there were commands */
    bool rate_ok, load_ok;      /* these are known */
} rw_sensed;

/* Samples of which the last are kept; `first` is the oldest. */
typedef struct {
    rw_time start;              /* s, of the first sample of all */
    int16_t first, count;
} rw_ring;

typedef struct {
    rw_time gyro_time[RW_GYRO_KEPT], accel_time[RW_ACCEL_KEPT], level_time[RW_LEVELS];
    rw_real gyro[RW_GYRO_KEPT][3], accel[RW_ACCEL_KEPT][3], level[RW_LEVELS];
    struct {
        double when;            /* s, sum since the end of the first tick */
        rw_real sum[RW_ROTORS];
        int32_t number;
        int16_t count;
    } bins[RW_WAITING];         /* by number of the tick */
    rw_ring gyros, accels, levels;
    rw_time origin;             /* s, end of tick 0 */
    rw_vibration vibration;
    double before[3];           /* sum of the accelerometer over the half second before the next sample of the vibration */
    int16_t fed, tail;          /* of the kept samples: how many the vibration has had; where that half second begins */
    int32_t next, last;         /* number of the next tick to be told, and of the last whose commands are complete; -1: none */
    int32_t commanded;          /* number of the last tick that commands have completed */
    int32_t gap_from, gap_to;   /* ticks that are left out */
    bool begun;
} rw_sense;

void rw_sense_init(rw_sense *s);

/* Thrusts [n] that were commanded at `time` s, shares of full thrust; ok: all are known. */
void rw_sense_thrust(rw_sense *s, const rw_plan *p, rw_time time, const rw_real *thrust, bool ok);

/* Angular rate [3], rad/s. Specific force [3], m/s^2. Cosine of the tilt. Samples whose time does not grow are dropped. */
void rw_sense_gyro(rw_sense *s, rw_time time, const rw_real *rate);
void rw_sense_accel(rw_sense *s, rw_time time, const rw_real *force);
void rw_sense_level(rw_sense *s, rw_time time, rw_real level);

/* Ticks without commands are told half a second late at most, but only for two seconds; the rest of a longer gap has no motion, and all but
   the last two seconds of one of more than four is left out.

   The next tick, where it can be told at `now` s; call until it returns false. Motion that is late by more than 0.9 s is
   not awaited, nor for more than RW_WAITING ticks. */
bool rw_sense_next(rw_sense *s, const rw_plan *p, rw_time now, rw_sensed *out);

#ifdef __cplusplus
}
#endif

#endif
