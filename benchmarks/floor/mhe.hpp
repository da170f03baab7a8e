// Moving-horizon estimation: Gauss-Newton steps on a window of nodes, each a box-constrained quadratic program solved by an
// active-set method whose linear systems are block tridiagonal; the arrival cost follows by an extended Kalman filter.
#pragma once
#include <algorithm>
#include <array>
#include <limits>

#include "plant.hpp"

namespace floor_ {

struct Mhe {
    static constexpr int M = numbers::MHE_INTERVALS, SAMPLES = numbers::MHE_SAMPLES;
    static_assert(SAMPLES == 2, "written for nodes at every second sample");

    struct Sample {
        Vec<NU> u;
        VecY y;
        std::array<bool, NY> valid;
    };
    using Interval = std::array<Sample, SAMPLES>;
    using Nodes = std::array<VecS, M + 1>;

    VecS s, prior;
    MatS P, prior_P;
    Interval open;
    std::array<Interval, M> window;
    Nodes nodes, force;
    std::array<MatS, M + 1> D;
    std::array<MatS, M> below;
    Nodes g;
    int count, filled;

    void init()
    {
        s.setZero();
        P.setIdentity();
        P.bottomRightCorner<NT, NT>() *= numbers::MHE_THETA_SD * numbers::MHE_THETA_SD;
        prior = s;
        prior_P = P;
        nodes.fill(s);
        force.fill(VecS::Zero());
        count = filled = 0;
    }

    void step(const double *u_, const double *y_, const std::uint8_t *valid, Kept &kept)
    {
        Sample now;
        now.u = Eigen::Map<const Vec<NU>>(u_);
        for (int i = 0; i < NY; ++i) {
            now.valid[i] = valid[i];
            now.y[i] = valid[i] ? y_[i] : 0.0;
        }
        Mat<NX, NS> G;
        s.head<NX>() = f_and_slope(s.head<NX>(), now.u, s.tail<NT>(), G);
        through(G, P, noise(now.u, numbers::DT));
        absorb(s, P, now, now.y - s.head<NY>());
        open[count++] = now;
        const MatS &covariance = P;
        if (count == SAMPLES)
            node();
        for (int i = 0; i < NX; ++i)
            kept.x[i] = s[i];
        for (int i = 0; i < NT; ++i) {
            kept.theta[i] = std::clamp(s[NX + i], numbers::MHE_LOW, numbers::MHE_HIGH);
            kept.variance[i] = covariance(NX + i, NX + i);
        }
    }

private:
    // A P A' + Q with A = [G; 0 I].
    static void through(const Mat<NX, NS> &G, MatS &P, const VecS &Q)
    {
        Mat<NX, NS> GP;
        GP.noalias() = G * P;
        P.topLeftCorner<NX, NX>().noalias() = GP * G.transpose();
        P.topRightCorner<NX, NT>() = GP.rightCols<NT>();
        P.bottomLeftCorner<NT, NX>() = GP.rightCols<NT>().transpose();
        P.diagonal() += Q;
        symmetrise(P);
    }

    // Diagonal of the process noise over dt; losses of rotors at rest hardly walk.
    static VecS noise(const Vec<NU> &u, double dt)
    {
        VecS Q;
        Q.head<NX>() = (dt / numbers::DT) * Q_DIAGONAL;
        Q.head<NX>().array() += numbers::MHE_FLOOR * dt;
        for (int i = 0; i < NT; ++i)
            Q[NX + i] = numbers::MHE_WALK * numbers::MHE_WALK * dt *
                        (std::abs(u[i]) >= numbers::MHE_LEAST[i] ? 1.0 : numbers::MHE_REST);
        return Q;
    }

    // The pose taken in, with innovation e, all valid parts at once.
    static void absorb(VecS &s, MatS &P, const Sample &sample, VecY e)
    {
        Mat<NY, NS> V = P.topRows<NY>();
        MatY S = P.topLeftCorner<NY, NY>();
        for (int i = 0; i < NY; ++i)
            if (!sample.valid[i]) {
                V.row(i).setZero();
                S.row(i).setZero();
                S.col(i).setZero();
                e[i] = 0.0;
            }
        update(s, P, V, S, e);
    }

    // V = H P, S = H P H' (R comes on top).
    static void update(VecS &s, MatS &P, Mat<NY, NS> &V, MatY &S, VecY &e)
    {
        S.diagonal() += R_DIAGONAL;
        Eigen::LLT<MatY> factor(S);
        factor.matrixL().solveInPlace(V);
        factor.matrixL().solveInPlace(e);
        s.noalias() += V.transpose() * e;
        P.noalias() -= V.transpose() * V;
        symmetrise(P);
    }

