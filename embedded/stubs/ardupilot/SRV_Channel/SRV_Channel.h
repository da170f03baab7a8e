/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_Common/AP_Common.h>
class SRV_Channel {
public:
    enum Function {
        k_none = 0,
        k_motor1 = 33,
        k_motor8 = 40,
        k_motor9 = 82,
        k_motor12 = 85,
        k_motor13 = 160,
        k_nr_aux_servo_functions = 190
    };
};
class SRV_Channels {
public:
    static bool get_output_pwm(SRV_Channel::Function function, uint16_t &value);
    static SRV_Channel::Function get_motor_function(uint8_t channel)
    {
        const int first = channel < 8 ? SRV_Channel::k_motor1 : channel < 12 ? SRV_Channel::k_motor9 - 8 : SRV_Channel::k_motor13 - 12;
        return SRV_Channel::Function(first + channel);
    }
};
