/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include "AP_MotorsMulticopter.h"
#include "AP_Motors_Class.h"
