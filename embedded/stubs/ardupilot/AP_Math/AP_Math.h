/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <math.h>
#include <stdint.h>
template <typename T> class Vector3 {
public:
    T x, y, z;
    constexpr Vector3() : x(0), y(0), z(0) {}
    constexpr Vector3(const T x0, const T y0, const T z0) : x(x0), y(y0), z(z0) {}
};
typedef Vector3<float> Vector3f;
template <typename T> class QuaternionT {
public:
    T q1, q2, q3, q4;
    QuaternionT() : q1(1), q2(0), q3(0), q4(0) {}
    QuaternionT(const T _q1, const T _q2, const T _q3, const T _q4) : q1(_q1), q2(_q2), q3(_q3), q4(_q4) {}
};
typedef QuaternionT<float> Quaternion;
template <typename T> float sq(const T val) { return float(val) * float(val); }
bool is_zero(const float x);
