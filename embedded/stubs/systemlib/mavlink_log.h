/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
typedef void *orb_advert_t;
void mavlink_stub(orb_advert_t *, const char *format, ...);
#define mavlink_log_critical(pub, ...) mavlink_stub(pub, __VA_ARGS__)
#define mavlink_log_warning(pub, ...) mavlink_stub(pub, __VA_ARGS__)
#define mavlink_log_info(pub, ...) mavlink_stub(pub, __VA_ARGS__)
