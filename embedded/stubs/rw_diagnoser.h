/* What the autopilots' shells call of the exported library, to compile them against. MIT. */
#ifndef RW_DIAGNOSER_H
#define RW_DIAGNOSER_H
#include "rw_report.h"
#ifdef __cplusplus
extern "C" {
#endif
typedef struct {
    struct {
        rw_real theta[RW_ROTORS];
    } out;
} rw_diagnoser;
typedef struct {
    rw_real dt;
} rw_plan;
extern const rw_vehicle rw_vehicle_default;
extern const rw_plan rw_plan_default;
void rw_diagnoser_init(rw_diagnoser *d, const rw_vehicle *v, const rw_plan *p);
void rw_diagnoser_gyro(rw_diagnoser *d, rw_time time, const rw_real *rate, bool valid);
void rw_diagnoser_accel(rw_diagnoser *d, rw_time time, const rw_real *force, bool valid);
void rw_diagnoser_outputs(rw_diagnoser *d, rw_time time, const rw_real *output, rw_rotors known);
void rw_diagnoser_control(rw_diagnoser *d, rw_time time, const rw_real *control, bool valid);
void rw_diagnoser_battery(rw_diagnoser *d, rw_time time, rw_real ratio);
void rw_diagnoser_attitude(rw_diagnoser *d, rw_time time, const rw_real *q);
void rw_diagnoser_velocity(rw_diagnoser *d, rw_time time, rw_real climb, rw_real speed);
void rw_diagnoser_state(rw_diagnoser *d, rw_time time, int landed, int armed);
int rw_diagnoser_poll(rw_diagnoser *d, rw_news *news);
int rw_diagnoser_events(const rw_diagnoser *d, const rw_event **events);
enum rw_verdict rw_diagnoser_verdict(const rw_diagnoser *d);
#ifdef __cplusplus
}
#endif
#endif
