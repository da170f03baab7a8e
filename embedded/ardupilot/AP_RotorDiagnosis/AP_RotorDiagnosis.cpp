/* See AP_RotorDiagnosis.h. Nothing is allocated while flying. MIT. */
#include "AP_RotorDiagnosis.h"

#include <AP_AHRS/AP_AHRS.h>
#include <AP_HAL/utility/RingBuffer.h>
#include <AP_InertialSensor/AP_InertialSensor.h>
#include <AP_Logger/AP_Logger.h>
#include <AP_Motors/AP_Motors.h>
#include <AP_Motors/AP_MotorsMatrix_Scripting_Dynamic.h>
#include <AP_Vehicle/AP_Vehicle.h>
#include <GCS_MAVLink/GCS.h>
#include <SRV_Channel/SRV_Channel.h>
#include <math.h>

#include "rw_text.h"

extern const AP_HAL::HAL &hal;

#ifndef NEW_NOTHROW
#define NEW_NOTHROW new
#endif

// Half a second of samples: the thread has the lowest priority.
#define RWD_QUEUE (RW_MOTION_HZ / 2 + 1)
#define RWD_STACK 4096
#define RWD_IDLE_US 2500
#define RWD_LOG_EVERY_US 200000
#define RWD_EVERY_US (1000000 / RW_MOTION_HZ)
#define RWD_LOGGED_ROTORS 12

const AP_Param::GroupInfo AP_RotorDiagnosis::var_info[] = {
    // @Param: ENABLE
    // @DisplayName: Watch the rotors
    // @Description: Tells which rotor has lost effectiveness. Memory is taken only where this is 1.
    // @Values: 0:Disabled,1:Enabled
    // @RebootRequired: True
    // @User: Standard
    AP_GROUPINFO_FLAGS("ENABLE", 1, AP_RotorDiagnosis, _enable, 0, AP_PARAM_FLAG_ENABLE),

    // @Param: TEXT
    // @DisplayName: Text messages to the ground station
    // @Description: The least grave events that are reported. Everything is logged, whatever this says.
    // @Values: 0:Nothing,2:Critical,4:Also warnings,5:Also notices,6:Everything
    // @User: Standard
    AP_GROUPINFO("TEXT", 2, AP_RotorDiagnosis, _text, 5),

    // @Param: ACT
    // @DisplayName: Change the mixer
    // @Description: Loads motor factors for the rotors that are left. Needs FRAME_CLASS 17 (dynamic matrix).
    // @Values: 0:Disabled,1:Enabled
    // @User: Advanced
    AP_GROUPINFO("ACT", 3, AP_RotorDiagnosis, _act, 0),

    AP_GROUPEND
};

// What the main loop saw: gyro and accelerometer since the sample before, as their mean at the mean of their times; with_outputs: and all
// the rest, now.
struct AP_RotorDiagnosis::Sample {
    uint64_t time_us;
    uint64_t motion_us;
    float gyro[3];
    float accel[3];
    float attitude[4];
    float velocity[3];
    float control[4];
    float voltage_ratio;
    uint16_t pwm[RW_ROTORS];
    rw_rotors known;
    bool gyro_ok;
    bool accel_ok;
    bool attitude_ok;
    bool velocity_ok;
    bool flying;
    bool armed;
    bool with_outputs;
};

// Adds up what a sensor says between two samples.
struct AP_RotorDiagnosis::Mean {
    float sum[3] {};
    uint64_t since_us = 0;
    uint32_t late_us = 0; // of all, after the first
    uint16_t count = 0;

    void add(const Vector3f &v, uint64_t now_us)
    {
        if (count == 0) {
            since_us = now_us;
        }
        sum[0] += v.x;
        sum[1] += v.y;
        sum[2] += v.z;
        late_us += uint32_t(now_us - since_us);
        count++;
    }

    // The mean, and its time; false without any.
    bool take(float *mean, uint64_t &time_us)
    {
        const bool any = count > 0;
        for (uint8_t k = 0; any && k < 3; k++) {
            mean[k] = sum[k] / float(count);
            sum[k] = 0.0f;
        }
        time_us = any ? since_us + late_us / count : time_us;
        late_us = 0;
        count = 0;
        return any;
    }
};

