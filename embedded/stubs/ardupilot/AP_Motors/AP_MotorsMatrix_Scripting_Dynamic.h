/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#define AP_SCRIPTING_ENABLED 1
#include "AP_MotorsMulticopter.h"
class AP_MotorsMatrix_Scripting_Dynamic : public AP_MotorsMulticopter {
public:
    static AP_MotorsMatrix_Scripting_Dynamic *get_singleton();
    struct factor_table {
        float roll[AP_MOTORS_MAX_NUM_MOTORS];
        float pitch[AP_MOTORS_MAX_NUM_MOTORS];
        float yaw[AP_MOTORS_MAX_NUM_MOTORS];
        float throttle[AP_MOTORS_MAX_NUM_MOTORS];
    };
    void load_factors(const factor_table &table);
};
