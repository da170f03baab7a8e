/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_Common/AP_Common.h>
#include <AP_HAL/utility/functor.h>
namespace AP_HAL
{
uint64_t micros64();
FUNCTOR_TYPEDEF(MemberProc, void);
class Semaphore {
public:
    Semaphore() {}
    CLASS_NO_COPY(Semaphore);
    virtual bool take(uint32_t timeout_ms) WARN_IF_UNUSED = 0;
    virtual bool take_nonblocking() WARN_IF_UNUSED = 0;
    virtual void take_blocking() = 0;
    virtual bool give() = 0;
    virtual ~Semaphore() {}
};
class Scheduler {
public:
    enum priority_base {
        PRIORITY_BOOST,
        PRIORITY_MAIN,
        PRIORITY_SPI,
        PRIORITY_I2C,
        PRIORITY_CAN,
        PRIORITY_TIMER,
        PRIORITY_RCOUT,
        PRIORITY_LED,
        PRIORITY_RCIN,
        PRIORITY_IO,
        PRIORITY_UART,
        PRIORITY_STORAGE,
        PRIORITY_SCRIPTING,
        PRIORITY_NET,
    };
    virtual ~Scheduler() {}
    virtual void delay(uint16_t ms) = 0;
    virtual void delay_microseconds(uint16_t us) = 0;
    virtual bool in_main_thread() const = 0;
    virtual bool thread_create(MemberProc proc, const char *name, uint32_t stack_size, priority_base base, int8_t priority)
    {
        return false;
    }
};
class Util {
public:
    virtual ~Util() {}
    bool get_soft_armed() const { return soft_armed; }

protected:
    bool soft_armed = false;
};
class HAL {
public:
    HAL(Scheduler *_scheduler, Util *_util) : scheduler(_scheduler), util(_util) {}
    Scheduler *scheduler;
    Util *util;
};
const HAL &get_HAL();
}
class HAL_Semaphore : public AP_HAL::Semaphore {
public:
    HAL_Semaphore();
    ~HAL_Semaphore() override;
    bool take(uint32_t timeout_ms) override WARN_IF_UNUSED;
    bool take_nonblocking() override WARN_IF_UNUSED;
    void take_blocking() override;
    bool give() override;

private:
    struct Lock;
    Lock *_lock;
};
class WithSemaphore {
public:
    WithSemaphore(AP_HAL::Semaphore &sem, uint32_t line);
    ~WithSemaphore();

private:
    AP_HAL::Semaphore &_sem;
};
#define STUB_JOIN2(a, b) a##b
#define STUB_JOIN(a, b) STUB_JOIN2(a, b)
#define WITH_SEMAPHORE(sem) WithSemaphore STUB_JOIN(_getsem, __COUNTER__)(sem, __AP_LINE__)
