/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_Common/AP_Common.h>
#define AP_MOTORS_MAX_NUM_MOTORS 12
class AP_Motors {
public:
    virtual ~AP_Motors() {}
    static AP_Motors *get_singleton();
    bool armed() const { return _armed; }
    float get_roll() const { return _roll_in; }
    float get_roll_ff() const { return _roll_in_ff; }
    float get_pitch() const { return _pitch_in; }
    float get_pitch_ff() const { return _pitch_in_ff; }
    float get_yaw() const { return _yaw_in; }
    float get_yaw_ff() const { return _yaw_in_ff; }
    float get_throttle_out() const { return _throttle_out; }
    float get_throttle() const { return _throttle; }
    virtual float get_throttle_hover() const = 0;
    virtual uint32_t get_motor_mask() = 0;

protected:
    friend struct World;
    float _roll_in = 0, _roll_in_ff = 0;
    float _pitch_in = 0, _pitch_in_ff = 0;
    float _yaw_in = 0, _yaw_in_ff = 0;
    float _throttle_out = 0;
    float _throttle = 0;
    bool _armed = false;
};
namespace AP
{
AP_Motors *motors();
}
