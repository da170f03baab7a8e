/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
enum MAV_SEVERITY { MAV_SEVERITY_CRITICAL = 2, MAV_SEVERITY_WARNING = 4, MAV_SEVERITY_NOTICE = 5 };
void gcs_stub(MAV_SEVERITY severity, const char *format, ...);
#define GCS_SEND_TEXT(severity, ...) gcs_stub(severity, __VA_ARGS__)
