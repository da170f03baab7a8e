/* Rows of doubles from stdin to rw_departures; what was found, asked for by rows of kind 2, to stdout. The first row is the vehicle.
   kind 0: a comparison; 1: outputs; 2: print; 3: keep what there is; 4: take back what came since, with the times of
   rw_departures_landed. */
#include <stdio.h>
#include <stdlib.h>

#include "rw_departures.h"

#define N RW_ROTORS

static void take(rw_real *to, int count)
{
    for (int i = 0; i < count; i++) {
        double value;
        if (fread(&value, sizeof value, 1, stdin) != 1) exit(1);
        to[i] = (rw_real)value;
    }
}

static double one(void)
{
    double value;
    if (fread(&value, sizeof value, 1, stdin) != 1) exit(1);
    return value;
}

int main(void)
{
    static rw_departures state, kept;
    rw_vehicle vehicle;
    double kind;
    take(&vehicle.effectiveness[0][0], RW_AXES * N);
    vehicle.u_min = (rw_real)one();
    vehicle.u_max = (rw_real)one();
    vehicle.rests_at_minimum = one() > 0.5;
    rw_departures_init(&state);
    while (fread(&kind, sizeof kind, 1, stdin) == 1) {
        if (kind < 0.5) {
            rw_comparison c;
            c.time = one();
            c.known = one();
            const bool aloft = one() > 0.5;
            c.yaw_granted = one() > 0.5;
            c.top = (rw_real)one();
            take(c.demand, N);
            take(c.asked, N);
            take(c.yaw, N);
            take(c.deviation, N);
            take(c.output, N);
            rw_departures_compared(&state, &vehicle, &c, aloft);
        } else if (kind < 1.5) {
            rw_real output[N], thrust[N];
            const double time = one();
            const bool valid = one() > 0.5, aloft = one() > 0.5;
            take(output, N);
            take(thrust, N);
            rw_departures_logged(&state, &vehicle, time, output, thrust, valid, aloft);
        } else if (kind > 3.5) {
            const double compared = one(), logged = one();
            state = kept;
            rw_departures_landed(&state, compared, logged);
        } else if (kind > 2.5) {
            kept = state;
        } else {
            rw_override found[RW_OVERRIDES];
            const int count = rw_departures_found(&state, &vehicle, found);
            printf("found\n");
            for (int i = 0; i < count; i++) {
                const rw_override *o = &found[i];
                printf("%d %d %.17g %.17g %.17g %.17g %.17g\n", o->rotor, o->kind, o->onset, o->detected, o->end, (double)o->output,
                       (double)o->asked);
            }
        }
    }
    return 0;
}
