/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <AP_HAL/AP_HAL.h>
struct Quaternion {
    float q1, q2, q3, q4;
};
class AP_AHRS {
public:
    Vector3f get_gyro() const;
    bool get_velocity_NED(Vector3f &velocity) const;
    bool get_quaternion(Quaternion &quat) const;
};
namespace AP
{
AP_AHRS &ahrs();
}
