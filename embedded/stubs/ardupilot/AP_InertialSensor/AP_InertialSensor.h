/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_Common/AP_Common.h>
#include <AP_Math/AP_Math.h>
#define INS_MAX_INSTANCES 3
class AP_InertialSensor {
public:
    AP_InertialSensor() {}
    CLASS_NO_COPY(AP_InertialSensor);
    static AP_InertialSensor *get_singleton();
    const Vector3f &get_gyro(uint8_t i) const { return _gyro[i]; }
    const Vector3f &get_gyro() const { return get_gyro(_first_usable_gyro); }
    const Vector3f &get_accel(uint8_t i) const { return _accel[i]; }
    const Vector3f &get_accel() const { return get_accel(_first_usable_accel); }
    bool get_gyro_health(uint8_t instance) const { return _gyro_healthy[instance]; }
    bool get_gyro_health() const { return get_gyro_health(_first_usable_gyro); }
    bool get_accel_health(uint8_t instance) const { return _accel_healthy[instance]; }
    bool get_accel_health() const { return get_accel_health(_first_usable_accel); }
    uint32_t get_last_update_usec() const { return _last_update_usec; }

private:
    friend struct World;
    Vector3f _gyro[INS_MAX_INSTANCES];
    Vector3f _accel[INS_MAX_INSTANCES];
    bool _gyro_healthy[INS_MAX_INSTANCES] {};
    bool _accel_healthy[INS_MAX_INSTANCES] {};
    uint8_t _first_usable_gyro = 0;
    uint8_t _first_usable_accel = 0;
    uint32_t _last_update_usec = 0;
};
namespace AP
{
AP_InertialSensor &ins();
}
