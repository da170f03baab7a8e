"""What may have happened: log Bayes factors against brute-force integrals, boxes against a general optimiser."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from tests.loss_prior import KINDS, moments
from tests.plain import array, logs, made, room

from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.estimator import hypotheses
from rotorwatch.engine.estimator.bank import FIRST_LOSS, Window
from rotorwatch.engine.estimator.hypotheses import LOSS_WIDTH, Asked, Freed, Jump
from rotorwatch.engine.estimator.plant import Plant

WIDTH, AIR = np.array([0.1, 0.2, 0.3, 0.4]), 0.4
FULL = 2.5  # hover thrusts


def effect(n):
    """(4, n) effectiveness of rotors on a circle that turn either way."""
    angle = 2.0 * np.pi * np.arange(n) / n
    return np.stack([np.sin(angle), np.cos(angle), (-1.0) ** np.arange(n), np.ones(n)])


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


def window(C, z):
    """What the ticks since an onset say, of rotors' losses and then the steps of the four axes."""
    n = len(z) - 4
    place = [*range(FIRST_LOSS, FIRST_LOSS + n), *range(4)]
    wide, long = np.zeros((FIRST_LOSS + n,) * 2), np.zeros(FIRST_LOSS + n)
    wide[np.ix_(place, place)], long[place] = C, z
    return made(Window, C=wide, z=long)


def asked(n, lo=None, hi=None, reach=0.0, drag=0.0, air=AIR**2, width=WIDTH):
    """reach: 0 counts geometry as exact."""
    lo, hi = np.zeros(n) if lo is None else lo, np.ones(n) if hi is None else hi
    reach, drag = (np.broadcast_to(v, n) for v in (reach, drag))
    return made(Asked, lo=lo, hi=hi, reach=reach, drag=drag, air=air, full=FULL, width=width)


def freed(n, C, z, **known):
    """Each rotor's jump of one window, with the axes' freedom."""
    found = Freed()
    found.free(made(Plant, rotors=n, effect=effect(n)), window(C, z), asked(n, **known))
    return found


def factors(n, C, z, gone=None, **known):
    """(hypotheses, log BF, sizes) of all windows."""
    return with_spread(n, C, z, gone, **known)[:3]


def with_spread(n, C, z, gone=None, **known):
    """`factors`, the variance (W, n) of a single rotor's loss, and of one that gives one thrust that thrust and its variance (2, W, n)."""
    hyp, p, ask = list_hypotheses(n), made(Plant, rotors=n, effect=effect(n)), asked(n, **known)
    rows = []
    for w in range(len(z)):
        one, free, jumps = window(C[w], z[w]), freed(n, C[w], z[w], **known), []
        for kind, who in zip(hyp.kinds, hyp.rotors):
            jump = Jump()
            if kind == "single":
                free.loss(ask, *who, jump)
            elif kind == "pair":
                hypotheses.pair(one, ask, *who, jump)
            elif kind == "recovery":
                free.recovery(*who, float(np.zeros(n)[who[0]] if gone is None else gone[w][who[0]]), jump)
            elif kind == "stuck":
                hypotheses.one_thrust(p, one, ask, *who, jump)
            jumps += [jump] * (kind != "disturbance")
        nats, weight = room(len(hyp.blocks)), room(len(hyp.blocks))
        hypotheses.steps(one, ask.width, 1.0, 0, nats, weight)
        stuck = [jumps[h] for h, kind in enumerate(hyp.kinds) if kind == "stuck"]
        of_rotors = logs([jump.nats for jump in jumps], [jump.weight for jump in jumps])
        rows.append((
            [*of_rotors, *logs(nats, weight)], [(jump.size, jump.other_size) for jump in jumps],
            [jump.variance for jump in jumps[:n]], [(jump.gives, jump.variance) for jump in stuck],
        ))  # fmt: skip
    logbf, nu, spread, gives = (np.array(column) for column in zip(*rows))
    return hyp, logbf, nu, spread, gives.transpose(2, 0, 1)


