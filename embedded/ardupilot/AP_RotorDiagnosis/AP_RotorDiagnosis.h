/* An ArduPilot library that runs the whole diagnoser: which rotor has lost effectiveness, how much, since when and how sure. MIT.
 *
 * Put this folder into libraries/, and into it what this writes:
 *
 *   rotorwatch export-c --diagnoser --vehicle mine.toml --rate-hz 100 --sensor-hz 100 -o .
 *
 * Define ROTORWATCH_FLOAT, and call init() once and update() RW_MOTION_HZ (100) times a second: each call feeds the outputs and the sensors, so
 * both rates are the same. It only reports: nothing here commands the vehicle.
 *
 * Log records:
 *   RWEV  an event that is new (What 0), changed (1) or withdrawn (2). Kind: 0 loss of effectiveness, 1 output overridden, 2 contact. Rot, Alt:
 *         masks of rotors, bit 0 is motor 1; Alt is the likeliest other set, 0 without. On, End: s since boot; End 0 while it lasts.
 *         Loss, Lo, Hi: of the first rotor of the set, 0 to 1. P: probability of the set.
 *   RWLS  five times a second: verdict (0 not judged, 1 healthy so far, 2 fault, 3 ambiguous) and losses of motors 1 to 8.
 */
#pragma once

#include <AP_AHRS/AP_AHRS.h>
#include <AP_HAL/AP_HAL.h>
#include <AP_InertialSensor/AP_InertialSensor.h>
#include <AP_Logger/AP_Logger.h>
#include <AP_Param/AP_Param.h>

#include "rw_diagnoser.h"

class AP_RotorDiagnosis {
public:
    AP_RotorDiagnosis();

    void init();

    // One round. landed, armed: what the vehicle says; voltage_ratio: battery voltage as a share of full, filtered (AP_Motors's), 1 without;
    // control: roll, pitch, yaw and throttle as AP_Motors gets them, or nullptr.
    void update(bool landed, bool armed, float voltage_ratio, const float *control);

    // Loss of effectiveness of a rotor, counted from 0: 0 healthy, 1 dead.
    float loss(uint8_t rotor) const;
    int verdict() const { return rw_diagnoser_verdict(&_diagnoser); }

    static const AP_Param::GroupInfo var_info[];

private:
    static constexpr uint64_t LOG_EVERY_US = 200000;

    void feed(uint64_t now_us, bool landed, bool armed, float voltage_ratio, const float *control);
    void notify(const rw_notification &notification, uint64_t now_us) const;

    AP_Int8 _enable;
    AP_Int8 _text;

    rw_diagnoser _diagnoser {};
    rw_notification _notifications[2 * RW_EVENTS] {};
    uint64_t _logged_us {};
};
