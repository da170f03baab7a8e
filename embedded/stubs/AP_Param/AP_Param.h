/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
class AP_Int8 {
public:
    int8_t get() const { return _value; }
    void set(int8_t value) { _value = value; }

private:
    int8_t _value {};
};
class AP_Param {
public:
    struct GroupInfo {
        const char *name;
        uint8_t index;
        double value;
    };
    static void setup_object_defaults(void *, const GroupInfo *) {}
};
#define AP_PARAM_FLAG_ENABLE 1
#define AP_GROUPINFO_FLAGS(name, index, type, member, value, flags) {name, index, double(value)}
#define AP_GROUPINFO(name, index, type, member, value) {name, index, double(value)}
#define AP_GROUPEND {nullptr, 0, 0.0}