def quad_evidence(wrong=(1.0, 1.0, 1.0, 1.0), loss=0.4, sd=0.02):
    """(C, z) of a quad's rotor 1 that loses thrust, each axis seen to `sd` and off by a factor `wrong`."""
    B = np.array([[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1.0]])
    Phi = np.concatenate([B, np.eye(4)], axis=1)
    return (Phi.T @ Phi / sd**2)[None], (Phi.T @ (B[:, 0] * loss * wrong) / sd**2)[None]


def with_steps(C, z, i, prior, nu):
    """Log of the likelihood ratio of a jump nu of rotor i with Gaussian steps of the axes, variances `prior`, integrated out."""
    n = len(z) - 4
    inner, rest = C[n:, n:], z[n:] - C[n:, i] * nu
    reported = rest @ np.linalg.solve(inner + np.diag(1.0 / prior), rest)
    size = np.linalg.slogdet(np.eye(4) + np.sqrt(np.outer(prior, prior)) * inner)[1]
    return z[i] * nu - 0.5 * C[i, i] * nu**2 + 0.5 * reported - 0.5 * size


def evidence(likelihood, mean, sd):
    """Log of the integral of exp(likelihood(nu)) N(nu; mean, sd) over all nu, by quadrature."""
    grid = np.linspace(mean - 8 * sd, mean + 8 * sd, 4001)
    both = [likelihood(v) - 0.5 * ((v - mean) / sd) ** 2 for v in grid]
    near, top = grid[int(np.argmax(both))], max(both)
    wide = np.sqrt(-1.0 / np.diff([likelihood(near + d) - 0.5 * ((near + d - mean) / sd) ** 2 for d in (-1e-3, 0, 1e-3)], 2)[0])
    wide *= 1e-3

    def density(nu):
        return np.exp(likelihood(nu) - 0.5 * ((nu - mean) / sd) ** 2 - top) / (sd * np.sqrt(2 * np.pi))

    return top + np.log(quad(density, near - 10 * wide, near + 10 * wide, limit=400)[0])


def test_a_rotor_whose_effect_differs_a_little_from_geometry_is_still_named():
    """Yaw a third short, thrust a fifth: no other explanation may gain from that - as one would if geometry counted as exact."""
    C, z = quad_evidence(wrong=(1.05, 0.97, 0.65, 0.8))
    hyp, tolerant, nu = factors(4, C, z, reach=1.0)
    assert hyp.names[tolerant[0].argmax()] == "rotor 1"
    assert nu[0, 0, 0] == pytest.approx(0.4, abs=0.03)
    _, exact, _ = factors(4, C, z)
    assert hyp.names[exact[0].argmax()] != "rotor 1"


