/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
class SRV_Channel {
public:
    typedef int Aux_servo_function_t;
};
class SRV_Channels {
public:
    static SRV_Channel::Aux_servo_function_t get_motor_function(uint8_t channel) { return channel; }
    static bool get_output_pwm(SRV_Channel::Aux_servo_function_t function, uint16_t &value);
};
