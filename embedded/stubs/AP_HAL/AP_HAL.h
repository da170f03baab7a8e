/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
namespace AP_HAL
{
uint64_t micros64();
}
struct Vector3f {
    float x, y, z;
};
