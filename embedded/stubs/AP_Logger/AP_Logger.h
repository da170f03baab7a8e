/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
class AP_Logger {
public:
    void Write(const char *name, const char *labels, const char *format, ...);
};
namespace AP
{
AP_Logger &logger();
}
