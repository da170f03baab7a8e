"""The odds of explanations: probabilities and decisions, their fit, ablation and reliability, on claims whose truth is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from rotorwatch.engine.bindings.explaining import Explanation, Fit
from rotorwatch.errors import ConfigError
from rotorwatch.flight.kinds import SUREST
from rotorwatch.toolkit import odds
from rotorwatch_lab.campaign import claims, odds_ablation, odds_fit, reliability
from rotorwatch_lab.campaign.claims import Fault, Flown
from rotorwatch_lab.commands import odds as commands

NONE = np.zeros(0)
NAMES = (
    ("loss", "", (0,)),
    ("growing loss", "", (0,)),
    ("nothing", "", ()),
    ("step 1", "", ()),
    ("loss", "step 1", (0,)),
    ("loss", "", (1,)),
)
SURE = odds.LIMITS.sure


def a_claim(logs, names=NAMES, named=True, rotors=(1,), origin="estimator", **more):
    """A claim of a quadrotor with the evidence `logs` of its explanations `names`: (name, beside, rotors from 0)."""
    rows = tuple(
        odds.Row(name, other, who, () if name.startswith(("slow", "capped", "turned")) else who, float(x), NONE, NONE)
        for (name, other, who), x in zip(names, logs)
    )
    return odds.Comparison(30.0, rotors, named, more.get("alternatives", ()), origin, more.get("grows", False), 4, rows)


def flown(claims_=(), faults=(), kind="", events=()):
    return Flown("plan", "f", "", kind, 4, tuple(faults), "healthy", "", tuple(events), tuple(claims_))


def test_probabilities_are_weights_times_evidence():
    logs = np.array([2.0, 1.0, 0.0, -1.0, 3.0, 1.5])
    more = [
        (odds.WEIGHTS["beside"] + odds.WEIGHTS[other.split()[0]] if other else 0.0) + (odds.WEIGHTS["claimed"] if 0 in who else 0.0)
        for _, other, who in NAMES
    ]
    weights = np.array(more) + [odds.WEIGHTS[name.split()[0]] for name, *_ in NAMES]
    share = np.exp(weights + odds.TEMPER * logs)
    share /= share.sum()
    found = a_claim(logs).weighed()
    assert found.claim == pytest.approx(share[[0, 1, 4]].sum()) and found.none == pytest.approx(share[[2, 3]].sum())
    assert found.others == {(1,): pytest.approx(share[5])} and found.slow == pytest.approx(np.zeros(4))


def test_two_at_once_have_both_their_weights_and_a_push_one_more():
    claim = a_claim([0.0, 0.0, 0.0], (("loss", "step 4", (0,)), ("loss", "push grows", (0,)), ("loss", "push", (1,))))
    step, push, other = map(claim.weights, claim.rows)
    assert step == ("loss", "beside", "step", "claimed")
    assert push == ("loss", "beside", "push", "pushed", "claimed") and other == push[:-1]


@pytest.mark.parametrize(
    ("log_odds", "decision"),
    [
        (20.0, odds.Decision.LOSS),
        (np.log(60.0), odds.Decision.LOSS),
        (np.log(40.0), odds.Decision.OPEN),  # one claim of eight with such odds is wrong
        (0.0, odds.Decision.OPEN),
        (-np.log(8.0), odds.Decision.OPEN),
        (-np.log(12.0), odds.Decision.DROPPED),
        (-20.0, odds.Decision.DROPPED),
    ],
)
def test_a_claimed_loss_stands_is_open_or_goes(log_odds, decision):
    names = (("loss", "", (0,)), ("nothing", "", ()))
    against = odds.WEIGHTS["nothing"] - odds.WEIGHTS["claimed"]
    claim = a_claim([(against + log_odds) / odds.TEMPER, 0.0], names)
    assert claim.decided(claim.weighed()) is decision


@pytest.mark.parametrize(("loss", "change"), [(0.2, np.log(2.0)), (0.0, 0.0), (-0.02, -1.148), (-0.8, -803.92)])
def test_no_loss_is_negative(loss, change):
    """log(2 Phi(loss / sd)), by the normal distribution's tables and its asymptote -z^2 / 2 - log(-z sqrt(pi / 2))."""
    fit = Fit(10.0, np.full(4, loss), np.full(4, 0.02))
    one = odds.row(odds.Rival("loss", Explanation((1,))), fit)
    assert one.log_p == pytest.approx(10.0 + change, abs=0.25) and one.weak == ((1,) if loss > 0.0 else ())
    stuck = odds.row(odds.Rival("stuck", Explanation((1,), gives=2.0)), fit)
    assert stuck.log_p == 10.0


