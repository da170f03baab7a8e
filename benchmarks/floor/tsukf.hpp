// Two-stage unscented Kalman filter: 25 points of the states, losses by a linear coupling beta.
#pragma once
#include "ukf.hpp"

namespace floor_ {

struct Tsukf {
    VecX x;
    MatX P_free;
    MatXT beta;
    VecT theta;
    MatT P_theta;

    void init()
    {
        x.setZero();
        P_free.setIdentity();
        beta.setZero();
        theta.setZero();
        P_theta = numbers::THETA_VAR * MatT::Identity();
    }

    void step(const double *u_, const double *y, const std::uint8_t *valid, Kept &kept)
    {
        using W = Points<NX>;
        const Vec<NU> u = Eigen::Map<const Vec<NU>>(u_);
        const double spread = W::spread();
        MatX L;
        root<NX>(P_free, L);
        const VecX centre = f(x, u, theta);
        MatX D, E;
        for (int i = 0; i < NX; ++i) {
            const VecX out = spread * L.col(i);
            const VecX plus = f((x + out).eval(), u, theta) - centre, minus = f((x - out).eval(), u, theta) - centre;
            E.col(i) = 0.5 * (plus + minus);
            D.col(i) = (plus - minus) / (2.0 * spread);
        }
        const VecX m = 2.0 * W::side * E.rowwise().sum();

        // r = D L^-1 beta + df/dtheta
        MatXT through = beta;
        L.triangularView<Eigen::Lower>().solveInPlace(through);
        MatXT r;
        r.noalias() = D * through;
        slope_by_theta(r, u);
        MatXT r_P;
        r_P.noalias() = r * P_theta;
        MatT P_next = P_theta;
        P_next.diagonal().array() += numbers::DT * numbers::THETA_WALK;
        MatT L_theta;
        root<NT>(P_next, L_theta);
        Mat<NT, NX> turned = r_P.transpose();
        L_theta.triangularView<Eigen::Lower>().solveInPlace(turned);
        L_theta.transpose().triangularView<Eigen::Upper>().solveInPlace(turned);
        beta = turned.transpose();
        x = centre + m;
        P_free.noalias() = D * D.transpose();
        P_free.noalias() += 2.0 * W::side * E * E.transpose();
        P_free += W::bend * m * m.transpose();
        P_free.noalias() += r_P * (r - beta).transpose();
        P_free.diagonal() += Q_DIAGONAL;
        symmetrise(P_free);

        root<NX>(P_free, L);
        VecY expected;
        Mat<NY, NX> seen;
        MatY curvature;
        measure<NX>(x, L, expected, seen, curvature);
        through = beta;
        L.triangularView<Eigen::Lower>().solveInPlace(through);
        Mat<NY, NT> H;
        H.noalias() = seen * through;
        MatY P_yy = curvature;
        P_yy.noalias() += seen * seen.transpose();
        P_yy.diagonal() += R_DIAGONAL;
        Mat<NT, NY> P_H;
        P_H.noalias() = P_next * H.transpose();
        MatY S = P_yy;
        S.noalias() += H * P_H;
        symmetrise(S);
        Mat<NX, NY> P_xy;
        P_xy.noalias() = L * seen.transpose();
        const Mat<NX, NY> K_x = gain<NX>(P_xy, P_yy, valid);
        const Mat<NT, NY> K_theta = gain<NT>(P_H, S, valid);
        VecY e;
        for (int i = 0; i < NY; ++i)
            e[i] = valid[i] ? y[i] - expected[i] : 0.0;
        const VecT change = K_theta * e;
        theta += change;
        beta.noalias() -= K_x * H;
        MatT rest = MatT::Identity();
        rest.noalias() -= K_theta * H;
        Mat<NT, NY> KP;
        KP.noalias() = K_theta * P_yy;
        MatT rest_P;
        rest_P.noalias() = rest * P_next;
        P_theta.noalias() = rest_P * rest.transpose();
        P_theta.noalias() += KP * K_theta.transpose();
        symmetrise(P_theta);
        correct<NX>(L, seen, curvature, K_x, P_free);
        x.noalias() += K_x * e;
        x.noalias() += beta * change;
        for (int i = 0; i < NX; ++i)
            kept.x[i] = x[i];
        for (int i = 0; i < NT; ++i) {
            kept.theta[i] = theta[i];
            kept.variance[i] = P_theta(i, i);
        }
    }

    // df/dtheta at the centre, by hand.
    void slope_by_theta(MatXT &r, const Vec<NU> &u) const
    {
        const double s_phi = std::sin(x[3]), c_phi = std::cos(x[3]), s_theta = std::sin(x[4]), c_theta = std::cos(x[4]);
        const double s_psi = std::sin(x[5]), c_psi = std::cos(x[5]), dt = numbers::DT;
        const Eigen::Vector3d down(c_phi * s_theta * c_psi + s_phi * s_psi, c_phi * s_theta * s_psi - s_phi * c_psi, c_phi * c_theta);
        for (int i = 0; i < NU; ++i) {
            r.block<3, 1>(6, i) += (dt * B_T[i] * u[i] / numbers::MASS) * down;
            r.block<3, 1>(9, i) += (-dt * u[i]) * (INERTIA_INVERSE * B_TAU.col(i));
        }
    }
};

}  // namespace floor_
