"""From the flights of a store to where each aircraft stands: order, what teaches nothing, services, sisters, one budget of false names."""

import numpy as np
import pytest

from fleet_history import SD, columns, row, wrench
from rotorwatch.fleet import assess, fleet_pages


def flights(theta, seed=0, aircraft="A", **more):
    K, n = theta.shape
    rng = np.random.default_rng(seed)
    w = wrench(columns(n), theta) + rng.standard_normal((K, 3)) * SD
    return [row(k, w[k], n, aircraft, **more) for k in range(K)]


def losses(K, n, rotor=0, values=0.0):
    theta = np.zeros((K, n))
    theta[:, rotor] = values
    return theta


def after(K, k, size):
    return np.where(np.arange(K) >= k, size, 0.0)


def test_a_damaged_rotor_in_plain_words():
    found, points = assess.standings({"A": flights(losses(40, 4, 2, after(40, 25, 0.2)))}, {})
    one = found["A"]
    assert one["headline"].startswith("Rotor 3 is damaged since flight 26: ")
    (change,) = one["changes"]
    assert (change["kind"], change["rotor"], change["flight"]) == ("loss", 3, 26)
    assert change["size"] == pytest.approx(0.2, abs=0.03) and change["hash"] == f"{25:064x}"
    third = one["rotors"][2]
    assert third["status"] == "damaged" and third["named"] and third["interval"][0] < 0.2 < third["interval"][1]
    assert [r["status"] for r in one["rotors"] if r["rotor"] != 3] == ["healthy"] * 3
    assert np.shape(points["A"]["loss"]) == (40, 4)
    assert np.mean(points["A"]["loss"], axis=0)[2] > 0.05


def test_what_is_said_does_not_hang_on_the_order_of_rows():
    rows = flights(losses(30, 4, 2, after(30, 20, 0.2)))
    assert assess.standings({"A": rows}, {}) == assess.standings({"A": rows[::-1]}, {})


def test_faulty_flights_are_shown_and_teach_nothing():
    rows = flights(losses(40, 4))
    for k in range(10, 25):
        rows[k] |= {"verdict": "fault" if k % 2 else "ambiguous"}
        rows[k]["trim"]["wrench"] = [0.3, -0.2, 0.1]
    rows[30]["trim"]["doubt"] = "the log contradicts itself"
    rows[31]["trim"]["limited"] = [0.0, 0.5, 0.0, 0.0]
    rows[32] |= {"trim": {}}
    rows[33]["trim"]["share"] = [0.4] * 6
    found, points = assess.standings({"A": rows}, {})
    one = found["A"]
    assert (one["used"], one["flights"]) == (21, 40)
    assert {o["why"] for o in one["left_out"]} == {
        "diagnosed fault on its own", "diagnosed ambiguous on its own", "its log is inconsistent", "a rotor was at its limit",
        "too little steady hover", "different number of rotors",
    }  # fmt: skip
    assert not one["changes"] and points["A"]["loss"][12] is None and not points["A"]["used"][12]


def test_an_aircraft_without_a_usable_flight_is_not_assessed():
    rows = flights(losses(5, 4))
    for r in rows:
        r["trim"] = {}
    found, points = assess.standings({"A": rows}, {})
    assert found["A"]["used"] == 0 and not points
    assert {r["status"] for r in found["A"]["rotors"]} == {"unknown"} and "steady hover" in found["A"]["headline"]


@pytest.mark.parametrize("clock", ["utc", "count", "added"])
def test_flights_are_put_in_order_by_what_the_logs_have(clock):
    rows = flights(losses(12, 4))
    for k, r in enumerate(rows):
        r["ordinal"] = k + 1 if clock == "added" else 12 - k
        r["count"] = k + 5 if clock == "count" else None
        r["utc"] = r["utc"] if clock == "utc" else None
    one = assess.history("A", rows[::-1], ())
    assert [r["hash"] for r in one.rows] == [f"{k:064x}" for k in range(12)]


