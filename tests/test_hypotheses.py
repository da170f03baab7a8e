"""What may have happened: log Bayes factors against brute-force integrals, boxes against a general optimiser."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize

from rotorwatch.evidence import hypotheses
from rotorwatch.evidence.hypotheses import LOSS_WIDTH, SMALL_WIDTH

WIDTH = np.array([0.1, 0.2, 0.3, 0.4])


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.backend import jax

    jax()


def information(n, seed=0, windows=3, strength=60.0):
    """A plausible (C, z): positive definite, of windows of growing length, with jumps of some size in them."""
    rng = np.random.default_rng(seed)
    q = n + 4
    C = np.empty((windows, q, q))
    z = np.empty((windows, q))
    for w in range(windows):
        A = rng.standard_normal((40, q)) * np.sqrt(strength * (w + 1) / 4)
        C[w] = A.T @ A
        z[w] = C[w] @ (0.2 * rng.random(q)) + np.linalg.cholesky(C[w]) @ rng.standard_normal(q)
    return C, z


def factors(n, C, z, lo=None, hi=None):
    """With effects of nothing, so that geometry counts as exact."""
    hyp = hypotheses.make(n)
    lo, hi = np.zeros(n) if lo is None else lo, np.ones(n) if hi is None else hi
    logbf, nu, _ = hypotheses.log_bayes_factors(hyp, C, z, lo, hi, WIDTH, np.zeros((4, n)))
    return hyp, np.asarray(logbf), np.asarray(nu)


def quad_evidence(wrong=(1.0, 1.0, 1.0, 1.0), loss=0.4, sd=0.02):
    """(C, z, effect) of a quad's rotor 1 that loses thrust, each axis seen to `sd` and off by a factor `wrong`."""
    B = np.array([[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1.0]])
    Phi = np.concatenate([B, np.eye(4)], axis=1)
    return (Phi.T @ Phi / sd**2)[None], (Phi.T @ (B[:, 0] * loss * wrong) / sd**2)[None], B


def log_evidence(hyp, C, z, effect):
    logbf, nu, own = hypotheses.log_bayes_factors(hyp, C, z, np.zeros(hyp.n), np.ones(hyp.n), WIDTH, effect)
    return dict(zip(hyp.names, np.asarray(logbf)[0])), np.asarray(nu)[0], np.asarray(own)[0]


def test_a_rotor_whose_effect_differs_a_little_from_geometry_is_still_named():
    """Yaw a third short, thrust a fifth: no other explanation may gain from that - as one would if geometry counted as exact."""
    hyp = hypotheses.make(4)
    C, z, B = quad_evidence(wrong=(1.05, 0.97, 0.65, 0.8))
    tolerant, nu, _ = log_evidence(hyp, C, z, B)
    assert max(tolerant, key=tolerant.get) == "rotor 1"
    assert nu[0, 0] == pytest.approx(0.4, abs=0.03)
    exact, _, _ = log_evidence(hyp, C, z, 0.0 * B)
    assert max(exact, key=exact.get) != "rotor 1"


def test_slop_is_steps_of_the_axes_integrated_out():
    """Against the same Gaussian integral done at once, by dense linear algebra, at the size that the loss has without slop."""
    hyp = hypotheses.make(4)
    C, z, B = quad_evidence(wrong=(1.1, 0.9, 0.7, 1.2), sd=0.05)
    _, _, own = log_evidence(hyp, C, z, B)
    c, v = C[0], z[0]
    first = np.clip(v[:4] / (np.diag(c)[:4] + 1 / LOSS_WIDTH**2), 0, 1)
    for i in range(4):
        prior = np.diag((np.array(hypotheses.SLOP) * B[:, i] * first[i]) ** 2 + 1e-12)
        axes = slice(4, 8)
        inner = np.linalg.inv(c[axes, axes] + np.linalg.inv(prior))
        assert own[i] == pytest.approx(c[i, i] - c[i, axes] @ inner @ c[axes, i], rel=1e-9)


