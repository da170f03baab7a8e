/* Outputs, and what the rate controller asked of the mixer: the thrust curve, comparisons of the two, and thrusts rebuilt from the rate
   controller where it is sampled faster than the outputs. The mixer's gain (air density) is learned on the way; all of its factors where
   they are not known (RW_MIXER_UNKNOWN).

   Samples of both come in time order; at the same time outputs first. battery: voltage as a share of full, filtered; 1 where nothing
   measures it. */
#ifndef RW_MIXER_H
#define RW_MIXER_H

#include "rw_departures.h"
#include "rw_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Outputs that may wait for the next sample of the rate controller. */
#ifndef RW_PENDING
#define RW_PENDING 8
#endif
/* 1: the vehicle's mixer may not be known. */
#ifndef RW_MIXER_UNKNOWN
#define RW_MIXER_UNKNOWN 0
#endif

/* Columns of the rate controller's output. */
enum rw_control { RW_CONTROL_ROLL = 0, RW_CONTROL_PITCH = 1, RW_CONTROL_YAW = 2, RW_CONTROL_THROTTLE = 3, RW_CONTROLS = 4 };

typedef struct {
    struct {
        rw_time time;
        rw_real output[RW_ROTORS];
        rw_real battery;
    } pending[RW_PENDING];
    struct {
        rw_time time;
        rw_real value[RW_CONTROLS];
    } control[2];   /* the last ones, the newer second */
    rw_time time;   /* of the last comparison */
    rw_time usable; /* of the last one that the gain was learned from */
    rw_real above, below, gain;
#if RW_MIXER_UNKNOWN
    double weights[RW_CONTROLS + 1][RW_ROTORS], spread[RW_CONTROLS + 1][RW_CONTROLS + 1];
#endif
    bool good[RW_ROTORS], trusted[RW_ROTORS];
    uint8_t pending_count, control_count;
    bool compared; /* there was a comparison */
} rw_mixer;

/* Share of full thrust f(u) of an output u. */
rw_real rw_mixer_curve(const rw_vehicle *v, rw_real u, rw_real battery);

void rw_mixer_init(rw_mixer *m);

/* Outputs [n] at `time` s. Returns how many comparisons are made, 0 or 1, in out. */
int rw_mixer_outputs(rw_mixer *m, const rw_vehicle *v, rw_time time, const rw_real *output, bool valid, rw_real battery,
                     rw_comparison *out);

/* The rate controller's output [RW_CONTROLS] at `time` s. Returns how many comparisons are made, in out[RW_PENDING]. */
int rw_mixer_control(rw_mixer *m, const rw_vehicle *v, rw_time time, const rw_real *control, bool valid, rw_comparison *out);

/* Thrusts [n] that the rate controller's output stands for, after rw_mixer_control of that sample; ok [n]: they may be trusted, else the
   last outputs are better. Returns whether any may. */
bool rw_mixer_thrust(const rw_mixer *m, const rw_vehicle *v, rw_time time, const rw_real *control, bool valid, rw_real battery,
                     rw_real *thrust, bool *ok);

#ifdef __cplusplus
}
#endif

#endif
