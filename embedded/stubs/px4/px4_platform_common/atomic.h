/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <stdint.h>
namespace px4
{
template <typename T> class atomic
{
public:
	atomic() = default;
	explicit atomic(T value) : _value(value) {}
	T load() const { return __atomic_load_n(&_value, __ATOMIC_SEQ_CST); }
	void store(T value) { __atomic_store_n(&_value, value, __ATOMIC_SEQ_CST); }
	T fetch_add(T num) { return __atomic_fetch_add(&_value, num, __ATOMIC_SEQ_CST); }

private:
	T _value{};
};
using atomic_int = atomic<int>;
using atomic_bool = atomic<bool>;
}
