/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <parameters/param.h>
inline static param_t param_handle(px4::params p) { return static_cast<param_t>(p); }
namespace do_not_explicitly_use_this_namespace
{
template <px4::params p> class ParamInt
{
public:
	ParamInt() { update(); }
	int32_t get() const { return _val; }
	bool update() { return param_get(param_handle(p), &_val) == 0; }

private:
	int32_t _val{};
};
template <px4::params p> class ParamBool
{
public:
	ParamBool() { update(); }
	bool get() const { return _val; }
	bool update()
	{
		int32_t value = 0;
		const bool got = param_get(param_handle(p), &value) == 0;
		_val = value != 0;
		return got;
	}

private:
	bool _val{};
};
}
// (ParamInt<px4::params::NAME>) member: the brackets go, a declaration stays; STRIP leaves the member alone.
#define STUB_PLAIN(...) __VA_ARGS__
#define STUB_DECLARE(x) do_not_explicitly_use_this_namespace::STUB_PLAIN x
#define STUB_DROP(...)
#define STUB_MEMBER(x) STUB_DROP x
#define DEFINE_PARAMETERS(a, b) \
	STUB_DECLARE(a); \
	STUB_DECLARE(b); \
protected: \
	void updateParamsImpl() final \
	{ \
		STUB_MEMBER(a).update(); \
		STUB_MEMBER(b).update(); \
	} \
private:
