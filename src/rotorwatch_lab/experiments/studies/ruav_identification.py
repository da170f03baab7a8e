"""The helicopter's model from frequency responses: sweeps in closed loop, spectra, and a fit of the linear model's parameters.

Four records of healthy hover, the controller of `ruav_flight` in the loop; in each, one command gets a sweep r that comes again each
window: responses are periodic, and a window without taper leaks nothing. With the windows' spectra U (4), Y (6), R (4, only the swept one
not 0) at each frequency

    H = (sum Y R*) (sum U R*)^-1,   S_nn = mean |Y - H U|^2,   var H_ij = S_nn,i [(sum U R*)^-H (sum R R*) (sum U R*)^-1]_jj

R is known and owes nothing to the noise, so feedback does not bias H. Coherence: 1 - S_nn / S_yy; where it is below COHERENT nothing is
fitted. The model is that of hover with the attitude's kinematics and gravity known,

    d x + ... = A x + B u,   d = (exp(j omega dt) - 1) / dt   (the paper's discrete model (8) is a forward difference)

its free parameters those of FREE; they start from linear least squares on the equation, and are fitted to H, each value weighed by its
variance. Intervals are those of that fit's information matrix. How accurate the model is (figure 3 of the paper) new records show, which
were not fitted to: from each AHEAD_S of measured states on, the commands and the measured attitude alone say what comes. Source: Tischler
and Remple, Aircraft and Rotorcraft System Identification, AIAA 2006, ch. 5, 7, 9, 11 (the paper's "frequency response method"); Ljung,
System Identification, 1999, 7.5, for the instrument.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.experiments.studies import reproduction, ruav_flight
from rotorwatch_lab.experiments.studies.reproduction import Claim, graded, panels
from rotorwatch_lab.experiments.studies.ruav_flight import ATTITUDE, DT, MEAN_SHARE, MEASUREMENT, PROCESS, in_ball

WINDOW, WINDOWS, COHERENT = 1024, 8, 0.6
SWEEP_HZ, SWEEP = (0.08, 3.0), np.array([0.012, 0.02, 0.016, 0.012])
BAND = (0.8, 16.0)  # rad/s that are fitted
SURE = 1.96  # deviations of a 95 % interval
AHEAD_S = 1.0
AXES, INPUTS = ("X", "Y", "Z", "L", "M", "N"), ("collective", "tail", "longitudinal", "lateral")
FREE_STATES = ("X_u", "Y_v", "Y_r", "Z_w", "L_v", "L_w", "L_p", "L_r", "M_q", "M_w", "N_v", "N_w", "N_p", "N_r", "Y_w")
FREE_INPUTS = ("XYZLMN", "YLMN", "XLMN", "YLM")  # axes that collective, tail, longitudinal and lateral move
STATES = "uvwpqr"


class Identified(NamedTuple):
    """names (k,); value, deviation, truth (k,); omega (F,) rad/s; H, truth_H (F, 6, 4); coherence (F, 6); used (F, 6) bool."""

    names: tuple[str, ...]
    value: np.ndarray
    deviation: np.ndarray
    truth: np.ndarray
    omega: np.ndarray
    H: np.ndarray
    truth_H: np.ndarray
    coherence: np.ndarray
    used: np.ndarray


def identify(seed: int = 0) -> Identified:
    """Sweeps, spectra and the fit."""
    from scipy.optimize import least_squares

    system = ruav_flight.plant()
    u, y, r = _records(system, seed)
    u = u[..., :4]
    omega, H, variance, coherence = _responses(u, y, r)
    d = (np.exp(1j * omega * DT) - 1.0) / DT
    used = coherence > COHERENT
    A, B = _truth(system, u, y)
    states, inputs, names = _free()
    truth = np.concatenate([A[states], B[inputs]])
    weight = np.sqrt(2.0 / variance) * used[:, :, None]

    def model(p):
        return response(*_matrices(p, states, inputs), d)

    def misfit(p):
        off = (model(p) - H) * weight
        return np.concatenate([np.real(off).ravel(), np.imag(off).ravel()])

    start = _equation_error(d, H, used, states, inputs)
    fitted = least_squares(misfit, start, x_scale=np.maximum(np.abs(start), 0.05), method="trf")
    spread = max(2.0 * fitted.cost / (2 * np.repeat(used, 4).sum() - len(start)), 1.0)
    deviation = np.sqrt(spread * np.diagonal(np.linalg.inv(fitted.jac.T @ fitted.jac)))
    return Identified(names, fitted.x, deviation, truth, omega, H, response(A, B, d), coherence, used)


def response(A, B, d) -> np.ndarray:
    """(F, 6, 4) of u, v, w, p, q, r to the four commands: A (6, 6), B (6, 4), attitude and gravity added."""
    whole, push = np.zeros((8, 8)), np.zeros((8, 4))
    whole[:6, :6], push[:6] = A, B
    whole[:6, 6:] = _gravity()
    whole[6, 3] = whole[7, 4] = 1.0
    whole[6, 5], whole[7, 5] = ATTITUDE[1], -ATTITUDE[0]
    return np.linalg.solve(d[:, None, None] * np.eye(8) - whole, np.broadcast_to(push + 0j, (len(d), 8, 4)))[:, :6]


def _gravity() -> np.ndarray:
    """(6, 2): specific force by roll and pitch."""
    (roll, pitch), g = ATTITUDE, G0
    table = np.zeros((6, 2))
    table[0, 1] = -g * np.cos(pitch)
    table[1] = g * np.cos(roll) * np.cos(pitch), -g * np.sin(roll) * np.sin(pitch)
    table[2] = -g * np.sin(roll) * np.cos(pitch), -g * np.cos(roll) * np.sin(pitch)
    return table


def _truth(system, u, y):
    """(A (6, 6), B (6, 4)) of the simulator where it flew: a constant disturbance moves the trim of each record a little, so A is the mean
    over the records' mean commands and states, and each command's column is that of the record in which it was swept."""
    jax = load_jax()
    slopes = jax.jit(jax.jacfwd(system.derivative, (0, 1)))
    linearised = [slopes(x, np.concatenate([U, ATTITUDE]), np.zeros(8)) for x, U in zip(y.mean(axis=1), u.mean(axis=1), strict=True)]
    A = np.mean([np.asarray(by_x) for by_x, _ in linearised], axis=0)
    return A, np.stack([np.asarray(by_u)[:, k] for k, (_, by_u) in enumerate(linearised)], axis=1)


def _free():
    """Indices of the free elements of A and of B, and their names."""
    states = tuple(np.array([(AXES.index(n[0]), STATES.index(n[2])) for n in FREE_STATES]).T)
    pairs = [(AXES.index(axis), j) for j, moved in enumerate(FREE_INPUTS) for axis in moved]
    names = (*FREE_STATES, *(f"{AXES[i]}_{INPUTS[j]}" for i, j in pairs))
    return states, tuple(np.array(pairs).T), names


def _matrices(p, states, inputs):
    A, B = np.zeros((6, 6)), np.zeros((6, 4))
    A[states], B[inputs] = p[: len(states[0])], p[len(states[0]) :]
    return A, B


def _equation_error(d, H, used, states, inputs) -> np.ndarray:
    """First values: d H = A H + B + gravity, each row by least squares over the frequencies at which its output is coherent."""
    attitude = np.stack([H[:, 3] + ATTITUDE[1] * H[:, 5], H[:, 4] - ATTITUDE[0] * H[:, 5]], axis=1) / d[:, None, None]
    target = d[:, None, None] * H - _gravity() @ attitude
    parameters = np.zeros(len(states[0]) + len(inputs[0]))
    for axis in range(6):
        of_x, of_u = np.flatnonzero(states[0] == axis), np.flatnonzero(inputs[0] == axis)
        rows = used[:, axis]
        columns = [H[rows][:, states[1][k]].ravel() for k in of_x]
        columns += [np.tile(np.eye(4)[inputs[1][k]], rows.sum()) for k in of_u]
        table = np.stack(columns, axis=1)
        b = target[rows][:, axis].ravel()
        answer = np.linalg.lstsq(np.concatenate([np.real(table), np.imag(table)]), np.concatenate([np.real(b), np.imag(b)]), rcond=None)[0]
        parameters[np.concatenate([of_x, len(states[0]) + of_u])] = answer
    return parameters


def _responses(u, y, r):
    """(omega, H, variance of H, coherence) from records u (4, T, 4), y (4, T, 6), r (4, T, 4)."""

    def spectra(table):
        cut = table[:, : WINDOW * WINDOWS].reshape(len(table) * WINDOWS, WINDOW, -1)
        return np.fft.rfft(cut, axis=1)

    U, Y, R = (spectra(table) for table in (u, y, r))
    omega = 2 * np.pi * np.fft.rfftfreq(WINDOW, DT)
    keep = (omega > BAND[0]) & (omega < BAND[1])
    U, Y, R = (table[:, keep].transpose(1, 2, 0) for table in (U, Y, R))  # (F, channels, windows)
    star = R.conj().transpose(0, 2, 1)
    back = np.linalg.inv(U @ star)
    H = Y @ star @ back
    rest = Y - H @ U
    noise = (np.abs(rest) ** 2).sum(-1) / (rest.shape[-1] - 4)
    spread = np.einsum("fij,fjk,fki->fi", back.conj().transpose(0, 2, 1), R @ star, back).real
    coherence = 1.0 - noise / (np.abs(Y) ** 2).mean(-1)
    return omega[keep], H, noise[:, :, None] * spread[:, None, :], coherence


def _records(system, seed: int):
    """u (4, T, 6), y (4, T, 6) and the sweeps r (4, T, 4), one command swept in each record; one more window first, to settle."""
    steps = WINDOW * (WINDOWS + 1)
    rng = np.random.default_rng(seed)
    time = np.arange(steps) * DT
    # One sweep a window: its frequency rises exponentially, and every window holds all of them.
    low, high = SWEEP_HZ
    into = (time % (WINDOW * DT)) / (WINDOW * DT)
    turn = 2 * np.pi * low * WINDOW * DT / np.log(high / low) * ((high / low) ** into - 1.0)
    r = np.zeros((4, steps, 4))
    for k in range(4):
        r[k, :, k] = SWEEP[k] * np.sin(turn)
    mean = rng.standard_normal((4, 1, 6))
    mean *= MEAN_SHARE / np.linalg.norm(mean, axis=-1, keepdims=True)
    push = (mean + (1 - MEAN_SHARE) * in_ball(rng, 4, steps, 6)) * PROCESS[:6]
    error = in_ball(rng, 4, steps, 6) * MEASUREMENT

    flights = ruav_flight.closed_loop(system, push, error, r)
    # The state that a command meets, not the one it leads to.
    y = np.concatenate([np.zeros((4, 1, 6)), flights.x[:, :-1]], axis=1) + error
    return flights.u[:, WINDOW:], y[:, WINDOW:], r[:, WINDOW:]


def numbers(identified: Identified) -> dict:
    """Numbers of the claim, and every parameter with its interval."""
    ahead = {name: fit(*predicted(identified, which)) for name, which in (("model", "value"), ("simulator", "truth"))}
    held = np.abs(identified.value - identified.truth) <= SURE * identified.deviation
    size = np.abs(identified.truth)
    main = size > 0.3
    return {
        "parameters": {
            name: {"value": v, "half_interval": SURE * s, "truth": t}
            for name, v, s, t in zip(identified.names, identified.value, identified.deviation, identified.truth, strict=True)
        },
        "intervals_hold": float(held.mean()),
        "held": int(held.sum()),
        "of": len(held),
        "largest_in_deviations": float((np.abs(identified.value - identified.truth) / identified.deviation).max()),
        "median_error": float(np.median(np.abs(identified.value - identified.truth)[main] / size[main])),
        "coherent": float(identified.used.mean()),
        "accuracy": {name: dict(zip(STATES, fits, strict=True)) for name, fits in ahead.items()},
    }


def predicted(identified: Identified, which: str = "value", seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(measured, predicted), both (4, windows, AHEAD_S / DT, 6): new records with one command swept in each. which: of the parameters,
    value or truth. The constant part of the disturbance is the mean of each record."""
    states, inputs, _ = _free()
    A, B = _matrices(getattr(identified, which), states, inputs)
    u, y, _ = _records(ruav_flight.plant(), seed)
    push = u @ np.concatenate([B, _gravity()], axis=1).T
    push += ((y[:, 1:] - y[:, :-1]) / DT - y[:, :-1] @ A.T - push[:, :-1]).mean(axis=1, keepdims=True)
    ahead = round(AHEAD_S / DT)
    push, y = (table[:, : table.shape[1] // ahead * ahead].reshape(4, -1, ahead, 6) for table in (push, y))
    x = [y[:, :, 0]]
    for k in range(ahead - 1):
        x.append(x[-1] + DT * (x[-1] @ A.T + push[:, :, k]))
    return y, np.stack(x, axis=2)


def fit(measured: np.ndarray, model: np.ndarray) -> np.ndarray:
    """(6,) share of each state's variance that the model accounts for, in the record in which it varies most."""
    spread = measured.reshape(4, -1, 6).var(axis=1)
    rest = ((measured - model) ** 2).reshape(4, -1, 6).mean(axis=1)
    return 1.0 - rest[spread.argmax(0), np.arange(6)] / spread.max(0)


def figure(identified: Identified):
    """The model's accuracy (figure 3): frequency responses, and rates of a new record as the model has them from its commands."""
    states, inputs, _ = _free()
    A, B = _matrices(identified.value, states, inputs)
    model = response(A, B, (np.exp(1j * identified.omega * DT) - 1.0) / DT)
    drawn, axes = panels(2, 4, (12, 6))
    measured, ahead = predicted(identified)
    seconds = DT * np.arange(10 * measured.shape[2])
    for top, below, (name, state, command) in zip(*axes, (("w", 2, 0), ("r", 5, 1), ("q", 4, 2), ("p", 3, 3)), strict=True):
        used = identified.used[:, state]
        top.loglog(identified.omega[used], np.abs(identified.H[used, state, command]), "C0.", ms=3, label="measured")
        top.loglog(identified.omega, np.abs(model[:, state, command]), "C1", lw=1.0, label="model")
        top.set(title=f"{name} by {INPUTS[command]}", xlabel="rad/s")
        below.plot(seconds, measured[command, :10, :, state].ravel(), "C0", lw=0.8, label="measured")
        below.plot(seconds, ahead[command, :10, :, state].ravel(), "C1", lw=0.8, label=f"model, {AHEAD_S:g} s ahead")
        below.set(xlabel="s", ylabel="m/s" if state < 3 else "rad/s")
    for axis in axes[:, 0]:
        axis.legend(fontsize="small")
    return drawn


def claims(numbers: dict) -> tuple[Claim, ...]:
    """The paper's claim about its model."""
    hold, error = numbers["intervals_hold"], numbers["median_error"]
    verdict = graded(hold >= 0.9 and error < 0.05, hold >= 0.7)
    model, simulator = (numbers["accuracy"][name] for name in ("model", "simulator"))
    percents = {"median_percent": 100 * error, "coherent_percent": 100 * numbers["coherent"]}
    percents |= {"least_percent": 100 * min(model.values()), "simulator_percent": 100 * min(simulator.values())}
    return reproduction.claims("aesmf", {"identified": verdict}, **numbers, **percents)
