/* What the parts of the diagnoser on board take on a Cortex-M7, in instructions: the largest call of each in twenty seconds of flight with
   an announcement a second, outputs that part from the mixer, and knocks. Prints a line for each part. MIT. */
#include <stdio.h>
#include <string.h>

#include "rw_front.h"

#define SYSTICK ((volatile uint32_t *)0xE000E010u)
#define N RW_ROTORS

enum { FRONT, LOSSES, LIST, REPORT, PARTS };
static const char *const NAMES[PARTS] = {"front", "losses", "list", "report"};
static uint32_t most[PARTS];

#define COUNTED(part, call) \
    do { \
        const uint32_t before = SYSTICK[2]; \
        call; \
        const uint32_t taken = (before - SYSTICK[2]) & 0xFFFFFFu; \
        if (taken > most[part]) most[part] = taken; \
    } while (0)

static rw_front front;
static rw_losses all;
static rw_report report;
static rw_changes changes;

/* From -1 to 1, anything. */
static rw_real noise(void)
{
    static uint32_t state = 12345u;
    state = state * 1664525u + 1013904223u;
    return (rw_real)(state >> 8) / (rw_real)8388608.0 - 1;
}

static void explained(int k, rw_found *found)
{
    for (int i = 0; i < N; i++) {
        found->theta[i] = (rw_real)0.3 + (rw_real)0.01 * noise();
        found->theta_sd[i] = (rw_real)0.02;
    }
    for (int i = 0; i < RW_HYPOTHESES; i++) found->probability[i] = found->log_odds[i] = (rw_real)0.05;
    for (int p = 0; p < RW_PLACES; p++) {
        for (int i = 0; i < N && k % 20 == 0; i++) found->active[p][i] = noise() > 0;
        found->share[p] = (rw_real)(1.0 / RW_PLACES);
        found->onsets[p] = (rw_real)(k % 20 + 20 + p);
    }
    found->announced = k % 20 == 0 && k > 200;
}

int main(void)
{
    static rw_vehicle v;
    static rw_event losses[RW_RECORDS], list[RW_EVENTS], gone[RW_EVENTS];
    static rw_records room;
    static rw_override overrides[RW_OVERRIDES];
    static rw_change news[2 * RW_EVENTS];
    static rw_found found;
    rw_plan p = {.dt = RW_TICK_S, .lag = 0.02, .ready = 3, .gyro_half = RW_TICK_S / 2, .accel_half = RW_TICK_S / 2, .gyro_least = 1,
                 .accel_least = 1, .side_least = 5, .late = 0.9, .before = RW_TICKS_BEFORE,
                 .gyro = true, .accel = true};
    v.rotors = N;
    v.u_max = v.output_high = 1;
    v.yaw_headroom = (rw_real)0.2;
    v.mixer_known = true;
    for (int i = 0; i < N; i++) {
        v.effectiveness[RW_ROLL][i] = i % 2 ? 1 : -1;
        v.effectiveness[RW_PITCH][i] = i / 2 % 2 ? 1 : -1;
        v.effectiveness[RW_YAW][i] = i % 2 ? (rw_real)0.1 : (rw_real)-0.1;
        v.effectiveness[RW_THRUST][i] = v.mixer[i][3] = 1;
        for (int a = 0; a < 3; a++) v.mixer[i][a] = (rw_real)0.5 * v.effectiveness[a][i];
    }
    rw_front_init(&front);
    rw_losses_init(&all);
    rw_found_init(&found);
    rw_report_init(&report);
    rw_changes_init(&changes);
    SYSTICK[1] = 0xFFFFFF;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5;
    for (int sample = 0, k = 0; sample < 2000; sample++) {
        const rw_time t = 10 + 0.01 * sample;
        COUNTED(FRONT, rw_front_accel(&front, &v, &p, t, noise(), noise(), (rw_real)-9.8 + noise()));
        COUNTED(FRONT, rw_front_gyro(&front, &v, &p, t, noise(), noise(), noise()));
        if (sample % 2 == 0) {
            const rw_real control[RW_CONTROLS] = {(rw_real)0.1 * noise(), (rw_real)0.1 * noise(), (rw_real)0.1 * noise(), (rw_real)0.5};
            rw_real output[N];
            for (int i = 0; i < N; i++) output[i] = (rw_real)0.5 + (rw_real)0.1 * noise();
            if (sample / 200 % 2) output[sample / 400 % N] = (rw_real)0.5;
            COUNTED(FRONT, rw_front_outputs(&front, &v, &p, t, output));
            COUNTED(FRONT, rw_front_control(&front, &v, &p, t, control));
        }
        for (;; k++) {
            bool more = false;
            rw_made made;
            int loss_count = 0, override_count, count = 0;
            rw_made_init(&made);
            COUNTED(FRONT, more = rw_front_next(&front, &v, &p, &made));
            if (!more) break;
            explained(k, &found);
            COUNTED(LOSSES, rw_losses_on(&all, &v, made.time, made.when, made.mode, made.restart, &found));
            COUNTED(LIST, loss_count = rw_losses_losses(&all, &v, false, &room, losses));
            rw_report_tick(&report, made.time, made.start, made.upset);
            COUNTED(REPORT, {
                override_count = rw_deviations_found(&front.deviations, &v, overrides);
                count = rw_report_events(&report, &v, losses, loss_count, overrides, override_count, list);
                rw_changes_look(&changes, list, count, t - 6, -1, false, gone, news);
            });
        }
    }
    for (int part = 0; part < PARTS; part++) printf("%s %lu\n", NAMES[part], (unsigned long)most[part]);
    printf("seen %d %d\n", (int)rw_losses_losses(&all, &v, false, &room, losses), (int)rw_deviations_found(&front.deviations, &v, overrides));
    return 0;
}
