/* See AP_RotorDiagnosis.h. Everything is a member of the object: nothing is allocated while flying. MIT. */
#include "AP_RotorDiagnosis.h"

#include <GCS_MAVLink/GCS.h>
#include <SRV_Channel/SRV_Channel.h>
#include <math.h>

const AP_Param::GroupInfo AP_RotorDiagnosis::var_info[] = {
    // @Param: ENABLE
    // @DisplayName: Watch the rotors
    // @Description: Tells which rotor has lost effectiveness. It commands nothing.
    // @Values: 0:Disabled,1:Enabled
    // @RebootRequired: True
    // @User: Standard
    AP_GROUPINFO_FLAGS("ENABLE", 1, AP_RotorDiagnosis, _enable, 1, AP_PARAM_FLAG_ENABLE),

    // @Param: TEXT
    // @DisplayName: Text messages to the ground station
    // @Description: Everything is logged, whatever this says.
    // @Values: 0:Nothing,2:Lasting faults,4:Also what several sets of rotors explain,5:Everything
    // @User: Standard
    AP_GROUPINFO("TEXT", 2, AP_RotorDiagnosis, _text, 5),

    AP_GROUPEND
};

AP_RotorDiagnosis::AP_RotorDiagnosis()
{
    AP_Param::setup_object_defaults(this, var_info);
}

void AP_RotorDiagnosis::init()
{
    rw_diagnoser_init(&_diagnoser, &rw_vehicle_default, &rw_plan_default);
}

void AP_RotorDiagnosis::update(bool landed, bool armed, float voltage_ratio, const float *control)
{
    if (!_enable.get()) {
        return;
    }
    const uint64_t now_us = AP_HAL::micros64();
    feed(now_us, landed, armed, voltage_ratio, control);

    const int count = rw_diagnoser_poll(&_diagnoser, _notifications);
    for (int i = 0; i < count; i++) {
        notify(_notifications[i], now_us);
    }
    if (now_us - _logged_us >= LOG_EVERY_US) {
        _logged_us = now_us;
        AP::logger().Write("RWLS", "TimeUS,Verd,L1,L2,L3,L4,L5,L6,L7,L8", "QBffffffff", now_us, unsigned(verdict()), double(loss(0)),
                           double(loss(1)), double(loss(2)), double(loss(3)), double(loss(4)), double(loss(5)), double(loss(6)),
                           double(loss(7)));
    }
}

void AP_RotorDiagnosis::feed(uint64_t now_us, bool landed, bool armed, float voltage_ratio, const float *control)
{
    const rw_time now = double(now_us) / 1000000;
    rw_diagnoser_state(&_diagnoser, now, landed ? 1 : 0, armed ? 1 : 0);

    rw_diagnoser_battery(&_diagnoser, now, rw_real(voltage_ratio));

    rw_real output[RW_ROTORS];
    rw_rotors known = 0;
    for (uint8_t k = 0; k < RW_ROTORS; k++) {
        uint16_t pwm = 0;
        if (SRV_Channels::get_output_pwm(SRV_Channels::get_motor_function(k), pwm)) {
            known = rw_rotors(known | (1u << k));
        }
        output[k] = rw_real(pwm);
    }
    rw_diagnoser_outputs(&_diagnoser, now, output, known);
    if (control != nullptr) {
        const rw_real demand[4] = {control[0], control[1], control[2], control[3]};
        rw_diagnoser_control(&_diagnoser, now, demand, true);
    }

    const Vector3f gyro = AP::ins().get_gyro();
    const rw_real rate[3] = {gyro.x, gyro.y, gyro.z};
    rw_diagnoser_gyro(&_diagnoser, now, rate, AP::ins().get_gyro_health());

    const Vector3f accel = AP::ins().get_accel();
    const rw_real force[3] = {accel.x, accel.y, accel.z};
    rw_diagnoser_accel(&_diagnoser, now, force, AP::ins().get_accel_health());

    Quaternion quat {};
    if (AP::ahrs().get_quaternion(quat)) {
        const rw_real q[4] = {quat.q1, quat.q2, quat.q3, quat.q4};
        rw_diagnoser_attitude(&_diagnoser, now, q);
    }
    Vector3f velocity {};
    if (AP::ahrs().get_velocity_NED(velocity)) {
        const rw_real moved[3] = {velocity.x, velocity.y, velocity.z};
        rw_diagnoser_velocity_ned(&_diagnoser, now, moved);
    }
}

void AP_RotorDiagnosis::notify(const rw_notification &notification, uint64_t now_us) const
{
    const rw_event &event = *notification.event;
    char text[RW_TEXT];
    const int severity = rw_diagnoser_words(&notification, text);
    if (severity <= _text.get()) {
        GCS_SEND_TEXT(MAV_SEVERITY(severity), "%s", text);
    }
    AP::logger().Write("RWEV", "TimeUS,Num,What,Kind,Rot,Alt,On,End,Loss,Lo,Hi,P", "QHBBHHddffff", now_us, unsigned(notification.number),
                       unsigned(notification.kind), unsigned(event.kind), unsigned(event.rotors),
                       unsigned(event.alternative_count ? event.alternatives[0] : 0), event.onset,
                       event.end < RW_LASTS ? event.end : 0, double(event.loss[0]), double(event.lower[0]), double(event.upper[0]),
                       double(event.probability));
}

float AP_RotorDiagnosis::loss(uint8_t rotor) const
{
    return rotor < RW_ROTORS ? float(rw_diagnoser_loss(&_diagnoser, rotor)) : 0.0f;
}
