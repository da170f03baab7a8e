/* Parameters to the vehicle, as airframes/ makes it: the standard frames come from there, in rw_tables.h. */
#include "rw_log.h"

#include "rw_tables.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

static const rw_frame *frame_of(const char *name)
{
    for (size_t k = 0; k < RW_FRAME_COUNT; k++)
        if (!strcmp(RW_FRAMES[k].name, name))
            return &RW_FRAMES[k];
    return NULL;
}

static bool stands_for(rw_log *log, const rw_frame *frame, const char *source)
{
    rw_vehicle *v = &log->vehicle;
    const size_t outputs = log->series[RW_OUTPUTS].width;
    if (!frame)
        return rw_refuse(log, "this log does not say which airframe flew; describe it to rotorwatch diagnose in a vehicle file");
    if (outputs != (size_t)frame->rotors)
        return rw_refuse(log, "this log commands %d rotors but the frame %s (%s) has %d", (int)outputs, frame->name, source, frame->rotors);
    v->rotors = frame->rotors;
    memcpy(v->effectiveness, frame->effectiveness, sizeof v->effectiveness);
    memcpy(v->mixer, frame->mixer, sizeof v->mixer);
    v->mixer_known = frame->mixer_known;
    snprintf(log->frame, sizeof log->frame, "%s", frame->name);
    return true;
}

/* Ends of the thrust curve and of the outputs' range, as the readers' and the airframes' Python has them. */
static void set_curve(rw_log *log, double low, double high, double expo, bool known, double range_low, double range_high)
{
    rw_vehicle *v = &log->vehicle;
    v->u_min = low;
    v->u_max = high;
    v->expo = expo;
    v->expo_sd = known ? 0.0 : RW_EXPO_SD;
    v->mixer_expo = expo;
    v->output_low = range_low;
    v->output_high = fmax(range_high, range_low + 1e-6);
    v->yaw_headroom = fmin(fmax(rw_parameter_of(log, "MOT_YAW_HEADROOM", RW_YAW_HEADROOM), 100.0), 500.0) / 1000.0;
}

static bool other_vehicle(rw_log *log, double mav_type)
{
    for (size_t k = 0; k < sizeof RW_OTHERS / sizeof *RW_OTHERS; k++)
        if ((double)RW_OTHERS[k].type == mav_type)
            return rw_refuse(log, "this log is of %s; rotorwatch diagnoses multirotors only", RW_OTHERS[k].words);
    return true;
}

/* PX4's normalised allocation of upright rotors: the pseudo-inverse of their geometry, its columns scaled (airframes/px4.py, mix). */
static void mix(rw_vehicle *v, const double *x, const double *y, const double *spin)
{
    const int n = v->rotors;
    double A[4][RW_ROTORS], square[16], vector[16], inverse[RW_ROTORS][4], scale[4] = {0}, most = 0.0;
    for (int i = 0; i < n; i++)
        A[0][i] = -y[i], A[1][i] = x[i], A[2][i] = 0.05 * spin[i], A[3][i] = 1.0;
    for (int r = 0; r < 4; r++)
        for (int c = 0; c < 4; c++) {
            square[4 * r + c] = 0.0;
            for (int i = 0; i < n; i++)
                square[4 * r + c] += A[r][i] * A[c][i];
        }
    rw_eigen(4, square, vector);
    for (int k = 0; k < 4; k++)
        most = fmax(most, square[5 * k]);
    for (int i = 0; i < n; i++) /* A+ = A' (A A')+ */
        for (int c = 0; c < 4; c++) {
            inverse[i][c] = 0.0;
            for (int k = 0; k < 4; k++) {
                double along = 0.0;
                for (int r = 0; r < 4; r++)
                    along += A[r][i] * vector[4 * k + r];
                if (square[5 * k] > 1e-13 * most)
                    inverse[i][c] += along * vector[4 * k + c] / square[5 * k];
            }
            if (fabs(inverse[i][c]) < 1e-9)
                inverse[i][c] = 0.0;
        }
    for (int c = 0; c < 2; c++) {
        double total = 0.0, used = 0.0;
        for (int i = 0; i < n; i++)
            total += inverse[i][c] * inverse[i][c], used += inverse[i][c] != 0.0;
        scale[0] = fmax(scale[0], sqrt(total / fmax(used / 2.0, 1.0)));
    }
    scale[1] = scale[0];
    for (int i = 0; i < n; i++)
        scale[2] = fmax(scale[2], fabs(inverse[i][2])), scale[3] += fabs(inverse[i][3]) / n;
    for (int i = 0; i < n; i++)
        for (int c = 0; c < 4; c++)
            v->mixer[i][c] = inverse[i][c] / (scale[c] > 0.0 ? scale[c] : 1.0);
    v->mixer_known = true;
}