def test_a_flight_without_a_time_stays_where_it_was_added():
    rows = flights(losses(6, 4))
    rows[3]["utc"] = None
    one = assess.history("A", rows[::-1], ())
    assert [r["ordinal"] for r in one.rows] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("verdicts", "cut", "state"),
    [
        (["crashed"] * 7, 0, "fault"),
        (["healthy", "fault"], 0, "fault"),
        (["fault", "inconclusive"], 0, "fault"),  # nothing was shown to be well since
        (["fault", "healthy"], 0, "suspect"),
        (["fault", "healthy"], 1, "healthy"),  # it was serviced in between
        (["healthy", "ambiguous"], 0, "suspect"),
        (["healthy", "inconclusive"], 0, "not assessed"),
        (["inconclusive"] * 3, 0, "not assessed"),
        (["healthy"] * 3, 0, "healthy"),
        (["healthy", "fault"], 2, "not assessed"),  # no flight since
    ],
)
def test_the_state_of_an_aircraft(verdicts, cut, state):
    rows = flights(losses(len(verdicts), 4))
    for r, verdict in zip(rows, verdicts, strict=True):
        r["verdict"] = verdict
    given = {"A": [service(0, after=cut)]} if cut else {}
    found, _ = assess.standings({"A": rows}, given)
    assert found["A"]["state"] == state and found["A"]["last"]["verdict"] == verdicts[-1]


def service(rotor, utc=None, after=0, number=1):
    return {"aircraft": "A", "number": number, "rotor": rotor, "what": "new propeller", "utc": utc, "after": after}


@pytest.mark.parametrize("given", [service(3, utc="2026-01-21T00:00:00.000Z"), service(3, after=20), service(0, after=20)])
def test_a_service_makes_a_rotor_new(given):
    rows = flights(losses(40, 4, 2, np.where(np.arange(40) < 20, np.linspace(0.0, 0.3, 40), 0.0)), seed=1)
    found, _ = assess.standings({"A": rows}, {"A": [given]})
    third = found["A"]["rotors"][2]
    assert third["status"] == "restored" and third["loss"] == 0.0
    assert found["A"]["services"][0]["before_flight"] == 21
    assert found["A"]["headline"] == "No rotor has lost thrust over its flights."


@pytest.mark.parametrize(
    ("dates", "ordinals", "given", "place"),
    [
        (("01", "03", None), (1, 2, 3), {"utc": "02", "after": 3}, 1),  # the third was added after March's
        ((None, "01", "03"), (1, 2, 3), {"utc": "02", "after": 3}, 2),
        (("01", None, "03"), (1, 2, 3), {"utc": "02", "after": 3}, 2),
        (("01", None, None), (1, 2, 3), {"utc": "02", "after": 2}, 2),  # the third was not there when it was noted
        (("01", None, None), (1, 2, 3), {"utc": "02", "after": 0}, 1),
        (("03", "04"), (1, 2), {"utc": "02", "after": 2}, 0),
        (("01", "02", "03", "04"), (4, 3, 2, 1), {"utc": None, "after": 3}, 2),  # it names a flight
        (("01", "02", "03", "04"), (5, 4, 1, 2), {"utc": None, "after": 3}, 4),  # which was deleted
        ((None, None, None), (1, 2, 3), {"utc": "02", "after": 1}, 1),
        ((None, None), (1, 2), {"utc": None, "after": 0}, 0),
    ],
)
def test_a_service_is_behind_the_last_flight_that_is_known_to_be_before_it(dates, ordinals, given, place):
    def day(month):
        return month and f"2026-{month}-01T00:00:00.000Z"

    rows = flights(losses(len(dates), 4))
    for r, month, ordinal in zip(rows, dates, ordinals, strict=True):
        r |= {"utc": day(month), "ordinal": ordinal, "count": None}
    one = assess.history("A", rows, [service(1, day(given["utc"]), given["after"])])
    assert [r["ordinal"] for r in one.rows] == list(ordinals)
    assert one.services[0][0] == place


