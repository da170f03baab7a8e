/* An ArduPilot library that runs an exported estimator from the scheduler. MIT.
 *
 * Put this folder into libraries/AP_RotorWatch, `rotorwatch export-c --estimator ekf --vehicle mine.toml --variable-dt -o .`
 * beside it, and call update() from the vehicle's fast task list. Thrusts are in hover thrusts of one rotor.
 */
#pragma once

#include <AP_AHRS/AP_AHRS.h>
#include <AP_HAL/AP_HAL.h>
#include <AP_InertialSensor/AP_InertialSensor.h>
#include <AP_Logger/AP_Logger.h>

#include "ekf.h"

class AP_RotorWatch {
public:
    AP_RotorWatch();

    // One step. command: of each rotor, 0..1; hover: the command at which one carries its share.
    void update(const float *command, float hover);

    // Loss of effectiveness of a rotor, counted from 0: 0 healthy, 1 dead.
    float loss(uint8_t rotor) const { return rotor < ROTORS ? float(_out.theta[rotor]) : 0.0f; }

private:
    static constexpr uint8_t ROTORS = sizeof(ekf_out{}.theta) / sizeof(rw_real);

    ekf_state _state {};
    ekf_workspace _workspace {};
    ekf_out _out {};
    uint64_t _last_us {};
};
