/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_Param/AP_Param.h>
class AP_Motors;
class Thrust_Linearization {
    friend class AP_MotorsMulticopter;
    friend struct World;

public:
    Thrust_Linearization(AP_Motors &_motors) : motors(_motors) {}
    float get_spin_min() const { return spin_min.get(); }
    float get_spin_max() const { return spin_max.get(); }
    int8_t get_battery_index() const { return batt_idx.get(); }
    float get_battery_min_voltage() const { return batt_voltage_min.get(); }
    float get_lift_max() const { return lift_max; }

protected:
    AP_Float curve_expo;
    AP_Float spin_min;
    AP_Float spin_max;
    AP_Int8 batt_idx;
    AP_Float batt_voltage_max;
    AP_Float batt_voltage_min;

private:
    float lift_max = 1;
    float throttle_limit = 1;
    float batt_voltage_filt = 1; // a filter there
    AP_Motors &motors;
};
