/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <stdint.h>
typedef uint16_t param_t;
namespace px4
{
/* Of the module.yaml files, sorted. */
enum class params : uint16_t { ROTW_ACT, ROTW_EN, ROTW_TEXT };
}
__BEGIN_DECLS
__EXPORT param_t param_find(const char *name);
__EXPORT int param_get(param_t param, void *val);
__END_DECLS
