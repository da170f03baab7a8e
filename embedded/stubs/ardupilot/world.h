/* What a test sets and reads of the declared ArduPilot: a clock, sensors, outputs, texts, and the thread, which runs only while it is let. MIT. */
#pragma once
#include <AP_AHRS/AP_AHRS.h>
#include <AP_InertialSensor/AP_InertialSensor.h>
#include <AP_Motors/AP_Motors.h>
#include <AP_Motors/AP_MotorsMatrix_Scripting_Dynamic.h>
#include <AP_Vehicle/AP_Vehicle.h>
#include <cstdio>

struct World {
    static uint64_t now_us;
    static uint16_t pwm[32];
    static uint32_t pwm_known;
    static AP_MotorsMatrix_Scripting_Dynamic motors;

    static void gyro(const double *x, bool ok);
    static void accel(const double *x, bool ok);
    static void attitude(const double *x);
    static void velocity(const double *x);
    static void control(const double *x);
    static void battery(double ratio, double expo);
    static void flying(bool flies);
    static void armed(bool is);

    // Lets the thread go on until it waits.
    static void let();
    static bool threads();
    // Every record and text, as lines.
    static FILE *out;
};
