// Augmented unscented Kalman filter: 33 points of (x, theta), drawn anew for the measurement, covariances in Joseph's form.
#pragma once
#include "plant.hpp"

namespace floor_ {

// Where the points lie: spread from the centre in standard deviations, weight of each side, what the centre adds to covariances.
template <int N>
struct Points {
    static constexpr double alpha = 0.1, beta = 2.0, size = alpha * alpha * N;
    static double spread() { return std::sqrt(size); }
    static constexpr double side = 0.5 / size, bend = beta - alpha * alpha;
};

// Lower factor of a covariance, also of a singular one.
template <int N>
inline void root(const Mat<N, N> &P, Mat<N, N> &L)
{
    L = P;
    L.diagonal().array() += 1e-14 * P.diagonal().array() + 1e-20;
    Eigen::LLT<Eigen::Ref<Mat<N, N>>> factor(L);
    L.template triangularView<Eigen::StrictlyUpper>().setZero();
}

// Mean slope (times L) and curvature of the measured pose, which are the first rows of the points; mean comes out of it as well.
template <int N>
inline void measure(const Vec<N> &mean, const Mat<N, N> &L, VecY &y, Mat<NY, N> &slope, MatY &curvature)
{
    using W = Points<N>;
    const double spread = W::spread();
    const VecY centre = mean.template head<NY>();
    const Mat<NY, N> out = spread * L.template topRows<NY>();
    const Mat<NY, N> plus = (out.colwise() + centre).colwise() - centre, minus = ((-out).colwise() + centre).colwise() - centre;
    const Mat<NY, N> E = 0.5 * (plus + minus);
    const VecY m = 2.0 * W::side * E.rowwise().sum();
    curvature.noalias() = 2.0 * W::side * E * E.transpose();
    curvature += W::bend * m * m.transpose();
    slope = (plus - minus) / (2.0 * spread);
    y = centre + m;
}

// K (N, 6) = P_xy S^-1 of the valid measurements.
template <int N>
inline Mat<N, NY> gain(const Mat<N, NY> &P_xy, const MatY &S, const std::uint8_t *valid)
{
    MatY T = S;
    Mat<NY, N> K = P_xy.transpose();
    for (int i = 0; i < NY; ++i)
        if (!valid[i]) {
            T.row(i).setZero();
            T.col(i).setZero();
            T(i, i) = 1.0;
            K.row(i).setZero();
        }
    Eigen::LLT<MatY> factor(T);
    factor.solveInPlace(K);
    return K.transpose();
}

// (L - K D)(L - K D)' + K (C + R) K'.
template <int N>
inline void correct(const Mat<N, N> &L, const Mat<NY, N> &slope, const MatY &curvature, const Mat<N, NY> &K, Mat<N, N> &P)
{
    Mat<N, N> rest = L;
    rest.noalias() -= K * slope;
    MatY C = curvature;
    C.diagonal() += R_DIAGONAL;
    Mat<N, NY> KC;
    KC.noalias() = K * C;
    P.noalias() = rest * rest.transpose();
    P.noalias() += KC * K.transpose();
    symmetrise(P);
}

struct Ukf {
    VecS z;
    MatS P;

    void init()
    {
        z.setZero();
        P.setIdentity();
        P.bottomRightCorner<NT, NT>() *= numbers::THETA_VAR;
    }

    void step(const double *u_, const double *y, const std::uint8_t *valid, Kept &kept)
    {
        using W = Points<NS>;
        const Vec<NU> u = Eigen::Map<const Vec<NU>>(u_);
        const double spread = W::spread();
        MatS L;
        root<NS>(P, L);
        const VecX centre = f(z.head<NX>(), u, z.tail<NT>());
        Mat<NX, NS> D, E;
        for (int i = 0; i < NS; ++i) {
            const VecS out = spread * L.col(i), a = z + out, b = z - out;
            const VecX plus = f(a.head<NX>(), u, a.tail<NT>()) - centre, minus = f(b.head<NX>(), u, b.tail<NT>()) - centre;
            E.col(i) = 0.5 * (plus + minus);
            D.col(i) = (plus - minus) / (2.0 * spread);
        }
        const VecX m = 2.0 * W::side * E.rowwise().sum();
        z.head<NX>() = centre + m;
        // The losses stay: their rows of the slope are those of L, and they do not curve.
        MatS slope;
        slope.topRows<NX>() = D;
        slope.bottomRows<NT>() = L.bottomRows<NT>();
        P.noalias() = slope * slope.transpose();
        P.topLeftCorner<NX, NX>().noalias() += 2.0 * W::side * E * E.transpose();
        P.topLeftCorner<NX, NX>() += W::bend * m * m.transpose();
        P.diagonal().head<NX>() += Q_DIAGONAL;
        P.diagonal().tail<NT>().array() += numbers::DT * numbers::THETA_WALK;

        root<NS>(P, L);
        VecY expected;
        Mat<NY, NS> seen;
        MatY curvature;
        measure<NS>(z, L, expected, seen, curvature);
        MatY S = curvature;
        S.noalias() += seen * seen.transpose();
        S.diagonal() += R_DIAGONAL;
        Mat<NS, NY> P_zy;
        P_zy.noalias() = L * seen.transpose();
        const Mat<NS, NY> K = gain<NS>(P_zy, S, valid);
        VecY e;
        for (int i = 0; i < NY; ++i)
            e[i] = valid[i] ? y[i] - expected[i] : 0.0;
        z.noalias() += K * e;
        correct<NS>(L, seen, curvature, K, P);
        for (int i = 0; i < NX; ++i)
            kept.x[i] = z[i];
        for (int i = 0; i < NT; ++i) {
            kept.theta[i] = z[NX + i];
            kept.variance[i] = P(NX + i, NX + i);
        }
    }
};

}  // namespace floor_
