/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_HAL/AP_HAL.h>
#include <AP_Math/AP_Math.h>
class AP_AHRS {
public:
    AP_AHRS(uint8_t flags = 0) {}
    CLASS_NO_COPY(AP_AHRS);
    static AP_AHRS *get_singleton();
    HAL_Semaphore &get_semaphore() { return _rsem; }
    const Vector3f &get_gyro() const { return state.gyro_estimate; }
    bool get_quaternion(Quaternion &quat) const WARN_IF_UNUSED;
    bool get_velocity_NED(Vector3f &vec) const WARN_IF_UNUSED;

private:
    friend struct World;
    HAL_Semaphore _rsem;
    struct {
        Vector3f gyro_estimate;
        Quaternion quat;
        Vector3f velocity_NED;
        bool quat_ok = false;
        bool velocity_NED_ok = false;
    } state;
};
namespace AP
{
AP_AHRS &ahrs();
}