static double rotor_parameter(const rw_log *log, int rotor, const char *what)
{
    char name[32];
    snprintf(name, sizeof name, "CA_ROTOR%d_%s", rotor, what);
    return rw_parameter_of(log, name, 0.0);
}

/* The geometry of CA_ROTOR* (1.13 and later); `found` is false where the log has none. */
static bool rotors_from_parameters(rw_log *log, bool *found)
{
    const int n = (int)rw_parameter_of(log, "CA_ROTOR_COUNT", 0.0);
    double x[RW_ROTORS], y[RW_ROTORS], z[RW_ROTORS], spin[RW_ROTORS], share[RW_ROTORS], reach = 0.0, least = INFINITY, mean = 0.0;
    rw_vehicle *v = &log->vehicle;
    *found = false;
    if (n < 3 || n > 12)
        return true;
    if (rw_parameter_of(log, "CA_AIRFRAME", 0.0) != 0.0)
        return rw_refuse(log, "CA_AIRFRAME %d is not a plain multirotor, which alone is assessed here", (int)rw_parameter_of(log, "CA_AIRFRAME", 0.0));
    for (int i = 0; i < n; i++) {
        const double moment = rotor_parameter(log, i, "KM");
        x[i] = rotor_parameter(log, i, "PX"), y[i] = rotor_parameter(log, i, "PY"), z[i] = rotor_parameter(log, i, "PZ");
        spin[i] = moment > 0.0 ? 1.0 : moment < 0.0 ? -1.0 : 0.0;
        share[i] = rotor_parameter(log, i, "CT");
        least = fmin(least, share[i]);
        reach = fmax(reach, fmax(fabs(x[i]), fabs(y[i])));
    }
    if (reach < 1e-3)
        return true;
    for (int i = 0; i < n; i++)
        mean += (least > 0.0 ? share[i] : 1.0) / n;
    for (int i = 0; i < n; i++)
        share[i] = least > 0.0 ? share[i] / mean : 1.0;
    mean = 0.0;
    for (int i = 0; i < n; i++) {
        bool lower = false;
        for (int j = 0; j < n; j++)
            lower = lower || (hypot(x[i] - x[j], y[i] - y[j]) < RW_SAME_ARM * reach && (z[j] < z[i] || (z[j] == z[i] && j < i)));
        share[i] *= lower ? RW_LOWER_SHARE : 1.0;
        mean += share[i] / n;
    }
    v->rotors = n;
    for (int i = 0; i < n; i++) {
        const double one = share[i] / mean;
        v->effectiveness[0][i] = -y[i] / reach * one;
        v->effectiveness[1][i] = x[i] / reach * one;
        v->effectiveness[2][i] = spin[i] * one;
        v->effectiveness[3][i] = one;
    }
    mix(v, x, y, spin);
    snprintf(log->frame, sizeof log->frame, "px4-%d-rotors", n);
    if (log->series[RW_OUTPUTS].width != (size_t)n)
        return rw_refuse(log, "this log commands %d rotors but CA_ROTOR_COUNT is %d", (int)log->series[RW_OUTPUTS].width, n);
    return *found = true;
}

bool rw_px4_airframe(rw_log *log)
{
    const double factor = rw_parameter_of(log, "THR_MDL_FAC", 0.0), type = log->mav_type > 0.0 ? log->mav_type : rw_parameter_of(log, "MAV_TYPE", 0.0);
    const double demand = fmin(fmax(factor, 0.0), 1.0);
    const bool known = factor > 0.0 && factor <= 1.0, thrusts = !strcmp(log->motors, "actuator_motors");
    const int start = (int)rw_parameter_of(log, "SYS_AUTOSTART", 0.0), outputs = (int)log->series[RW_OUTPUTS].width;
    const double expo = known ? factor : RW_PX4_EXPO;
    bool found;
    if (!other_vehicle(log, type) || !rotors_from_parameters(log, &found))
        return false;
    if (!found) {
        const char *name = NULL;
        char source[32] = "the number of outputs";
        for (size_t k = 0; k < sizeof RW_STARTS / sizeof *RW_STARTS && !name; k++)
            if (start >= RW_STARTS[k].first && start <= RW_STARTS[k].last)
                name = RW_STARTS[k].frame;
        if (name)
            snprintf(source, sizeof source, "SYS_AUTOSTART %d", start);
        else
            name = type == 15.0 ? "px4-tri" : outputs == 4 ? "px4-quad-x" : outputs == 6 ? "px4-hexa-x" : outputs == 8 ? "px4-octa-x" : "";
        if (!stands_for(log, frame_of(name), source))
            return false;
    }
    if (log->pulses) {
        const bool limits = log->pwm_min > 0.0 && log->pwm_max > log->pwm_min;
        const double low = limits ? log->pwm_min : 1000.0, high = limits ? log->pwm_max : 2000.0;
        set_curve(log, low, high, expo, known, low, high);
    } else
        set_curve(log, 0.0, 1.0, known && thrusts ? 0.0 : expo, known, 0.0, 1.0);
    log->vehicle.mixer_expo = thrusts ? 0.0 : demand; /* actuator_motors holds thrust demands */
    log->vehicle.rests_at_minimum = true;
    return true;
}

