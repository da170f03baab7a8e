/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <AP_HAL/AP_HAL.h>
class AP_AHRS {
public:
    Vector3f get_gyro() const;
};
namespace AP
{
AP_AHRS &ahrs();
}
