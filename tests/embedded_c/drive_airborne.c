/* Rows of doubles from stdin to rw_airborne: first the ends of the outputs' range. kind 0: outputs (with a mask); 1: accel;
   2: gyro; 3: velocity; 4: the autopilot's word; 5: all up to then has come. Prints the flights. */
#include <stdio.h>
#include <string.h>

#include "rows.h"
#include "rw_airborne.h"

int main(void)
{
    static rw_airborne a;
    rw_vehicle v;
    double kind;
    memset(&v, 0, sizeof v);
    v.output_low = (rw_real)one();
    v.output_high = (rw_real)one();
    rw_airborne_init(&a);
    while (fread(&kind, sizeof kind, 1, stdin) == 1) {
        rw_real values[RW_ROTORS > 3 ? RW_ROTORS : 3];
        const double time = one(), valid = one();
        if (kind < 0.5) {
            take(values, RW_ROTORS);
            rw_airborne_outputs(&a, &v, time, values, (rw_rotors)valid);
        } else if (kind < 2.5) {
            take(values, 3);
            if (kind < 1.5) rw_airborne_accel(&a, time, values, valid > 0.5);
            else rw_airborne_gyro(&a, time, values, valid > 0.5);
        } else if (kind < 3.5) {
            take(values, 2);
            rw_airborne_velocity(&a, time, values[0], values[1]);
        } else if (kind < 4.5) {
            take(values, 2);
            rw_airborne_state(&a, time, (int)values[0], (int)values[1]);
        } else {
            rw_airborne_until(&a, time);
        }
    }
    printf("found\n");
    for (int i = 0; i < a.flight_count; i++) printf("%.17g %.17g\n", a.flights[i].start, rw_airborne_end(&a, i));
    if (a.start < RW_LASTS && a.last > a.start) printf("%.17g %.17g\n", a.start, a.last);
    return 0;
}