    // From one node through both samples: end, slope [F Phi] there, and at the inner sample state and slope.
    static VecX interval(const VecS &from, const Interval &samples, Mat<NX, NS> &A, VecX &inner, Mat<NX, NS> &A_inner)
    {
        Mat<NX, NS> G;
        inner = f_and_slope(from.head<NX>(), samples[0].u, from.tail<NT>(), A_inner);
        const VecX end = f_and_slope(inner, samples[1].u, from.tail<NT>(), G);
        A.noalias() = G.leftCols<NX>() * A_inner;
        A.rightCols<NT>() += G.rightCols<NT>();
        return end;
    }

    void node()
    {
        count = 0;
        if (filled == M) {
            leave();
            std::move(window.begin() + 1, window.end(), window.begin());
            std::move(nodes.begin() + 1, nodes.end(), nodes.begin());
            std::move(force.begin() + 1, force.end(), force.begin());
        }
        filled = std::min(filled + 1, M);
        window[filled - 1] = open;
        VecS next = nodes[filled - 1];
        for (const Sample &sample : open)
            next.head<NX>() = f(next.head<NX>().eval(), sample.u, next.tail<NT>());
        nodes[filled] = next;
        const MatS arrival = prior_P.llt().solve(MatS::Identity());
        for (int k = 0; k < numbers::MHE_ITERATIONS; ++k) {
            normal_equations(arrival);
            quadratic_program();
        }
        s = nodes[filled];
    }

    // Prior mean and covariance one node later, linearised at the smoothed nodes.
    void leave()
    {
        Mat<NX, NS> A, A_inner;
        VecX inner;
        const VecX end = interval(nodes[0], window[0], A, inner, A_inner);
        const auto E = A_inner.topRows<NY>();
        VecY e = window[0][0].y - inner.head<NY>();
        e.noalias() += E * (nodes[0] - prior);
        Mat<NY, NS> V;
        V.noalias() = E * prior_P;
        for (int i = 0; i < NY; ++i)
            if (!window[0][0].valid[i]) {
                V.row(i).setZero();
                e[i] = 0.0;
            }
        MatY S;
        S.noalias() = V * E.transpose();
        for (int i = 0; i < NY; ++i)
            if (!window[0][0].valid[i])
                S.col(i).setZero();
        update(prior, prior_P, V, S, e);
        const VecS offset = prior - nodes[0];
        prior.head<NX>() = end;
        prior.head<NX>().noalias() += A * offset;
        through(A, prior_P, noise(window[0][1].u, SAMPLES * numbers::DT));
        absorb(prior, prior_P, window[0][1], window[0][1].y - prior.head<NY>());
    }

    // Block tridiagonal Hessian (D on the diagonal, `below` under it) and minus the gradient.
    void normal_equations(const MatS &arrival)
    {
        D[0] = arrival;
        g[0].noalias() = arrival * (prior - nodes[0]);
        for (int k = 0; k < filled; ++k) {
            Mat<NX, NS> A, A_inner;
            VecX inner;
            const Interval &samples = window[k];
            const VecX end = interval(nodes[k], samples, A, inner, A_inner);
            const VecS Q_inverse = noise(samples[1].u, SAMPLES * numbers::DT).cwiseInverse();
            VecY w, w_last;
            for (int i = 0; i < NY; ++i) {
                w[i] = samples[0].valid[i] ? 1.0 / R_DIAGONAL[i] : 0.0;
                w_last[i] = samples[1].valid[i] ? 1.0 / R_DIAGONAL[i] : 0.0;
            }
            const Mat<NX, NS> QA = Q_inverse.head<NX>().asDiagonal() * A;
            const auto E = A_inner.topRows<NY>();
            const Mat<NY, NS> WE = w.asDiagonal() * E;
            D[k].noalias() += A.transpose() * QA;
            D[k].noalias() += E.transpose() * WE;
            D[k].diagonal().tail<NT>() += Q_inverse.tail<NT>();
            below[k].topRows<NX>() = -QA;
            below[k].bottomRows<NT>().setZero();
            below[k].bottomRightCorner<NT, NT>().diagonal() = -Q_inverse.tail<NT>();
            D[k + 1] = Q_inverse.asDiagonal();
            D[k + 1].diagonal().head<NY>() += w_last;
            VecS defect;
            defect.head<NX>() = Q_inverse.head<NX>().cwiseProduct(end - nodes[k + 1].head<NX>());
            defect.tail<NT>() = Q_inverse.tail<NT>().cwiseProduct(nodes[k].tail<NT>() - nodes[k + 1].tail<NT>());
            g[k].noalias() += WE.transpose() * (samples[0].y - inner.head<NY>());
            g[k].noalias() -= A.transpose() * defect.head<NX>();
            g[k].tail<NT>() -= defect.tail<NT>();
            g[k + 1] = defect;
            g[k + 1].head<NY>() += w_last.cwiseProduct(samples[1].y - nodes[k + 1].head<NY>());
        }
    }

