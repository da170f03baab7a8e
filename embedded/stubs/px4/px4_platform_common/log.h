/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
__BEGIN_DECLS
__EXPORT void px4_log_modulename(int level, const char *module, const char *format, ...) __attribute__((format(printf, 3, 4)));
__END_DECLS
#define PX4_INFO(format, ...) px4_log_modulename(1, MODULE_NAME, format, ##__VA_ARGS__)
#define PX4_WARN(format, ...) px4_log_modulename(2, MODULE_NAME, format, ##__VA_ARGS__)
#define PX4_ERR(format, ...) px4_log_modulename(3, MODULE_NAME, format, ##__VA_ARGS__)
