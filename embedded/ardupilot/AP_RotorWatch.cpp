/* See AP_RotorWatch.h. Everything is a member of the object: nothing is allocated while flying. MIT. */
#include "AP_RotorWatch.h"

AP_RotorWatch::AP_RotorWatch()
{
    ekf_init(&_state, &_workspace);
}

void AP_RotorWatch::update(const float *command, float hover)
{
    const Vector3f rate = AP::ahrs().get_gyro();
    const Vector3f force = AP::ins().get_accel();
    const uint64_t now_us = AP_HAL::micros64();

    rw_real u[ROTORS];
    for (uint8_t i = 0; i < ROTORS; i++) {
        const float share = command[i] / hover;
        u[i] = share * share;  // thrust grows with the square of the speed
    }
    const bool felt = AP::ins().get_accel_health();
    const rw_real y[4] = {rate.x, rate.y, rate.z, force.z};
    const bool valid[4] = {true, true, true, felt};
    const rw_real dt = _last_us == 0 ? rw_real(0.0025) : rw_real(now_us - _last_us) * rw_real(1e-6);
    _last_us = now_us;

    ekf_step(&_state, u, y, valid, dt, &_out, &_workspace);

    AP::logger().Write("RWCH", "TimeUS,L1,L2,L3,L4", "Qffff", now_us, double(loss(0)), double(loss(1)), double(loss(2)),
                       double(loss(3)));
}
