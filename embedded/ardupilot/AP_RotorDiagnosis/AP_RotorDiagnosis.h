/* An ArduPilot library that runs the whole diagnoser: which rotor has lost effectiveness, how much, since when and how sure. MIT.
 *
 * Where it goes, what to add to ArduCopter and what the pilot sees: docs/ardupilot.md. The C library of the vehicle, in this folder, is made by
 *
 *   rotorwatch export-c --diagnoser --vehicle mine.toml --rate-hz 50 --sensor-hz 100 -o AP_RotorDiagnosis
 *
 * The main loop calls update() each time: that adds up gyro and accelerometer, and puts a sample into a queue RW_MOTION_HZ times a second,
 * nothing else. A thread of lowest priority diagnoses. Without RWD_ENABLE there is neither, and no memory is taken. It only reports, unless RWD_ACT is 1: a
 * vehicle with a dynamic matrix (FRAME_CLASS 17) then gets the factors for the rotors that are left.
 *
 * Log records:
 *   RWEV  an event that is new (What 0), changed (1) or withdrawn (2). Kind: 0 loss of effectiveness, 1 output overridden, 2 contact, 9 mount.
 *         Rot, Alt: masks of rotors, bit 0 is motor 1; Alt is the likeliest other set, 0 without. On, End: s since boot; End 0 while it lasts.
 *         P: probability of the set, of a loss .975 at most. L1 to L4: losses of the set's rotors, 0 to 1, in their order; Lo, Hi: of the first one, 95 %.
 *   RWLS  five times a second: verdict (0 not assessed, 1 healthy so far, 2 fault, 3 ambiguous), samples that found the queue full, and
 *         losses of motors 1 to 12.
 */
#pragma once

#include <AP_Common/AP_Common.h>
#include <AP_HAL/AP_HAL.h>
#include <AP_Param/AP_Param.h>

#include "rw_diagnoser.h"

class AP_MotorsMulticopter;

class AP_RotorDiagnosis {
public:
    AP_RotorDiagnosis();
    CLASS_NO_COPY(AP_RotorDiagnosis);

    // Once, when the motors exist: takes the memory and starts the thread, if RWD_ENABLE says so.
    void init(const AP_MotorsMulticopter &motors);

    // What is seen at this moment: a task of the scheduler, at the rate of the main loop.
    void update();

    // What is known now. Loss of effectiveness of a rotor, counted from 0: 0 healthy, 1 dead; 0: not assessed, 1: healthy so far, 2: fault,
    // 3: ambiguous.
    float loss(uint8_t rotor);
    uint8_t verdict();
    bool running() const { return _work != nullptr; }

    static const AP_Param::GroupInfo var_info[];

private:
    struct Mean;
    struct Sample;
    struct Work;

    void thread();
    bool step();
    void feed(const Sample &sample);
    void feed_motion(const Sample &sample);
    void act();
    void report(const rw_notification &notification, uint64_t now_us);
    void log_losses(uint64_t now_us);

    AP_Int8 _enable;
    AP_Int8 _text;
    AP_Int8 _act;

    const AP_MotorsMulticopter *_motors = nullptr;
    Work *_work = nullptr;
};
