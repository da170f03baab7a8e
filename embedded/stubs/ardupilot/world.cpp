/* See world.h. MIT. */
#include "world.h"

#include <AP_Logger/AP_Logger.h>
#include <AP_Param/AP_Param.h>
#include <GCS_MAVLink/GCS.h>
#include <SRV_Channel/SRV_Channel.h>
#include <condition_variable>
#include <cstdarg>
#include <mutex>
#include <thread>

uint64_t World::now_us;
uint16_t World::pwm[32];
uint32_t World::pwm_known;
AP_MotorsMatrix_Scripting_Dynamic World::motors;
FILE *World::out = stdout;

/* The turn is either the test's or the thread's. */
static std::mutex mutex;
static std::condition_variable turned;
static bool threads_turn, started;

namespace
{
class StubScheduler : public AP_HAL::Scheduler
{
public:
    void delay(uint16_t ms) override { delay_microseconds(1000); }
    void delay_microseconds(uint16_t) override
    {
        std::unique_lock<std::mutex> lock(mutex);
        threads_turn = false;
        turned.notify_all();
        turned.wait(lock, [] { return threads_turn; });
    }
    bool in_main_thread() const override { return !threads_turn; }
    bool thread_create(AP_HAL::MemberProc proc, const char *, uint32_t stack_size, priority_base, int8_t) override
    {
        if (stack_size < 512) {
            return false;
        }
        started = true;
        std::thread([proc] {
            {
                std::unique_lock<std::mutex> lock(mutex);
                turned.wait(lock, [] { return threads_turn; });
            }
            proc();
        }).detach();
        return true;
    }
};
class StubUtil : public AP_HAL::Util
{
public:
    void set(bool armed) { soft_armed = armed; }
};
StubScheduler scheduler;
StubUtil util;
AP_InertialSensor sensors;
AP_AHRS estimates;
AP_Vehicle craft;
const AP_HAL::HAL the_hal(&scheduler, &util);
}
const AP_HAL::HAL &AP_HAL::get_HAL() { return the_hal; }
extern const AP_HAL::HAL &hal;
const AP_HAL::HAL &hal = the_hal;

void World::let()
{
    if (!started) {
        return;
    }
    std::unique_lock<std::mutex> lock(mutex);
    threads_turn = true;
    turned.notify_all();
    turned.wait(lock, [] { return !threads_turn; });
}
bool World::threads() { return started; }

struct HAL_Semaphore::Lock {
    std::recursive_mutex mutex;
};
HAL_Semaphore::HAL_Semaphore() : _lock(new Lock) {}
HAL_Semaphore::~HAL_Semaphore() { delete _lock; }
bool HAL_Semaphore::take(uint32_t)
{
    _lock->mutex.lock();
    return true;
}
bool HAL_Semaphore::take_nonblocking() { return _lock->mutex.try_lock(); }
void HAL_Semaphore::take_blocking() { _lock->mutex.lock(); }
bool HAL_Semaphore::give()
{
    _lock->mutex.unlock();
    return true;
}
WithSemaphore::WithSemaphore(AP_HAL::Semaphore &sem, uint32_t) : _sem(sem) { _sem.take_blocking(); }
WithSemaphore::~WithSemaphore() { _sem.give(); }

uint64_t AP_HAL::micros64() { return World::now_us; }
bool is_zero(const float x) { return fabsf(x) < 1e-7f; }

void AP_Param::setup_object_defaults(const void *object_pointer, const struct GroupInfo *group_info)
{
    for (const GroupInfo *g = group_info; g->type != AP_PARAM_NONE; g++) {
        char *at = const_cast<char *>(static_cast<const char *>(object_pointer)) + g->offset;
        if (g->type == AP_PARAM_INT8) {
            reinterpret_cast<AP_Int8 *>(at)->set(int8_t(g->def_value));
        }
    }
}

AP_InertialSensor *AP_InertialSensor::get_singleton() { return &sensors; }
AP_InertialSensor &AP::ins() { return sensors; }
AP_AHRS *AP_AHRS::get_singleton() { return &estimates; }
AP_AHRS &AP::ahrs() { return estimates; }
AP_Vehicle *AP_Vehicle::get_singleton() { return &craft; }
AP_Vehicle *AP::vehicle() { return &craft; }
AP_Motors *AP_Motors::get_singleton() { return &World::motors; }
AP_Motors *AP::motors() { return &World::motors; }

