/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_Common/AP_Common.h>
class AP_Logger {
public:
    AP_Logger(const AP_Logger &other) = delete;
    AP_Logger &operator=(const AP_Logger &) = delete;
    static AP_Logger *get_singleton();
    void Write(const char *name, const char *labels, const char *fmt, ...);
    void Write(const char *name, const char *labels, const char *units, const char *mults, const char *fmt, ...);
    float quiet_nanf() const;

private:
    friend struct World;
    AP_Logger() {}
};
namespace AP
{
AP_Logger &logger();
}
