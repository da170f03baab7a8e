/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_HAL/AP_HAL.h>
#define LOOP_RATE 0
#define SCHED_TASK_CLASS(classname, classptr, func, _rate_hz, _max_time_micros, _priority) \
    { Functor<void>::bind<classname, &classname::func>(classptr), #classname "::" #func, _rate_hz, _max_time_micros, _priority }
class AP_Scheduler {
public:
    FUNCTOR_TYPEDEF(task_fn_t, void);
    struct Task {
        task_fn_t function;
        const char *name;
        float rate_hz;
        uint16_t max_time_micros;
        uint8_t priority;
    };
};
