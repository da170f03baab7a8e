/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_HAL/AP_HAL.h>
class AP_Vehicle {
public:
    AP_Vehicle() {}
    virtual ~AP_Vehicle() {}
    CLASS_NO_COPY(AP_Vehicle);
    static AP_Vehicle *get_singleton();
    bool get_likely_flying() const { return likely_flying; }

protected:
    friend struct World;
    void set_likely_flying(bool b) { likely_flying = b; }

private:
    bool likely_flying = false;
};
namespace AP
{
AP_Vehicle *vehicle();
}