/* FRAME_CLASS of a name that the firmware announces, 0 for an unknown one. */
static int class_of(const char *announced)
{
    for (size_t k = 0; k < sizeof RW_CLASS_NAMES / sizeof *RW_CLASS_NAMES; k++)
        if (!strcmp(announced, RW_CLASS_NAMES[k].name))
            return RW_CLASS_NAMES[k].number;
    return 0;
}

bool rw_ardupilot_airframe(rw_log *log, const char *announced)
{
    const double expo = rw_parameter_of(log, "MOT_THST_EXPO", NAN);
    double low = rw_parameter_of(log, "MOT_PWM_MIN", 0.0), high = rw_parameter_of(log, "MOT_PWM_MAX", 0.0), start, full;
    const double least = rw_parameter_of(log, "THR_MIN", NAN), spin = rw_parameter_of(log, "MOT_SPIN_MAX", NAN);
    const int frame_class = (int)rw_parameter_of(log, "FRAME_CLASS", 0.0), kind = (int)rw_parameter_of(log, "FRAME_TYPE", 1.0);
    const bool ranged = low > 0.0 && high > low;
    const double range[2] = {ranged ? low : 1000.0, ranged ? high : 2000.0};
    const rw_frame *frame = NULL;
    char name[40];
    if (frame_class > 0) {
        for (size_t k = 0; k < sizeof RW_CLASSES / sizeof *RW_CLASSES; k++)
            if (RW_CLASSES[k].number == frame_class && RW_CLASSES[k].kind == kind)
                frame = frame_of(RW_CLASSES[k].frame);
        if (!frame)
            return rw_refuse(log, "FRAME_CLASS %d with FRAME_TYPE %d is not a multirotor frame that is known here", frame_class, kind);
        snprintf(name, sizeof name, "FRAME_CLASS, FRAME_TYPE");
    } else if (!isnan(rw_parameter_of(log, "FRAME", NAN))) {
        /* Before 3.5 the class was compiled in: the firmware's text has it, else a quad is known by its outputs. */
        const int old = (int)rw_parameter_of(log, "FRAME", 0.0), outputs = (int)log->series[RW_OUTPUTS].width;
        const int number = *announced ? class_of(announced) : outputs == 4 ? 1 : 0;
        if (!number)
            return rw_refuse(log, "this log does not name its frame class; rotorwatch diagnose tells it from the mixing of the outputs");
        for (size_t k = 0; k < sizeof RW_CLASSES / sizeof *RW_CLASSES; k++)
            if (RW_CLASSES[k].number == number && RW_CLASSES[k].kind == old)
                frame = frame_of(RW_CLASSES[k].frame);
        snprintf(name, sizeof name, "FRAME");
    }
    if (!stands_for(log, frame, frame ? name : ""))
        return false;
    if (!ranged) {
        low = rw_parameter_of(log, "RC3_MIN", 0.0), high = rw_parameter_of(log, "RC3_MAX", 0.0);
        if (!(low > 0.0 && high > low))
            low = 1000.0, high = 2000.0;
    }
    if (!isnan(spin) || isnan(least)) {
        start = rw_parameter_of(log, "MOT_SPIN_MIN", 0.15);
        full = isnan(spin) ? 0.95 : spin;
    } else { /* before 3.5 */
        const double percent = rw_parameter_of(log, "MOT_TCRV_MAXPCT", NAN);
        start = least / 1000.0;
        full = start + (1.0 - start) * rw_parameter_of(log, "MOT_THST_MAX", 0.95);
        if (!isnan(percent))
            full = rw_parameter_of(log, "MOT_TCRV_ENABLE", 1.0) != 0.0 ? percent / 100.0 : 1.0;
    }
    if (!(start >= 0.0 && start < full && full <= 1.0))
        start = 0.15, full = 0.95;
    set_curve(log, low + start * (high - low), low + full * (high - low), fmin(fmax(isnan(expo) ? 0.65 : expo, 0.0), 1.0), !isnan(expo), range[0],
              range[1]);
    return true;
}
