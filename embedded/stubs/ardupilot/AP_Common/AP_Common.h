/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <stdint.h>
#include <stddef.h>
#if __has_include(<new>)
#include <new>
#else /* a compiler for boards without its C++ library */
namespace std
{
struct nothrow_t {
};
extern const nothrow_t nothrow;
}
void *operator new(size_t, const std::nothrow_t &) noexcept;
#endif
#define CLASS_NO_COPY(c) \
    c(const c &other) = delete; \
    c &operator=(const c &) = delete
#define WARN_IF_UNUSED __attribute__((warn_unused_result))
#define FMT_PRINTF(text, first) __attribute__((format(printf, text, first)))
#define NEW_NOTHROW new (std::nothrow)
#define HAL_GCS_ENABLED 1
#define HAL_LOGGING_ENABLED 1
template <typename T, size_t N> constexpr size_t stub_size(const T (&)[N]) { return N; }
#define ARRAY_SIZE(a) stub_size(a)
struct World; // what the test sets and reads: world.h