@pytest.mark.parametrize(
    ("claimed", "others", "decision"),
    [
        (0.0, (-9.0, -9.0, -9.0), odds.Decision.LOSS),
        (0.0, (-2.8, -2.8, -2.8), odds.Decision.OPEN),  # each is unlikely, but not all together
        (0.0, (-1.0, -9.0, -9.0), odds.Decision.LOSS),  # with another rotor
        (0.0, (1.0, -9.0, -9.0), odds.Decision.OPEN),  # which is likelier
        (-4.0, (0.0, -9.0, -9.0), odds.Decision.OPEN),  # another rotor
        (-4.0, (0.0, 0.0, 0.0), odds.Decision.DROPPED),  # none in particular
    ],
)
def test_a_claim_that_any_rotor_could_take_the_place_of_is_open_or_goes(claimed, others, decision):
    names = (("loss", "", (0,)), ("nothing", "", ()), *(("loss", "step 1", (i,)) for i in (1, 2, 3)))
    more = [odds.WEIGHTS["claimed"], odds.WEIGHTS["nothing"], *[odds.WEIGHTS["beside"]] * 3]
    logs = [(x - w) / odds.TEMPER for x, w in zip((claimed, -20.0, *others), more)]
    claim = a_claim(logs, names)
    assert claim.decided(claim.weighed()) is decision


@pytest.mark.parametrize(("nats", "decision"), [(20.0, odds.Decision.LOSS), (8.0, odds.Decision.OPEN), (-6.0, odds.Decision.DROPPED)])
def test_what_may_be_no_loss_is_open_among_several_rotors_too(nats, decision):
    names = (("loss", "", (0,)), ("nothing", "", ()), ("loss", "", (1,)))
    claim = a_claim([nats, 0.0, nats], names, alternatives=((2,),))
    assert claim.decided(claim.weighed()) is decision


@pytest.mark.parametrize(("mount", "decision"), [(0, odds.Decision.LOSS), (1, odds.Decision.OPEN)])
def test_another_fault_of_the_same_rotor_spares_nobody(mount, decision):
    names = (("loss", "", (0,)), ("nothing", "", ()), ("turned", "", (mount,)))
    ahead = odds.WEIGHTS["claimed"] - odds.WEIGHTS["turned"] - math.log(20.0)  # odds of 20
    claim = a_claim([0.0, -60.0, ahead / odds.TEMPER], names)
    assert claim.weighed().none == pytest.approx(1 / 21, abs=1e-6) and claim.decided(claim.weighed()) is decision


def test_a_common_loss_puts_a_claim_in_doubt_and_changes_no_other_probability():
    sure = a_claim([30.0, 0.0, 5.0], (("loss", "", (0,)), ("nothing", "", ()), ("loss", "", (1,))))
    common = odds.Row("common", "", (0, 1, 2, 3), (), 60.0, NONE, NONE)
    doubted, apart = (replace(sure, rows=(*sure.rows, c)) for c in (common, common._replace(weak=(0,))))
    assert [c.decided(c.weighed()) for c in (sure, doubted, apart)] == [odds.Decision.LOSS, odds.Decision.OPEN, odds.Decision.LOSS]
    assert doubted.weighed()[:3] == apart.weighed()[:3] == sure.weighed()[:3]
    assert doubted.weighed().common > 0.99 and apart.weighed().common == 0.0


@pytest.mark.parametrize("lost, weak", [([0.5, 0.6, 0.4, 0.5], ()), ([0.1, 0.6, 0.0, 0.1], (1,))])
def test_who_loses_more_than_the_others_is_weak_beside_a_common_loss(lost, weak):
    fit = Fit(0.0, np.array(lost), np.full(4, 0.1))
    assert odds.row(odds.Rival("common", Explanation((0, 1, 2, 3))), fit).weak == weak


def test_what_only_the_scan_has_pointed_to_must_exceed_all_else_by_more():
    names = (("nothing", "", ()), ("loss", "", (0,)), ("slow 0.2 s", "", (0,)))
    margin = (odds.WEIGHTS["nothing"] + 0.5 * (np.log(SURE / (1.0 - SURE)) + odds.LIMITS.scanned)) / odds.TEMPER
    cases = ((margin, "steps"), (margin, odds.SCAN), (-20.0 / odds.TEMPER, "steps"))
    open_, scanned, faint = (a_claim([0.0, x, -99.0], names, named=False, origin=origin) for x, origin in cases)
    decisions = [c.decided(c.weighed()) for c in (open_, scanned, faint)]
    assert decisions == [odds.Decision.LOSS, odds.Decision.OPEN, odds.Decision.DROPPED]
    late = a_claim([0.0, 0.0, 3.0 * margin], names, named=False, origin=odds.SCAN)
    assert late.decided(late.weighed()) is odds.Decision.SLOW
    other = replace(late, rotors=(2,))
    assert other.decided(other.weighed()) is odds.Decision.DROPPED  # slow is another rotor than the one that was pointed to