// Queue, diagnoser and results. Only the main loop touches what is before the diagnoser, only the thread that; results are guarded by `sem`.
struct AP_RotorDiagnosis::Work {
    ObjectBuffer<Sample> queue {RWD_QUEUE};
    uint16_t dropped = 0;
    uint16_t turn = 0;
    uint64_t due_us = 0;
    Mean gyro;
    Mean accel;
    rw_diagnoser diagnoser {};
    rw_texts texts {};
    rw_notification notifications[2 * RW_EVENTS] {};
    uint64_t logged_us = 0;
    rw_real factors[4 * RW_ROTORS] {};
    int32_t relied = 0;
    bool acted = false; // the mixer is not that of the healthy vehicle

    HAL_Semaphore sem;
    float loss[RW_ROTORS] {};
    uint8_t verdict = RW_NOT_ASSESSED;
};

AP_RotorDiagnosis::AP_RotorDiagnosis()
{
    AP_Param::setup_object_defaults(this, var_info);
}

void AP_RotorDiagnosis::init(const AP_MotorsMulticopter &motors)
{
    if (_enable.get() == 0 || _work != nullptr) {
        return;
    }
    Work *work = NEW_NOTHROW Work;
    if (work == nullptr || work->queue.get_size() == 0) {
        delete work;
        GCS_SEND_TEXT(MAV_SEVERITY_WARNING, "rotorwatch: no memory, rotors are not watched");
        return;
    }
    rw_diagnoser_init(&work->diagnoser, &rw_vehicle_default, &rw_plan_default);
    rw_texts_init(&work->texts);
    _motors = &motors;
    _work = work;
    if (!hal.scheduler->thread_create(FUNCTOR_BIND_MEMBER(&AP_RotorDiagnosis::thread, void), "rotorwatch", RWD_STACK,
                                      AP_HAL::Scheduler::PRIORITY_SCRIPTING, 0)) {
        _work = nullptr;
        delete work;
        GCS_SEND_TEXT(MAV_SEVERITY_WARNING, "rotorwatch: no thread, rotors are not watched");
    }
}

// Filtered battery voltage as a share of full. AP_Motors keeps it to itself, but not the lift that follows from it, (1 - e) r + e r^2.
static float voltage_ratio(const AP_MotorsMulticopter &motors)
{
    const float lift = motors.thr_lin.get_lift_max();
    const float e = float(rw_vehicle_default.mixer_expo);
    if (fabsf(e) < 0.001f) {
        return lift;
    }
    const float root = (1.0f - e) * (1.0f - e) + 4.0f * e * lift;
    return root > 0.0f ? (sqrtf(root) - (1.0f - e)) / (2.0f * e) : 1.0f;
}

void AP_RotorDiagnosis::update()
{
    if (_work == nullptr) {
        return;
    }
    const uint64_t now_us = AP_HAL::micros64();
    const AP_InertialSensor &ins = AP::ins();
    if (ins.get_gyro_health()) {
        _work->gyro.add(ins.get_gyro(), now_us);
    }
    if (ins.get_accel_health()) {
        _work->accel.add(ins.get_accel(), now_us);
    }
    if (now_us < _work->due_us) {
        return;
    }
    _work->due_us = (now_us - _work->due_us < RWD_EVERY_US ? _work->due_us : now_us) + RWD_EVERY_US;

    Sample s {};
    s.time_us = s.motion_us = now_us;
    s.gyro_ok = _work->gyro.take(s.gyro, s.motion_us);
    s.accel_ok = _work->accel.take(s.accel, s.motion_us);

    // Outputs and what changes slowly come RW_OUTPUT_HZ times a second, gyro and accelerometer RW_MOTION_HZ times.
    _work->turn += RW_OUTPUT_HZ;
    if (_work->turn >= RW_MOTION_HZ) {
        _work->turn -= RW_MOTION_HZ;
        s.with_outputs = true;
        for (uint8_t k = 0; k < RW_ROTORS; k++) {
            if (SRV_Channels::get_output_pwm(SRV_Channels::get_motor_function(k), s.pwm[k])) {
                s.known = rw_rotors(s.known | (1U << k));
            }
        }
        s.control[0] = _motors->get_roll() + _motors->get_roll_ff();
        s.control[1] = _motors->get_pitch() + _motors->get_pitch_ff();
        s.control[2] = _motors->get_yaw() + _motors->get_yaw_ff();
        s.control[3] = _motors->get_throttle();
        s.voltage_ratio = voltage_ratio(*_motors);
        s.armed = hal.util->get_soft_armed();
        s.flying = AP::vehicle()->get_likely_flying();

        const AP_AHRS &ahrs = AP::ahrs();
        Quaternion q;
        if (ahrs.get_quaternion(q)) {
            s.attitude[0] = q.q1;
            s.attitude[1] = q.q2;
            s.attitude[2] = q.q3;
            s.attitude[3] = q.q4;
            s.attitude_ok = true;
        }
        Vector3f v;
        if (ahrs.get_velocity_NED(v)) {
            s.velocity[0] = v.x;
            s.velocity[1] = v.y;
            s.velocity[2] = v.z;
            s.velocity_ok = true;
        }
    }
    if (!_work->queue.push(s)) {
        _work->dropped++;
    }
}

