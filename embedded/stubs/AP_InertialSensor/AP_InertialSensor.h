/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <AP_HAL/AP_HAL.h>
class AP_InertialSensor {
public:
    Vector3f get_accel() const;
    Vector3f get_gyro() const;
    bool get_accel_health() const;
    bool get_gyro_health() const;
};
namespace AP
{
AP_InertialSensor &ins();
}