@pytest.mark.parametrize("n", [4, 6, 8])
def test_every_explanation_is_listed_once(n):
    hyp = hypotheses.make(n)
    assert len(set(hyp.names)) == len(hyp.names) == len(hyp.kinds) == len(hyp.rotors) == len(hyp.weight)
    assert len(hyp.singles) == n and len(hyp.pairs) == n * (n - 1) // 2 and len(hyp.mixed) == n
    assert {who for who, kind in zip(hyp.rotors, hyp.kinds) if kind == "pair"} == {tuple(p) for p in hyp.pairs.tolist()}
    assert hyp.fault.tolist() == [kind != "disturbance" for kind in hyp.kinds]
    assert all(who == () for who, kind in zip(hyp.rotors, hyp.kinds) if kind == "disturbance")
    # A rotor is a likelier culprit than two at once; battery, payload and gusts are more common than either.
    weight = dict(zip(hyp.kinds, hyp.weight))
    assert weight["pair"] < weight["single"] < weight["disturbance"]


def box_mass(c, z, width):
    """log of: half a Gaussian prior of this width on a loss, times the likelihood ratio exp(z nu - c nu^2 / 2)."""
    top = max(z * z / c / 2, 0.0)

    def density(nu):
        return np.exp(z * nu - 0.5 * c * nu * nu - top - 0.5 * (nu / width) ** 2) / (width * np.sqrt(2 * np.pi))

    near = np.clip(z / c, 0.0, 1.0)
    spread = 1.0 / np.sqrt(c)
    return top + np.log(quad(density, max(0.0, near - 12 * spread), min(1.0, near + 12 * spread), limit=400)[0])


@pytest.mark.parametrize("loss, c", [(0.06, 5000.0), (0.1, 5000.0), (0.3, 400.0), (0.4, 5000.0)])
def test_a_single_rotor_is_weighed_as_the_integral_over_its_loss(loss, c):
    """The prior is half narrow, half wide. Well inside 0..1 the closed form is that integral."""
    n = 4
    C = np.diag(np.full(n + 4, c))[None]
    z = np.zeros((1, n + 4))
    z[0, 1] = c * loss
    _, logbf, nu = factors(n, C, z)
    exact = np.logaddexp(box_mass(c, c * loss, LOSS_WIDTH), box_mass(c, c * loss, SMALL_WIDTH)) - np.log(2.0)
    assert logbf[0, 1] == pytest.approx(exact, abs=1e-3)
    assert logbf[0, :n].argmax() == 1
    assert nu[0, 1, 0] == pytest.approx(c * loss / (c + 1 / LOSS_WIDTH**2), rel=1e-9)


def test_both_halves_of_the_prior_matter():
    """A small loss is spoken for by the narrow half, a large one by the wide half."""
    n, c = 4, 4000.0
    C = np.diag(np.full(n + 4, c))[None]
    for loss, helping in ((0.05, SMALL_WIDTH), (0.5, LOSS_WIDTH)):
        z = np.zeros((1, n + 4))
        z[0, 0] = c * loss
        halves = {w: box_mass(c, c * loss, w) for w in (SMALL_WIDTH, LOSS_WIDTH)}
        assert max(halves, key=halves.get) == helping
        _, logbf, _ = factors(n, C, z)
        assert max(halves.values()) - np.log(2) - 1e-3 <= logbf[0, 0] <= max(halves.values()) + 1e-3


def test_gain_of_thrust_speaks_for_no_loss():
    n, c = 6, 1000.0
    C = np.diag(np.full(n + 4, c))[None]
    z = np.zeros((1, n + 4))
    z[0, 2] = -c * 0.3
    _, logbf, nu = factors(n, C, z)
    assert nu[0, 2, 0] == 0.0 and logbf[0, 2] < 0.0