void AP_RotorDiagnosis::thread()
{
    while (true) {
        if (!step()) {
            hal.scheduler->delay_microseconds(RWD_IDLE_US);
        }
    }
}

// One sample, if there is one, and what it shows.
bool AP_RotorDiagnosis::step()
{
    Sample s;
    if (!_work->queue.pop(s)) {
        return false;
    }
    feed(s);
    if (!s.with_outputs) {
        return true;
    }
    const int count = rw_diagnoser_poll(&_work->diagnoser, _work->notifications);
    for (int i = 0; i < count; i++) {
        report(_work->notifications[i], s.time_us);
    }
    act();
    char text[RW_TEXT];
    const int severity = rw_diagnoser_text(&_work->diagnoser, &_work->texts, rw_time(s.time_us) / 1000000, _text.get(), text);
    if (severity > 0) {
        GCS_SEND_TEXT(MAV_SEVERITY(severity), "%s", text);
    }
    {
        WITH_SEMAPHORE(_work->sem);
        _work->verdict = uint8_t(rw_diagnoser_verdict(&_work->diagnoser));
        for (uint8_t k = 0; k < RW_ROTORS; k++) {
            _work->loss[k] = float(rw_diagnoser_loss(&_work->diagnoser, k));
        }
    }
    if (s.time_us - _work->logged_us >= RWD_LOG_EVERY_US) {
        _work->logged_us = s.time_us;
        log_losses(s.time_us);
    }
    return true;
}

// The factors for the rotors that are left, when they change: the wrench of the healthy mixer, so that gains stay as they are.
void AP_RotorDiagnosis::act()
{
#if AP_SCRIPTING_ENABLED
    const rw_reliance &reliance = *rw_diagnoser_reliance(&_work->diagnoser);
    AP_MotorsMatrix_Scripting_Dynamic *const motors = AP_MotorsMatrix_Scripting_Dynamic::get_singleton();
    if (_act.get() == 0 || motors == nullptr || reliance.revision == _work->relied) {
        return;
    }
    _work->relied = reliance.revision;
    bool weak = false;
    for (uint8_t k = 0; k < RW_ROTORS; k++) {
        weak = weak || reliance.effectiveness[k] < 1;
    }
    if ((!weak && !_work->acted) || rw_diagnoser_factors(&_work->diagnoser, _work->factors) == RW_UNABLE) {
        return;
    }
    AP_MotorsMatrix_Scripting_Dynamic::factor_table table {};
    for (uint8_t k = 0; k < RW_ROTORS && k < AP_MOTORS_MAX_NUM_MOTORS; k++) {
        table.roll[k] = float(_work->factors[4 * k]);
        table.pitch[k] = float(_work->factors[4 * k + 1]);
        table.yaw[k] = float(_work->factors[4 * k + 2]);
        table.throttle[k] = float(_work->factors[4 * k + 3]);
    }
    _work->acted = weak;
    motors->load_factors(table);
#endif
}

