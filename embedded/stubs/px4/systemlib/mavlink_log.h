/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
__BEGIN_DECLS
__EXPORT void mavlink_vasprintf(int severity, orb_advert_t *mavlink_log_pub, const char *fmt, ...);
__END_DECLS
#define _MSG_PRIO_INFO 6
#define _MSG_PRIO_NOTICE 5
#define _MSG_PRIO_WARNING 4
#define _MSG_PRIO_CRITICAL 2
#define mavlink_log_info(_pub, _text, ...) mavlink_vasprintf(_MSG_PRIO_INFO, _pub, _text, ##__VA_ARGS__);
#define mavlink_log_warning(_pub, _text, ...) mavlink_vasprintf(_MSG_PRIO_WARNING, _pub, _text, ##__VA_ARGS__);
#define mavlink_log_critical(_pub, _text, ...) mavlink_vasprintf(_MSG_PRIO_CRITICAL, _pub, _text, ##__VA_ARGS__);