def test_a_stuck_rotor_alone_has_no_size_and_stays_open():
    names = (("nothing", "", ()), ("stuck", "", (0,)))
    claim = a_claim([0.0, 60.0 / odds.TEMPER], names, named=False, origin="steps")
    assert claim.decided(claim.weighed()) is odds.Decision.OPEN
    lost = a_claim([0.0, 60.0 / odds.TEMPER, 40.0 / odds.TEMPER], (*names, ("loss", "", (0,))), named=False, origin="steps")
    assert lost.decided(lost.weighed()) is odds.Decision.OPEN  # its size would be of an explanation that is not likely


def test_odds_are_stated_weaker_than_they_decide_and_never_as_certain():
    assert odds.stated(0.5) == pytest.approx(0.5 * (odds.LEAST + SUREST))
    weaker = 9.0**odds.POWER
    assert odds.stated(0.9) == pytest.approx(odds.LEAST + weaker / (1.0 + weaker) * (SUREST - odds.LEAST)) and 2.0 < weaker < 6.0
    assert (odds.stated(0.0), odds.stated(1.0 + 1e-16)) == (odds.LEAST, pytest.approx(SUREST))


def test_the_json_holds_what_decides():
    claim = a_claim([12.0, 11.0, 0.0, 3.0, 8.0, 1.0], alternatives=((1, 2),))
    table = claim.to_dict()
    again = odds.read(table, 4)
    assert again.weighed().claim == pytest.approx(claim.weighed().claim)
    found = claim.weighed()
    assert table["probability"] == odds.stated(found.claim)
    assert table["probability_none"] == pytest.approx(1.0 - odds.stated(1.0 - found.none))
    assert table["decision"] == again.decided(again.weighed()).value
    assert [r["nats"] for r in table["explanations"]] == [12.0, 11.0, 0.0, 3.0, 8.0, 1.0]
    assert table["explanations"][5]["weak"] == [2]
    either = replace(claim, named=False, rotors=(2, 3))  # of any one of them
    assert either.to_dict()["probability"] == odds.stated(either.weighed().others[1,])