// In the order of times and, of one time, of kinds, as everywhere.
void AP_RotorDiagnosis::feed(const Sample &s)
{
    rw_diagnoser *const d = &_work->diagnoser;
    const rw_time t = rw_time(s.time_us) / 1000000;
    const bool before = s.motion_us < s.time_us;
    if (before) {
        feed_motion(s);
    }
    if (s.with_outputs) {
        rw_diagnoser_battery(d, t, rw_real(s.voltage_ratio));
        rw_real output[RW_ROTORS];
        for (uint8_t k = 0; k < RW_ROTORS; k++) {
            output[k] = rw_real(s.pwm[k]);
        }
        rw_diagnoser_outputs(d, t, output, s.known);
        const rw_real control[4] = {s.control[0], s.control[1], s.control[2], s.control[3]};
        rw_diagnoser_control(d, t, control, !_work->acted);
    }
    if (!before) {
        feed_motion(s);
    }
    if (s.velocity_ok) {
        const rw_real v[3] = {s.velocity[0], s.velocity[1], s.velocity[2]};
        rw_diagnoser_velocity_ned(d, t, v);
    }
    if (s.with_outputs) {
        rw_diagnoser_state(d, t, s.flying ? 0 : 1, s.armed ? 1 : 0);
    }
    if (s.attitude_ok) {
        const rw_real q[4] = {s.attitude[0], s.attitude[1], s.attitude[2], s.attitude[3]};
        rw_diagnoser_attitude(d, t, q);
    }
}

void AP_RotorDiagnosis::feed_motion(const Sample &s)
{
    const rw_time t = rw_time(s.motion_us) / 1000000;
    const rw_real rate[3] = {s.gyro[0], s.gyro[1], s.gyro[2]};
    rw_diagnoser_gyro(&_work->diagnoser, t, rate, s.gyro_ok);
    const rw_real force[3] = {s.accel[0], s.accel[1], s.accel[2]};
    rw_diagnoser_accel(&_work->diagnoser, t, force, s.accel_ok);
}

void AP_RotorDiagnosis::report(const rw_notification &notification, uint64_t now_us)
{
#if HAL_LOGGING_ENABLED
    const rw_event &e = *notification.event;
    constexpr uint8_t most = RW_TOGETHER < 4 ? RW_TOGETHER : 4;
    float loss[4] = {};
    for (uint8_t k = 0; k < most; k++) {
        loss[k] = float(e.loss[k]);
    }
    AP::logger().Write("RWEV", "TimeUS,Num,What,Kind,Rot,Alt,On,End,P,Lo,Hi,L1,L2,L3,L4", "QHBBHHddfffffff", now_us,
                       unsigned(notification.number), unsigned(notification.kind), unsigned(e.kind), unsigned(e.rotors),
                       unsigned(e.alternative_count > 0 ? e.alternatives[0] : 0), double(e.onset), double(e.end < RW_LASTS ? e.end : 0),
                       double(e.probability), double(e.lower[0]), double(e.upper[0]), double(loss[0]), double(loss[1]), double(loss[2]),
                       double(loss[3]));
#endif
}

void AP_RotorDiagnosis::log_losses(uint64_t now_us)
{
#if HAL_LOGGING_ENABLED
    double l[RWD_LOGGED_ROTORS];
    for (uint8_t k = 0; k < RWD_LOGGED_ROTORS; k++) {
        l[k] = k < RW_ROTORS ? double(_work->loss[k]) : double(AP::logger().quiet_nanf());
    }
    AP::logger().Write("RWLS", "TimeUS,Verd,Drop,L1,L2,L3,L4,L5,L6,L7,L8,L9,L10,L11,L12", "QBHffffffffffff", now_us,
                       unsigned(_work->verdict), unsigned(_work->dropped), l[0], l[1], l[2], l[3], l[4], l[5], l[6], l[7], l[8], l[9], l[10],
                       l[11]);
#endif
}

float AP_RotorDiagnosis::loss(uint8_t rotor)
{
    if (_work == nullptr || rotor >= RW_ROTORS) {
        return 0.0f;
    }
    WITH_SEMAPHORE(_work->sem);
    return _work->loss[rotor];
}

uint8_t AP_RotorDiagnosis::verdict()
{
    if (_work == nullptr) {
        return RW_NOT_ASSESSED;
    }
    WITH_SEMAPHORE(_work->sem);
    return _work->verdict;
}