bool AP_AHRS::get_quaternion(Quaternion &quat) const
{
    quat = state.quat;
    return state.quat_ok;
}
bool AP_AHRS::get_velocity_NED(Vector3f &vec) const
{
    vec = state.velocity_NED;
    return state.velocity_NED_ok;
}
AP_MotorsMatrix_Scripting_Dynamic *AP_MotorsMatrix_Scripting_Dynamic::get_singleton() { return &World::motors; }
void AP_MotorsMatrix_Scripting_Dynamic::load_factors(const factor_table &table)
{
    fprintf(World::out, "factors\t%.6f", double(World::now_us) / 1000000);
    for (int k = 0; k < AP_MOTORS_MAX_NUM_MOTORS; k++) {
        fprintf(World::out, "\t%.6f\t%.6f\t%.6f\t%.6f", double(table.roll[k]), double(table.pitch[k]), double(table.yaw[k]),
                double(table.throttle[k]));
    }
    fprintf(World::out, "\n");
}
bool SRV_Channels::get_output_pwm(SRV_Channel::Function function, uint16_t &value)
{
    for (uint8_t k = 0; k < 32; k++) {
        if (get_motor_function(k) == function) {
            value = World::pwm[k];
            return ((World::pwm_known >> k) & 1) != 0;
        }
    }
    return false;
}

static Vector3f vector(const double *x) { return Vector3f(float(x[0]), float(x[1]), float(x[2])); }
void World::gyro(const double *x, bool ok)
{
    sensors._gyro[0] = vector(x);
    sensors._gyro_healthy[0] = ok;
}
void World::accel(const double *x, bool ok)
{
    sensors._accel[0] = vector(x);
    sensors._accel_healthy[0] = ok;
}
void World::attitude(const double *x)
{
    estimates.state.quat = Quaternion(float(x[0]), float(x[1]), float(x[2]), float(x[3]));
    estimates.state.quat_ok = true;
}
void World::velocity(const double *x)
{
    estimates.state.velocity_NED = vector(x);
    estimates.state.velocity_NED_ok = true;
}
void World::control(const double *x)
{
    motors._roll_in = float(x[0]);
    motors._pitch_in = float(x[1]);
    motors._yaw_in = float(x[2]);
    motors._throttle = float(x[3]);
}
void World::battery(double ratio, double expo) { motors.thr_lin.lift_max = float((1 - expo) * ratio + expo * ratio * ratio); }
void World::flying(bool flies) { craft.set_likely_flying(flies); }
void World::armed(bool is) { util.set(is); }

GCS &gcs()
{
    static char room[sizeof(GCS) + 1];
    return *reinterpret_cast<GCS *>(room);
}
void GCS::send_text(MAV_SEVERITY severity, const char *fmt, ...)
{
    char text[200];
    va_list list;
    va_start(list, fmt);
    vsnprintf(text, sizeof text, fmt, list);
    va_end(list);
    fprintf(World::out, "text\t%.6f\t%d\t%s\n", double(World::now_us) / 1000000, int(severity), text);
}

AP_Logger &AP::logger()
{
    static char room[sizeof(AP_Logger) + 1];
    return *reinterpret_cast<AP_Logger *>(room);
}
float AP_Logger::quiet_nanf() const { return nanf("0x4152"); }
/* As ArduPilot does: what a letter stands for decides how the argument is taken. */
void AP_Logger::Write(const char *name, const char *labels, const char *fmt, ...)
{
    va_list list;
    va_start(list, fmt);
    fprintf(World::out, "log\t%s\t%s", name, labels);
    for (const char *f = fmt; *f != 0; f++) {
        if (*f == 'Q') {
            fprintf(World::out, "\t%llu", static_cast<unsigned long long>(va_arg(list, uint64_t)));
        } else if (*f == 'B' || *f == 'H') {
            fprintf(World::out, "\t%d", va_arg(list, int));
        } else if (*f == 'f' || *f == 'd') {
            fprintf(World::out, "\t%.9g", va_arg(list, double));
        } else {
            fprintf(World::out, "\t?");
        }
    }
    fprintf(World::out, "\n");
    va_end(list);
}