    void banded(const Nodes &v, Nodes &out) const
    {
        for (int k = 0; k <= filled; ++k) {
            out[k].noalias() = D[k] * v[k];
            if (k < filled)
                out[k].noalias() += below[k].transpose() * v[k + 1];
            if (k > 0)
                out[k].noalias() += below[k - 1] * v[k - 1];
        }
    }

    void quadratic_program()
    {
        Nodes move, fixed, right, product;
        std::array<VecS, M + 1> free;
        move.fill(VecS::Zero());
        for (int pass = 0; pass < numbers::MHE_PASSES; ++pass) {
            bool any = false;
            for (int k = 0; k <= filled; ++k) {
                free[k].setOnes();
                fixed[k].setZero();
                for (int i = NX; i < NS; ++i) {
                    const double trial = nodes[k][i] + move[k][i] + force[k][i] / D[k](i, i);
                    const bool low = trial <= numbers::MHE_LOW, high = trial >= numbers::MHE_HIGH;
                    if (low || high) {
                        any = true;
                        free[k][i] = 0.0;
                        fixed[k][i] = (low ? numbers::MHE_LOW : numbers::MHE_HIGH) - nodes[k][i];
                    }
                }
            }
            if (any) {
                banded(fixed, product);
                for (int k = 0; k <= filled; ++k)
                    right[k] = free[k].cwiseProduct(g[k] - product[k]) + D[k].diagonal().cwiseProduct(fixed[k]);
            } else {
                right = g;
            }
            tridiagonal(free, right, move, any);
            if (any) {
                banded(move, product);
                for (int k = 0; k <= filled; ++k)
                    force[k] = (1.0 - free[k].array()) * (g[k] - product[k]).array();
            } else {
                for (int k = 0; k <= filled; ++k)
                    force[k].setZero();
            }
        }
        for (int k = 0; k <= filled; ++k) {
            nodes[k] += move[k];
            for (int i = NX; i < NS; ++i)
                nodes[k][i] = std::clamp(nodes[k][i], numbers::MHE_LOW, numbers::MHE_HIGH);
        }
    }

    // x of the system whose rows and columns of bounded losses are replaced by their diagonal: block Cholesky.
    void tridiagonal(const std::array<VecS, M + 1> &free, const Nodes &b, Nodes &x, bool masked)
    {
        MatS W = MatS::Zero();
        VecS from_before = VecS::Zero();
        for (int k = 0; k <= filled; ++k) {
            MatS &L = factors[k];
            L = D[k];
            if (masked)
                for (int i = NX; i < NS; ++i)
                    if (free[k][i] == 0.0) {
                        L.row(i).setZero();
                        L.col(i).setZero();
                        L(i, i) = D[k](i, i);
                    }
            if (k > 0)
                L.noalias() -= W.transpose() * W;
            Eigen::LLT<Eigen::Ref<MatS>> factor(L);
            z[k] = b[k] - from_before;
            factor.matrixL().solveInPlace(z[k]);
            if (k < filled) {
                W = below[k].transpose();
                if (masked) {
                    W = free[k].asDiagonal() * W;
                    W = W * free[k + 1].asDiagonal();
                }
                factor.matrixL().solveInPlace(W);
                from_before.noalias() = W.transpose() * z[k];
                couplings[k] = W;
            }
        }
        for (int k = filled; k >= 0; --k) {
            x[k] = z[k];
            if (k < filled)
                x[k].noalias() -= couplings[k] * x[k + 1];
            factors[k].triangularView<Eigen::Lower>().transpose().solveInPlace(x[k]);
        }
    }

    std::array<MatS, M + 1> factors;
    std::array<MatS, M> couplings;
    Nodes z;
};

}  // namespace floor_
