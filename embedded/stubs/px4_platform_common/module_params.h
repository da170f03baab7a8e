/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <parameters/param.h>
class ModuleParams
{
public:
	explicit ModuleParams(ModuleParams *) {}
};
template <px4::params P> struct ParamBool {
	bool get() const { return true; }
};
template <px4::params P> struct ParamInt {
	int get() const { return 5; }
};
// (ParamInt<px4::params::NAME>) member: the brackets go, a declaration stays.
#define RW_STUB_DECLARE(...) __VA_ARGS__
#define DEFINE_PARAMETERS(a, b) RW_STUB_DECLARE a; RW_STUB_DECLARE b;
