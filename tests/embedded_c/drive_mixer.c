/* Rows of doubles from stdin to rw_mixer and rw_departures. The first row is the vehicle and when it flew. kind 0: outputs; 1: the rate
   controller's. Prints each comparison and each rebuilt thrust as it is made, and at the end the overrides. */
#include <stdio.h>

#include "rows.h"
#include "rw_mixer.h"

#define N RW_ROTORS

static void show(const char *name, const rw_real *values)
{
    printf("%s", name);
    for (int k = 0; k < N; k++) printf(" %.17g", (double)values[k]);
}

static double spans[256][2];
static int span_count;

static bool aloft(rw_time time)
{
    for (int i = 0; i < span_count; i++) {
        if (spans[i][0] <= time && time < spans[i][1]) return true;
    }
    return false;
}

int main(void)
{
    static rw_mixer mixer;
    static rw_departures departures;
    static rw_comparison made[RW_PENDING];
    static rw_override found[RW_OVERRIDES];
    rw_vehicle v;
    double kind;
    take(&v.effectiveness[0][0], RW_AXES * N);
    take(&v.mixer[0][0], 4 * N);
    v.u_min = (rw_real)one();
    v.u_max = (rw_real)one();
    v.expo = (rw_real)one();
    v.mixer_expo = (rw_real)one();
    v.yaw_headroom = (rw_real)one();
    v.mixer_known = one() > 0.5;
    v.rests_at_minimum = one() > 0.5;
    span_count = (int)one();
    for (int i = 0; i < span_count; i++) {
        spans[i][0] = one();
        spans[i][1] = one();
    }
    rw_mixer_init(&mixer);
    rw_departures_init(&departures);
    printf("found\n");
    while (fread(&kind, sizeof kind, 1, stdin) == 1) {
        int count = 0;
        rw_real thrust[N];
        const double time = one();
        const bool valid = one() > 0.5;
        const rw_real battery = (rw_real)one();
        if (kind < 0.5) {
            rw_real output[N];
            take(output, N);
            for (int k = 0; k < N; k++) thrust[k] = rw_mixer_curve(&v, output[k], battery);
            count = rw_mixer_outputs(&mixer, &v, time, output, valid, battery, made);
            rw_departures_logged(&departures, &v, time, output, thrust, valid, aloft(time));
        } else {
            rw_real control[RW_CONTROLS];
            bool ok[N];
            take(control, RW_CONTROLS);
            count = rw_mixer_control(&mixer, &v, time, control, valid, made);
            if (rw_mixer_thrust(&mixer, &v, time, control, valid, battery, thrust, ok)) {
                printf("thrust %.17g", time);
                show("", thrust);
                for (int k = 0; k < N; k++) printf(" %d", ok[k]);
                printf("\n");
            }
        }
        for (int i = 0; i < count; i++) {
            const rw_comparison *c = &made[i];
            printf("compared %.17g %.17g %.17g %d", c->time, c->known, (double)c->top, c->yaw_granted);
            show("", c->demand);
            show("", c->asked);
            show("", c->yaw);
            show("", c->deviation);
            printf("\n");
            rw_departures_compared(&departures, &v, c, aloft(c->time));
        }
    }
    const int count = rw_departures_found(&departures, &v, found);
    for (int i = 0; i < count; i++) {
        printf("override %d %d %.17g %.17g %.17g\n", found[i].rotor, found[i].kind, found[i].onset, found[i].detected, found[i].end);
    }
    return 0;
}