@pytest.mark.parametrize("n", [4, 8])
@pytest.mark.parametrize("seed", range(3))
def test_pairs_are_the_best_point_of_their_box(n, seed):
    """Against a general optimiser with bounds; some optima lie inside, some on an edge, some in a corner."""
    C, z = information(n, seed)
    rng = np.random.default_rng(seed + 100)
    z[:, :n] += 200.0 * rng.standard_normal((len(z), n))
    lo, hi = -0.1 * (rng.random(n) < 0.3), rng.uniform(0.1, 1.0, n)
    hyp, logbf, nu = factors(n, C, z, lo, hi)
    on_an_edge = inside = 0
    for w in range(len(C)):
        for k, (a, b) in enumerate(hyp.pairs):
            precision = C[w][np.ix_([a, b], [a, b])] + np.eye(2) / LOSS_WIDTH**2
            zz = z[w, [a, b]]
            best = min(
                (
                    minimize(
                        lambda v, precision=precision, zz=zz: 0.5 * v @ precision @ v - zz @ v,
                        start,
                        jac=lambda v, precision=precision, zz=zz: precision @ v - zz,
                        bounds=[(lo[a], hi[a]), (lo[b], hi[b])],
                        method="L-BFGS-B",
                        options={"ftol": 1e-14, "gtol": 1e-10},
                    )
                    for start in ([lo[a], lo[b]], [hi[a], hi[b]])
                ),
                key=lambda r: r.fun,
            )
            expected = -best.fun - 0.5 * np.log(np.linalg.det(precision) * LOSS_WIDTH**4)
            assert logbf[w, n + k] == pytest.approx(expected, rel=1e-6, abs=1e-6)
            np.testing.assert_allclose(nu[w, n + k], best.x, atol=2e-5)
            free = (best.x > [lo[a] + 1e-6, lo[b] + 1e-6]).all() and (best.x < [hi[a] - 1e-6, hi[b] - 1e-6]).all()
            inside, on_an_edge = inside + free, on_an_edge + (not free)
    assert inside > 0 and on_an_edge > 0


def test_disturbances_are_gaussian_integrals():
    """Unbounded directions have a closed form: a multivariate normal evidence, done here with dense algebra."""
    n = 6
    C, z = information(n, 7)
    hyp, logbf, _ = factors(n, C, z)
    first = len(hyp.names) - len(hyp.blocks)
    for k, block in enumerate(hyp.blocks):
        idx = np.array(block)
        prior = np.diag(WIDTH[idx - n] ** 2)
        for w in range(len(C)):
            c, zz = C[w][np.ix_(idx, idx)], z[w, idx]
            expected = 0.5 * zz @ np.linalg.solve(c + np.linalg.inv(prior), zz)
            expected -= 0.5 * np.linalg.slogdet(np.eye(len(idx)) + prior @ c)[1]
            assert logbf[w, first + k] == pytest.approx(expected, rel=1e-9)


def test_a_manoeuvre_in_calm_air_is_no_loss():
    """A pitch step ten times as large as calm air knows, with a little of everything else: rotor 1 fits better than anything usual,
    and worse than a disturbance far larger."""
    hyp = hypotheses.make(4)
    C, z, B = quad_evidence(wrong=(0.25, 1.0, 0.2, 0.5), loss=0.3, sd=0.02)
    calm = np.full(4, 0.03)
    logbf, _, _ = hypotheses.log_bayes_factors(hyp, C, z, np.zeros(4), np.ones(4), calm, B)
    told = dict(zip(hyp.names, np.asarray(logbf)[0]))
    far = np.asarray(hypotheses.disturbances(hyp, C, z, hypotheses.FAR * calm))[0]
    usual = max(v for name, v in told.items() if "rotor" not in name)
    assert told["rotor 1"] > usual + np.log(10.0)
    assert far.max() > told["rotor 1"] + np.log(10.0)


def test_no_data_says_nothing():
    """Without information every explanation is as good as none: all Bayes factors are one."""
    n = 8
    C, z = np.zeros((2, n + 4, n + 4)), np.zeros((2, n + 4))
    _, logbf, _ = factors(n, C, z)
    np.testing.assert_allclose(logbf, 0.0, atol=1e-6)


def test_more_freedom_costs_what_it_does_not_explain():
    """One rotor's jump in the data: that rotor wins over every pair and every disturbance with it."""
    n = 4
    rng = np.random.default_rng(0)
    B = np.array([[-1.0, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1]])
    directions = np.concatenate([B, np.eye(4)], axis=1)  # what a unit jump of each kind does to the four axes
    noise, loss, ticks = 0.02, 0.15, 30
    y = loss * B[:, 2] + noise * rng.standard_normal((ticks, 4))
    C = ticks * directions.T @ directions / noise**2
    z = directions.T @ y.sum(axis=0) / noise**2
    hyp, logbf, nu = factors(n, C[None], z[None])
    score = logbf[0] + np.log(hyp.weight)
    assert hyp.names[score.argmax()] == "rotor 3"
    assert nu[0, 2, 0] == pytest.approx(loss, abs=0.01)
    assert score[2] - max(np.delete(score, [2])) > 1.0
