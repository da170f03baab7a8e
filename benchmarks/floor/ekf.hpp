// Augmented extended Kalman filter: A P A' block by block, then one scalar update per measurement.
#pragma once
#include "plant.hpp"

namespace floor_ {

struct Ekf {
    VecS s;
    MatS P;

    void init()
    {
        s.setZero();
        P.setIdentity();
        P.bottomRightCorner<NT, NT>() *= numbers::THETA_VAR;
    }

    void step(const double *u_, const double *y, const std::uint8_t *valid, Kept &kept)
    {
        const Vec<NU> u = Eigen::Map<const Vec<NU>>(u_);
        Mat<NX, NS> G;
        s.head<NX>() = f_and_slope(s.head<NX>(), u, s.tail<NT>(), G);
        Mat<NX, NS> GP;
        GP.noalias() = G * P;
        P.topLeftCorner<NX, NX>().noalias() = GP * G.transpose();
        P.topRightCorner<NX, NT>() = GP.rightCols<NT>();
        P.bottomLeftCorner<NT, NX>() = GP.rightCols<NT>().transpose();
        P.diagonal().head<NX>() += Q_DIAGONAL;
        P.diagonal().tail<NT>().array() += numbers::DT * numbers::THETA_WALK;
        for (int i = 0; i < NY; ++i) {
            if (!valid[i])
                continue;
            const VecS Ph = P.col(i);
            const double w = 1.0 / (Ph[i] + R_DIAGONAL[i]);
            s += Ph * (w * (y[i] - s[i]));
            P.noalias() -= (w * Ph) * Ph.transpose();
        }
        symmetrise(P);
        for (int i = 0; i < NX; ++i)
            kept.x[i] = s[i];
        for (int i = 0; i < NT; ++i) {
            kept.theta[i] = s[NX + i];
            kept.variance[i] = P(NX + i, NX + i);
        }
    }
};

}  // namespace floor_