def test_after_a_service_that_no_flight_followed():
    rows = flights(losses(30, 4, 2, np.linspace(0.0, 0.2, 30)), seed=1)
    found, _ = assess.standings({"A": rows}, {"A": [service(3, after=30)]})
    assert found["A"]["rotors"][2]["status"] == "serviced" and found["A"]["rotors"][2]["loss"] == 0.0


def test_sisters_of_a_build_show_what_was_there_from_the_first_flight():
    rows = {f"A{k}": flights(losses(15, 4, 1, 0.3 if k == 3 else 0.0), seed=10 + k, aircraft=f"A{k}") for k in range(6)}
    found, _ = assess.standings(rows, {})
    assert [key for key, one in found.items() if any(r["named"] for r in one["rotors"])] == ["A3"]
    assert found["A3"]["rotors"][1]["named"] and found["A3"]["changes"][0]["from_the_first"] and found["A3"]["sisters"] == 5
    # Of another build there is nobody to compare with.
    for r in rows["A3"]:
        r["build"] = "another"
    found, _ = assess.standings(rows, {})
    assert found["A3"]["sisters"] == 0 and not found["A3"]["changes"]


def test_wind_is_taken_out():
    rng = np.random.default_rng(3)
    rows = flights(losses(40, 4), seed=3)
    for r in rows:
        fx, fy = 0.1 * rng.standard_normal(2)
        t = r["trim"]
        t["force"], t["slope"], t["slope_sd"] = [fx, fy], [1.5, -1.2], [0.05, 0.05]
        t["wrench"] = [t["wrench"][0] + 1.5 * fy, t["wrench"][1] - 1.2 * fx, t["wrench"][2]]
    one = assess.history("A", rows, ())
    slope, between = assess._wind([r["trim"] for r in rows])
    assert slope == pytest.approx([1.5, -1.2], abs=0.05) and (between < 0.16).all()
    y, _ = assess._table(one, slope, between)
    assert (y[:, :2].std(axis=0) < 2 * SD[:2]).all()


def test_aircraft_of_healthy_fleets_are_left_alone():
    rows = {f"A{k}": flights(losses(30, 4 if k % 2 else 6), seed=50 + k, aircraft=f"A{k}", build=str(k % 2)) for k in range(12)}
    found, _ = assess.standings(rows, {})
    assert not any(r["named"] for one in found.values() for r in one["rotors"])


def heard(k, rotors):
    """A flight whose imbalances were heard."""
    one = row(k, np.zeros(3), len(rotors))
    return one | {"trim": one["trim"] | {"imbalance": {"unit": "g mm/kg", "rotors": rotors}}}


def test_the_imbalance_of_each_rotor_over_the_flights():
    figures = [[[1.0 + 0.1 * k, 0.9, 1.1 + 0.1 * k], None, [0.5, 0.4, 0.6], [0.7, 0.6, 0.8]] for k in range(30)]
    rows = [heard(k, f) if k % 3 else row(k, np.zeros(3), 4) for k, f in enumerate(figures)]
    _, points = assess.standings({"A": rows, "B": flights(losses(30, 4), aircraft="B")}, {})
    assert points["A"]["unit"] == "g mm/kg" and "imbalance" not in points["B"]
    assert points["A"]["imbalance"][:3] == [None, figures[1], figures[2]] and "loss" in points["A"]
    page = fleet_pages._balance(points["A"])
    assert page.count("<svg") == 3 and page.count("<circle") == 60 and "g mm/kg" in page and "Imbalance of rotor 2" not in page
    few = assess.standings({"A": [heard(0, figures[0]) | {"verdict": "fault"}]}, {})[1]["A"]
    aircraft = {"name": "A", "flights": 1, "airborne_s": 60.0, "build": "one", "identities": ["x"], "standing": None}
    assert "loss" not in few and "Imbalance of rotor 1" in fleet_pages._aircraft(aircraft, few, ())
