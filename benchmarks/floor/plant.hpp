// The plant of the benchmark by hand: a rigid body with four rotors, 12 states and 4 losses, pose measured.
// x = position, Euler angles, velocity, body rates; World NED, body FRD. numbers.hpp holds what the Python plant is built from.
#pragma once
#include <Eigen/Dense>
#include <cmath>
#include <cstdint>

#include "numbers.hpp"

namespace floor_ {

constexpr int NX = 12, NT = 4, NS = NX + NT, NU = 4, NY = 6;

template <int R, int C>
using Mat = Eigen::Matrix<double, R, C>;
template <int N>
using Vec = Eigen::Matrix<double, N, 1>;
using VecX = Vec<NX>;
using VecT = Vec<NT>;
using VecS = Vec<NS>;
using VecY = Vec<NY>;
using MatX = Mat<NX, NX>;
using MatS = Mat<NS, NS>;
using MatT = Mat<NT, NT>;
using MatXT = Mat<NX, NT>;
using MatY = Mat<NY, NY>;

inline const Eigen::Matrix3d INERTIA = Eigen::Map<const Eigen::Matrix3d>(numbers::J);
inline const Eigen::Matrix3d INERTIA_INVERSE = Eigen::Map<const Eigen::Matrix3d>(numbers::J_INVERSE);
inline const Mat<3, NU> B_TAU = Eigen::Map<const Mat<3, NU>>(numbers::B_TAU);
inline const Vec<NU> B_T = Eigen::Map<const Vec<NU>>(numbers::B_T);
inline const VecX Q_DIAGONAL = numbers::DT * Eigen::Map<const VecX>(numbers::WALK);
inline const VecY R_DIAGONAL = Eigen::Map<const VecY>(numbers::R);

// What is kept of a step: states, losses, variances of the losses.
struct Kept {
    double x[NX], theta[NT], variance[NT];
};

// x after a step of Euler's rule.
template <class X, class T>
inline VecX f(const X &x, const Vec<NU> &u, const T &theta)
{
    using std::cos;
    using std::sin;
    const double s_phi = sin(x[3]), c_phi = cos(x[3]), s_theta = sin(x[4]), c_theta = cos(x[4]);
    const double s_psi = sin(x[5]), c_psi = cos(x[5]);
    const Vec<NU> thrust = u.array() * (1.0 - theta.array());
    const double push = B_T.dot(thrust) / numbers::MASS;
    const Eigen::Vector3d omega(x[9], x[10], x[11]);
    const double turning = omega[1] * s_phi + omega[2] * c_phi, rate = turning / c_theta;
    const Eigen::Vector3d torque = B_TAU * thrust - omega.cross(INERTIA * omega);
    VecX d;
    d[0] = x[6];
    d[1] = x[7];
    d[2] = x[8];
    d[3] = omega[0] + rate * s_theta;
    d[4] = omega[1] * c_phi - omega[2] * s_phi;
    d[5] = rate;
    d[6] = -(c_phi * s_theta * c_psi + s_phi * s_psi) * push;
    d[7] = -(c_phi * s_theta * s_psi - s_phi * c_psi) * push;
    d[8] = numbers::GRAVITY - c_phi * c_theta * push;
    d.tail<3>() = INERTIA_INVERSE * torque;
    return x + numbers::DT * d;
}

// The same with its derivatives [F Phi] (12, 16), by hand.
inline VecX f_and_slope(const VecX &x, const Vec<NU> &u, const VecT &theta, Mat<NX, NS> &G)
{
    using std::cos;
    using std::sin;
    const double s_phi = sin(x[3]), c_phi = cos(x[3]), s_theta = sin(x[4]), c_theta = cos(x[4]);
    const double s_psi = sin(x[5]), c_psi = cos(x[5]), dt = numbers::DT;
    const Vec<NU> thrust = u.array() * (1.0 - theta.array());
    const double push = B_T.dot(thrust) / numbers::MASS;
    const Eigen::Vector3d omega = x.tail<3>(), momentum = INERTIA * omega;
    const double turning = omega[1] * s_phi + omega[2] * c_phi, across = omega[1] * c_phi - omega[2] * s_phi;
    const double secant = 1.0 / c_theta, rate = turning * secant, tangent = s_theta * secant;
    const Eigen::Vector3d down(c_phi * s_theta * c_psi + s_phi * s_psi, c_phi * s_theta * s_psi - s_phi * c_psi, c_phi * c_theta);
    VecX d;
    d.head<3>() = x.segment<3>(6);
    d[3] = omega[0] + rate * s_theta;
    d[4] = across;
    d[5] = rate;
    d.segment<3>(6) = -push * down;
    d[8] += numbers::GRAVITY;
    d.tail<3>() = INERTIA_INVERSE * (B_TAU * thrust - omega.cross(momentum));

    G.setZero();
    G.leftCols<NX>().setIdentity();
    G(0, 6) = G(1, 7) = G(2, 8) = dt;
    G(3, 3) += dt * across * tangent;
    G(3, 4) = dt * rate * secant;
    G(4, 3) = -dt * turning;
    G(5, 3) = dt * across * secant;
    G(5, 4) = dt * rate * tangent;
    G(3, 9) = dt;
    G(3, 10) = dt * s_phi * tangent;
    G(3, 11) = dt * c_phi * tangent;
    G(4, 10) = dt * c_phi;
    G(4, 11) = -dt * s_phi;
    G(5, 10) = dt * s_phi * secant;
    G(5, 11) = dt * c_phi * secant;
    const double k = -dt * push;
    G(6, 3) = k * (-s_phi * s_theta * c_psi + c_phi * s_psi);
    G(7, 3) = k * (-s_phi * s_theta * s_psi - c_phi * c_psi);
    G(8, 3) = -k * s_phi * c_theta;
    G(6, 4) = k * c_phi * c_theta * c_psi;
    G(7, 4) = k * c_phi * c_theta * s_psi;
    G(8, 4) = -k * c_phi * s_theta;
    G(6, 5) = k * (-c_phi * s_theta * s_psi + s_phi * c_psi);
    G(7, 5) = k * (c_phi * s_theta * c_psi + s_phi * s_psi);
    Eigen::Matrix3d gyro;  // d(omega x J omega) / d omega = [omega]x J - [J omega]x
    for (int i = 0; i < 3; ++i)
        gyro.col(i) = omega.cross(INERTIA.col(i)) + Eigen::Vector3d::Unit(i).cross(momentum);
    G.block<3, 3>(9, 9) -= dt * INERTIA_INVERSE * gyro;
    for (int i = 0; i < NU; ++i) {
        G.block<3, 1>(6, NX + i) = (dt * B_T[i] * u[i] / numbers::MASS) * down;
        G.block<3, 1>(9, NX + i) = (-dt * u[i]) * (INERTIA_INVERSE * B_TAU.col(i));
    }
    return x + dt * d;
}

template <class P>
inline void symmetrise(P &p)
{
    p = (0.5 * (p + p.transpose())).eval();
}

}  // namespace floor_
