/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include "AP_Motors_Class.h"
#include "AP_Motors_Thrust_Linearization.h"
class AP_MotorsMulticopter : public AP_Motors {
public:
    AP_MotorsMulticopter(uint16_t speed_hz = 490) {}
    float get_throttle_hover() const override { return _throttle_hover; }
    float get_throttle_limit() const { return _throttle_limit; }
    uint32_t get_motor_mask() override { return 0; }
    Thrust_Linearization thr_lin {*this};

protected:
    float _throttle_hover = 0.35f;
    float _throttle_limit = 1;
};
