/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_Common/AP_Common.h>
typedef enum MAV_SEVERITY {
    MAV_SEVERITY_EMERGENCY = 0,
    MAV_SEVERITY_ALERT = 1,
    MAV_SEVERITY_CRITICAL = 2,
    MAV_SEVERITY_ERROR = 3,
    MAV_SEVERITY_WARNING = 4,
    MAV_SEVERITY_NOTICE = 5,
    MAV_SEVERITY_INFO = 6,
    MAV_SEVERITY_DEBUG = 7,
    MAV_SEVERITY_ENUM_END = 8
} MAV_SEVERITY;
class GCS {
public:
    CLASS_NO_COPY(GCS);
    static GCS *get_singleton();
    void send_text(MAV_SEVERITY severity, const char *fmt, ...) FMT_PRINTF(3, 4);

private:
    friend struct World;
    GCS() {}
};
GCS &gcs();
#define GCS_SEND_TEXT(severity, format, args...) gcs().send_text(severity, format, ##args)
