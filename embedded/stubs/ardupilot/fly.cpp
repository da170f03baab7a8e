/* Flies recorded samples through AP_RotorDiagnosis as ArduCopter would: fly SAMPLES [ENABLE [TEXT [ACT]]]. A sample is 24 doubles: kind, time,
   validity and numbers, as in tests/onboard_law.py. Texts and log records come out as lines. MIT. */
#include <AP_RotorDiagnosis.h>
#include <cstdlib>
#include <cstring>

#include "world.h"

static const int WIDTH = 24;

static void see(const double *row)
{
    const bool ok = row[2] > 0.5;
    const double *x = row + 3;
    switch (int(row[0])) {
    case 0:
        World::pwm_known = uint32_t(row[2]);
        for (int k = 0; k < RW_ROTORS; k++) {
            World::pwm[k] = uint16_t(x[k] + 0.5);
        }
        break;
    case 1: World::accel(x, ok); break;
    case 2: World::gyro(x, ok); break;
    case 3: World::velocity(x); break;
    case 4:
        if (x[0] >= 0) {
            World::flying(x[0] < 0.5);
        }
        if (x[1] >= 0) {
            World::armed(x[1] > 0.5);
        }
        break;
    case 5: World::control(x); break;
    case 6: World::attitude(x); break;
    default: World::battery(x[0], double(rw_vehicle_default.mixer_expo)); break;
    }
}

/* Parameters as a ground station sets them. */
static void set(AP_RotorDiagnosis &d, const char *name, int8_t value)
{
    for (const AP_Param::GroupInfo *g = AP_RotorDiagnosis::var_info; g->type != AP_PARAM_NONE; g++) {
        if (strcmp(g->name, name) == 0) {
            reinterpret_cast<AP_Int8 *>(reinterpret_cast<char *>(&d) + g->offset)->set(value);
        }
    }
}

int main(int count, char **words)
{
    static AP_RotorDiagnosis d;
    FILE *file = count > 1 ? fopen(words[1], "rb") : nullptr;
    if (file == nullptr) {
        return 2;
    }
    set(d, "ENABLE", int8_t(count > 2 ? atoi(words[2]) : 1));
    if (count > 3) {
        set(d, "TEXT", int8_t(atoi(words[3])));
    }
    if (count > 4) {
        set(d, "ACT", int8_t(atoi(words[4])));
    }
    d.init(World::motors);
    fprintf(World::out, "size\t%u\t%d\n", unsigned(sizeof d), World::threads() ? 1 : 0);
    double row[WIDTH];
    while (fread(row, sizeof row, 1, file) == 1) {
        see(row);
        World::now_us = uint64_t(row[1] * 1000000 + 0.5);
        if (int(row[0]) == 2) { // a turn of the main loop
            d.update();
            World::let();
        }
    }
    fclose(file);
    fprintf(World::out, "verdict\t%d\n", d.verdict());
    fflush(World::out);
    _Exit(0);
}