def drawn(count, weights, temper, seed=0, names=NAMES):
    """Flights of one claim each, whose true explanation is drawn with the probabilities of these constants."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        claim = a_claim(rng.normal(0.0, 6.0, len(names)), names)
        share = odds_fit.share(claim.logs(weights, temper))
        row = claim.rows[rng.choice(len(names), p=share)]
        found.append(flown([claim], [Fault(r + 1, "loss", 30.0, 30.0) for r in row.weak]))
    return found


def test_the_fit_finds_weights_and_temper_that_made_the_data_and_predicts_better():
    weights, temper = {**odds.WEIGHTS, "nothing": 1.0, "step": 0.5}, 0.4
    result = odds_fit.evaluate(drawn(2500, weights, temper), drawn(1000, weights, temper, 1), width=10.0)
    assert result.temper == pytest.approx(temper, rel=0.15)
    # both say that no rotor is weak: only their sum shows
    assert np.logaddexp(result.weights["nothing"], result.weights["step"]) == pytest.approx(np.logaddexp(1.0, 0.5), abs=0.35)
    assert result.loss[1] < result.loss[0] and result.claims == (2500, 1000)
    text = odds_fit.markdown(result)
    assert "`nothing`" in text and f"{result.temper:.3f}" in text and odds_fit.to_dict(result)["counts"][1]["right"] > 0


def test_few_claims_are_not_fitted_to():
    with pytest.raises(ConfigError, match="give more flights"):
        odds_fit.evaluate(drawn(5, odds.WEIGHTS, 1.0), [])


@pytest.mark.parametrize(
    ("faults", "must", "may"),
    [
        ((), set(), set()),
        ((Fault(2, "loss", 29.0, 29.0),), {1}, {1}),
        ((Fault(2, "tilt", 29.0, 29.0),), set(), set()),
        ((Fault(2, "loss", 5.0, 5.0),), set(), {1}),  # long weak: no change
        ((Fault(2, "slow", 5.0, 5.0),), {1}, {1}),
        ((Fault(2, "loss", 10.0, 40.0),), {1}, {1}),  # grows
        ((Fault(2, "loss", 45.0, 45.0),), None, None),  # begins while it is compared
    ],
)
def test_what_was_true_of_a_claim(faults, must, may):
    what = odds_fit.truth(faults, a_claim([0.0] * 6))
    assert (what is None) if must is None else (what == (must, may))


def test_counts_tell_right_from_wrong_and_healthy_from_faulty():
    sure = a_claim([50.0, 50.0, 0.0, 0.0, 0.0, 0.0])
    gone = a_claim([0.0, 0.0, 50.0, 0.0, 0.0, 0.0])
    other = Fault(3, "loss", 29.0, 29.0)
    names = (*NAMES[:5], ("loss", "", (2,)))
    elsewhere = replace(sure, rows=a_claim([50.0, 50.0, 0.0, 0.0, 0.0, 0.0], names).rows)
    own = Fault(1, "loss", 29.0, 29.0)
    flights = [flown([sure], [own]), flown([sure]), flown([elsewhere], [other]), flown([gone], [own]), flown([gone])]
    data = odds_fit.labelled(flights)
    assert odds_fit.counts(data) == odds_fit.Counts(right=1, wrong_healthy=1, wrong_other=1, doubt=0, dropped_true=1)


def test_ablation_counts_what_changes():
    wind = a_claim([20.0, 20.0, 0.0, 60.0, 0.0, 0.0])  # only the step denies the loss
    found = odds_ablation.run(odds_fit.labelled([flown([wind])] * 3))
    assert found.base.wrong_healthy == 0 and found.found["step 1", "off"] == (odds_fit.Counts(0, 3, 0, 0, 0), 3)
    assert found.found["nothing", "off"][1] == 0 and ("loss", "off") not in found.found
    assert "`step 1`" in found.markdown() and found.to_dict()["claims"] == 3


def test_reliability_is_read_from_both_statements():
    two, weaker = (NAMES[0], NAMES[2]), {name: odds.POWER * w for name, w in odds.WEIGHTS.items()}
    honest = reliability.bins(drawn(3000, weaker, odds.POWER * odds.TEMPER, names=two))  # as `stated` has it
    assessed = [b for b in honest if b.assessed and b.statement == "rotor"]
    assert len(assessed) > 5 and all(abs(b.off) < 0.1 for b in assessed)
    boasts = reliability.bins(drawn(3000, weaker, 0.1 * odds.POWER * odds.TEMPER, names=two))
    assert max(abs(b.off) for b in boasts if b.assessed) > 0.2
    assert "rotor at fault" in reliability.markdown(honest) and reliability.to_dict(honest)[0]["right"]["n"] > 0


def test_reliability_has_a_figure(tmp_path):
    pytest.importorskip("matplotlib")
    reliability.draw(reliability.bins(drawn(500, odds.WEIGHTS, odds.TEMPER)), tmp_path / "r.svg")
    assert "stated probability" in (tmp_path / "r.svg").read_text(encoding="utf-8") or (tmp_path / "r.svg").stat().st_size > 5000


def test_tables_of_truth(tmp_path):
    table = tmp_path / "truth.csv"
    table.write_text("path,kind,rotors,onset_s,end_s\na.bin,pair,1+3,20;30,\nb.bin,healthy,,,\n", encoding="utf-8")
    (name, log, faults, kind), healthy = claims._truth(table)
    assert (name, log, kind) == (tmp_path.name, str(tmp_path / "a.bin"), "pair") and healthy[2] == ()
    assert [(f.rotor, f.onset_s, f.end_s) for f in faults] == [(1, 20.0, np.inf), (3, 30.0, np.inf)]
    table.write_text("path,kind\na.bin,loss\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="lacks a column"):
        claims._truth(table)


@pytest.fixture(scope="module")
def sample():
    """A flight with a loss of a third of rotor 3, and its truth."""
    import rotorwatch

    place = next(iter(sorted((claims.Path(rotorwatch.__file__).parent / "samples").glob("hexax_m3*"))), None)
    return place or pytest.skip("the package carries no sample flight")


def test_flights_are_collected_with_their_claims(sample, tmp_path):
    table = tmp_path / "truth.csv"
    table.write_text(f"path,kind,rotors,onset_s,end_s\n{sample},loss,3,0,\n", encoding="utf-8")
    (found,) = claims.collect(truths=[table], jobs=1)
    assert found.broken == {3} and found.verdict == "fault" and found.compared[0].rotors == (3,)
    assert reliability.bins([found])[0].statement == "event"


def test_the_commands_refuse_in_a_sentence():
    runner = CliRunner()
    own = runner.invoke(commands.fit_odds, ["plans/open.toml", "--seed", "52"])
    assert isinstance(own.exception, ConfigError) and "another --seed" in str(own.exception)
    ticks = runner.invoke(commands.reliability, ["plans/default.toml", "--flights", "1"])
    assert isinstance(ticks.exception, ConfigError) and "assess = 'log'" in str(ticks.exception)
