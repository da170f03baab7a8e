/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_Common/AP_Common.h>
#include <stddef.h>
#define AP_MAX_NAME_SIZE 16
#define AP_PARAM_FLAG_NESTED_OFFSET (1 << 0)
#define AP_PARAM_FLAG_POINTER (1 << 1)
#define AP_PARAM_FLAG_ENABLE (1 << 2)
enum ap_var_type {
    AP_PARAM_NONE = 0,
    AP_PARAM_INT8,
    AP_PARAM_INT16,
    AP_PARAM_INT32,
    AP_PARAM_FLOAT,
    AP_PARAM_VECTOR3F,
    AP_PARAM_GROUP
};
class AP_Param {
public:
    struct GroupInfo {
        const char *name;
        ptrdiff_t offset;
        union {
            const struct GroupInfo *group_info;
            const float def_value;
        };
        uint16_t flags;
        uint8_t idx;
        uint8_t type;
    };
    static void setup_object_defaults(const void *object_pointer, const struct GroupInfo *group_info);
};
template <typename T, ap_var_type PT> class AP_ParamT : public AP_Param {
public:
    static const ap_var_type vtype = PT;
    const T &get() const { return _value; }
    void set(const T &v) { _value = v; }
    void set_and_save(const T &v) { _value = v; }
    operator const T &() const { return _value; }

protected:
    T _value;
};
typedef AP_ParamT<float, AP_PARAM_FLOAT> AP_Float;
typedef AP_ParamT<int8_t, AP_PARAM_INT8> AP_Int8;
typedef AP_ParamT<int16_t, AP_PARAM_INT16> AP_Int16;
typedef AP_ParamT<int32_t, AP_PARAM_INT32> AP_Int32;
#define STUB_OFFSET(clazz, element) (((ptrdiff_t)(&((const clazz *)16)->element)) - 16)
#define STUB_TYPE(clazz, element) uint8_t(((const clazz *)16)->element.vtype)
#define AP_GROUPINFO_FLAGS(name, idx, clazz, element, def, flags) \
    { name, STUB_OFFSET(clazz, element), {def_value : def}, flags, idx, STUB_TYPE(clazz, element) }
#define AP_GROUPINFO(name, idx, clazz, element, def) AP_GROUPINFO_FLAGS(name, idx, clazz, element, def, 0)
#define AP_SUBGROUPINFO(element, name, idx, thisclazz, elclazz) \
    { name, STUB_OFFSET(thisclazz, element), { group_info : elclazz::var_info }, AP_PARAM_FLAG_NESTED_OFFSET, idx, AP_PARAM_GROUP }
#define AP_GROUPEND { "", 0, { group_info : nullptr }, 0, 0xFF, AP_PARAM_NONE }