@pytest.mark.parametrize("seed", range(3))
def test_slop_is_a_share_of_what_the_likeliest_rotor_lacks(seed):
    """Four axes, each its own share; a rotor that reaches further leaves more; never more than the whole loss allows. In yaw its drag."""
    n = 6
    C, z = information(n, seed)
    reach = np.random.default_rng(seed).uniform(0.3, 2.0, n)
    drag = np.random.default_rng(seed + 9).uniform(-2.0, 2.0, n)
    for w in range(len(C)):
        precision = np.diag(C[w])[:n] + LOSS_WIDTH**-2
        nu = np.clip(z[w, :n] / precision, 0.0, 1.0)
        i = np.argmax(z[w, :n] * nu - 0.5 * precision * nu**2)
        wanted = (np.array(hypotheses.SLOP) * nu[i] * reach[i]) ** 2 + 1e-12
        wanted[2] += (nu[i] * drag[i]) ** 2
        np.testing.assert_allclose(freed(n, C[w], z[w], reach=reach, drag=drag).slop, wanted, rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_slop_is_steps_of_the_axes_integrated_out(seed):
    """Against the same Gaussian integral done at once, by dense linear algebra: information, vector, and what the freedom gains; with more
    of it in thrust where air moves."""
    n = 6
    C, z = information(n, seed)
    for w in range(len(C)):
        found = freed(n, C[w], z[w], reach=1.0, drag=0.3)
        for moving, more in enumerate((0.0, AIR**2)):
            prior = np.array(found.slop) + np.array([0.0, 0.0, 0.0, more])
            inner = np.linalg.inv(C[w][n:, n:] + np.diag(1.0 / prior))
            own, reported = array(found.own, 2, n)[moving], array(found.score, 2, n)[moving]
            for i in range(n):
                assert own[i] == pytest.approx(C[w, i, i] - C[w, i, n:] @ inner @ C[w, n:, i], rel=1e-8)
                assert reported[i] == pytest.approx(z[w, i] - C[w, i, n:] @ inner @ z[w, n:], rel=1e-8, abs=1e-8)
                for nu in (0.0, 0.3):
                    expected = with_steps(C[w], z[w], i, prior, nu)
                    gain = float(logs(found.nats[moving], found.weight[moving]))
                    assert gain + reported[i] * nu - 0.5 * own[i] * nu**2 == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("loss, sd", [(0.15, 0.02), (0.4, 0.05)])
def test_a_single_rotor_with_slop_is_weighed_as_the_integral_over_loss_and_axes(loss, sd):
    C, z = quad_evidence(wrong=(1.05, 0.95, 0.8, 1.1), loss=loss, sd=sd)
    _, logbf, _ = factors(4, C, z, reach=1.0)
    steady = np.array(freed(4, C[0], z[0], reach=1.0).slop)
    moved = steady + np.array([0.0, 0.0, 0.0, AIR**2])
    often = hypotheses.AIR_SHARE
    parts = [
        np.log(share * part) + evidence(lambda v, prior=prior: with_steps(C[0], z[0], 0, prior, v), mean, width)
        for prior, part in ((moved, often), (steady, 1.0 - often))
        for share, mean, width in KINDS
    ]
    assert logbf[0, 0] == pytest.approx(np.logaddexp.reduce(parts), abs=1e-4)


@pytest.mark.thorough(keep=4)
@pytest.mark.parametrize("reach", [0.0, 1.0])
@pytest.mark.parametrize("ended, back", [(0.3, 0.3), (0.3, 0.2), (0.05, 0.05), (0.3, 0.0)])
def test_a_recovery_is_weighed_as_the_integral_around_the_known_loss(ended, back, reach):
    """A loss of size `ended` was known; the data show a jump back of `back`, the prior is about -ended."""
    n, sd = 4, float(np.hypot(hypotheses.NONE, hypotheses.RECOVERY_SHARE * ended))
    C, z = quad_evidence(loss=-back, sd=0.05)
    gone = np.zeros((1, n))
    gone[0, 0] = -ended
    hyp, logbf, nu = factors(n, C, z, lo=np.array([-1.0, 0, 0, 0]), gone=gone, reach=reach)
    prior = np.array(freed(n, C[0], z[0], lo=np.array([-1.0, 0, 0, 0]), reach=reach).slop)
    h = hyp.names.index("rotor 1 is well again")
    expected = evidence(lambda v: with_steps(C[0], z[0], 0, prior, v), -ended, sd)
    assert logbf[0, h] == pytest.approx(expected, abs=1e-4)
    best, around = -0.25, 0.75
    for _ in range(2):  # coarse, then fine around the best
        grid = np.linspace(best - around, best + around, 601)
        post = [with_steps(C[0], z[0], 0, prior, v) - 0.5 * ((v + ended) / sd) ** 2 for v in grid]
        best, around = grid[int(np.argmax(post))], 0.005
    assert nu[0, h, 0] == pytest.approx(best, abs=1e-4) and nu[0, h, 1] == 0.0


def test_a_loss_that_goes_back_to_nothing_is_a_recovery_rather_than_a_change():
    """What ends a loss is sharp knowledge; a change of the same rotor may be any size. A step back of an eighth is a change."""
    gone = np.zeros((1, 4))
    gone[0, 0] = -0.4
    for back, kind in ((0.4, "recovery"), (0.05, "single")):
        C, z = quad_evidence(loss=-back, sd=0.03)
        hyp, logbf, _ = factors(4, C, z, lo=np.array([-1.0, 0, 0, 0]), gone=gone)
        mine = [h for h, who in enumerate(hyp.rotors) if who == (0,)]
        assert hyp.kinds[max(mine, key=lambda h: logbf[0, h])] == kind


def test_a_rotor_that_is_well_again_gives_more_not_less():
    """A known loss of 0.97 and evidence for 0.25 more: no recovery explains that."""
    C, z = quad_evidence(loss=0.25)
    hyp, log_bf, sizes = factors(4, C, z, lo=-np.ones(4), hi=np.full(4, 0.03), gone=np.full((len(z), 4), -0.97))
    well = [h for h, kind in enumerate(hyp.kinds) if kind == "recovery"]
    assert (sizes[:, well] <= 0.0).all()
    assert (log_bf[:, well] < 0.0).all()


@pytest.mark.parametrize("n", [4, 6, 8])
def test_every_explanation_is_listed_once(n):
    hyp = list_hypotheses(n)
    assert len(set(hyp.names)) == len(hyp.names) == len(hyp.kinds) == len(hyp.rotors) == len(hyp.weight)
    assert len(hyp.pairs) == n * (n - 1) // 2
    again = [who for who, kind in zip(hyp.rotors, hyp.kinds) if kind == "recovery"]
    assert again == [(i,) for i in range(n)]
    assert {who for who, kind in zip(hyp.rotors, hyp.kinds) if kind == "pair"} == {tuple(p) for p in hyp.pairs.tolist()}
    assert hyp.fault.tolist() == [kind != "disturbance" for kind in hyp.kinds]
    assert all(who == () for who, kind in zip(hyp.rotors, hyp.kinds) if kind == "disturbance")
    # A rotor is a likelier culprit than two at once; battery, payload and gusts are more common than either.
    weight = dict(zip(hyp.kinds, hyp.weight))
    assert weight["pair"] < weight["single"] < weight["disturbance"]


@pytest.mark.parametrize(
    "loss, c", [(0.06, 5000.0), (0.1, 5000.0), (0.3, 400.0), (0.4, 5000.0), (0.7, 100.0), (0.9, 400.0), (0.95, 2000.0)]
)
def test_a_single_rotor_is_weighed_as_the_integral_over_its_loss(loss, c):
    """The prior has a narrow, a wide and a total part. Well inside 0..1 the closed form is that integral, with mean and variance."""
    n = 4
    C, z = np.diag(np.full(n + 4, c))[None], np.zeros((1, n + 4))
    z[0, 1] = c * loss
    exact, mean, variance = moments(c, c * loss)
    # Thrust, of its own here, would have been seen to change with the air.
    exact += np.log(1.0 - hypotheses.AIR_SHARE * (1.0 - 1.0 / np.sqrt(1.0 + c * AIR**2)))
    _, logbf, nu, spread, _ = with_spread(n, C, z)
    assert logbf[0, :n].argmax() == 1 and nu[0, 1, 1] == 0.0
    assert logbf[0, 1] == pytest.approx(exact, abs=1e-6)
    assert nu[0, 1, 0] == pytest.approx(mean, abs=1e-6) and spread[0, 1] == pytest.approx(variance, rel=1e-6)


def test_gain_of_thrust_speaks_for_no_loss():
    n, c = 6, 1000.0
    C = np.diag(np.full(n + 4, c))[None]
    z = np.zeros((1, n + 4))
    z[0, 2] = -c * 0.3
    _, logbf, nu = factors(n, C, z)
    assert nu[0, 2, 0] == pytest.approx(0.0, abs=1e-12) and logbf[0, 2] < 0.0


@pytest.mark.parametrize("n", [4, 8])
@pytest.mark.parametrize("seed", range(3))
def test_pairs_are_the_best_point_of_their_box(n, seed):
    """Against a general optimiser with bounds; some optima lie inside, some on an edge, some in a corner."""
    C, z = information(n, seed)
    rng = np.random.default_rng(seed + 100)
    z[:, :n] += 200.0 * rng.standard_normal((len(z), n))
    lo, hi = -0.1 * (rng.random(n) < 0.3), rng.uniform(0.1, 1.0, n)
    hyp, logbf, nu = factors(n, C, z, lo=lo, hi=hi)
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
        idx = n + np.array(block)
        prior = np.diag(WIDTH[list(block)] ** 2)
        for w in range(len(C)):
            c, zz = C[w][np.ix_(idx, idx)], z[w, idx]
            expected = 0.5 * zz @ np.linalg.solve(c + np.linalg.inv(prior), zz)
            expected -= 0.5 * np.linalg.slogdet(np.eye(len(idx)) + prior @ c)[1]
            assert logbf[w, first + k] == pytest.approx(expected, rel=1e-9)


def test_a_manoeuvre_in_calm_air_is_no_loss():
    """A pitch step ten times as large as calm air knows, with a little of everything else: rotor 1 fits better than anything usual,
    and worse than a disturbance far larger."""
    C, z = quad_evidence(wrong=(0.25, 1.0, 0.2, 0.5), loss=0.3, sd=0.02)
    calm, far, weight = np.full(4, 0.03), room(hypotheses.DISTURBANCE_COUNT), room(hypotheses.DISTURBANCE_COUNT)
    hyp, logbf, _ = factors(4, C, z, reach=1.0, air=1e-12, width=calm)
    reported = dict(zip(hyp.names, logbf[0]))
    hypotheses.steps(window(C[0], z[0]), calm.tolist(), hypotheses.FAR, 0, far, weight)
    usual = max(v for name, v in reported.items() if "rotor" not in name)
    assert reported["rotor 1"] > usual + np.log(10.0)
    assert max(logs(far, weight)) > reported["rotor 1"] + np.log(10.0)


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


@pytest.mark.parametrize("rotor", range(4))
def test_a_rotor_that_gives_one_thrust_is_the_integral_over_that_thrust(rotor):
    """Its command counts no longer, and a thrust between hover's and full comes instead: along its column of B, on all four axes."""
    n, thrust = 4, 1.7
    C, _ = information(n, seed=rotor)
    z = np.empty(C.shape[:2])
    nu = np.concatenate([np.eye(n)[rotor], -thrust * effect(n)[:, rotor]])
    for w in range(len(C)):
        z[w] = C[w] @ nu
    top = 0.5 * z @ nu
    hyp, logbf, _, _, (gives, variance) = with_spread(n, C, z)
    reported = logbf[:, np.array(hyp.kinds) == "stuck"]
    assert (reported.argmax(axis=1) == rotor).all()
    mean, sd = 0.5 * (1.0 + FULL), 0.5 * (FULL - 1.0)
    for w in range(len(C)):

        def density(f, w=w):
            nu = np.concatenate([np.eye(n)[rotor], -f * effect(n)[:, rotor]])
            fit = (z[w] @ nu - 0.5 * nu @ C[w] @ nu) - top[w]
            return np.exp(fit - 0.5 * ((f - mean) / sd) ** 2)

        def moment(power, w=w, density=density):
            middle = gives[w, rotor]
            return quad(lambda f: density(f) * (f - middle) ** power, -1.5, 4.5, points=[middle], epsabs=1e-13, limit=200)[0]

        assert reported[w, rotor] == pytest.approx(top[w] + np.log(moment(0) / (sd * np.sqrt(2.0 * np.pi))), abs=1e-6)
        assert gives[w, rotor] == pytest.approx(thrust, abs=0.1)
        assert variance[w, rotor] == pytest.approx(moment(2) / moment(0), rel=1e-4)


def test_a_rotor_that_gives_hardly_more_than_in_hover_is_reported_by_its_loss():
    C, _ = information(4)
    z = np.stack([c @ np.concatenate([np.eye(4)[1], -1.2 * effect(4)[:, 1]]) for c in C])
    hyp, logbf, *_ = with_spread(4, C, z)
    assert (logbf[:, np.array(hyp.kinds) == "stuck"][:, 1] < logbf[:, 1]).all()
