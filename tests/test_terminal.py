"""Tables for a terminal: what they say of a log and of damaged copies, and where words stand."""

from conftest import hexa_diagnosis
from rotorwatch.report import terminal


def rendered(renderable, width=120):
    from rich.console import Console

    screen = Console(width=width, color_system=None, highlight=False, emoji=False, markup=False)
    with screen.capture() as out:
        screen.print(renderable)
    return out.get()


def info_of(**more):
    return {
        "name": "a.bin", "format": "F", "firmware": "ArduCopter V4", "autopilot": "ArduPilot", "frame": "", "vehicle_type": "hexarotor",
        "rotors": 6, "duration_s": 60.04, "airborne_s": [(4.0, 58.0)], "parameters": 3, "ready": True, "missing": [], "warnings": [],
        "hears": {"ready": False, "why": "no speed is logged", "setting": "Log it.", "sensor": ""},
        "messages": [], "signals": [{"name": "gyro", "rate_hz": 100.0, "unit": "rad/s", "frame": "body", "valid": 0.999, "source": "IMU"}],
    } | more  # fmt: skip


def test_what_info_says_of_a_log():
    text = rendered(terminal.info(info_of()))
    for words in (
        "hexarotor",
        "ArduPilot ArduCopter V4",
        "4.0 to 58.0 s",
        "60.0 s",
        "99 %",
        "100 Hz",
        "what a diagnosis needs",
        "no speed is logged",
    ):
        assert words in text, words
    bad = rendered(terminal.info(info_of(frame="hexa X", autopilot="ArduCopter", ready=False, airborne_s=[], rotors=0)))
    for words in ("hexa X", "cannot be diagnosed", "never found airborne", "no commands found"):
        assert words in bad, words
    assert "hexarotor" not in bad and "ArduCopter ArduCopter" not in bad
    assert "unknown" in rendered(terminal.info(info_of(vehicle_type="")))
    hears = {"ready": True, "why": "", "setting": "", "sensor": "ACC"}
    assert "balance, by ACC" in rendered(terminal.info(info_of(hears=hears)))


def test_a_note_stands_beside_its_word_where_there_is_room():
    notes = terminal.Notes([("warning", "first"), ("assumed", "second one")])
    assert [line.split() for line in rendered(notes, 60).splitlines()] == [["warning", "first"], ["assumed", "second", "one"]]
    assert rendered(notes, 59).splitlines() == ["warning: first", "assumed: second one"]
    long = terminal.Notes([("warning", "x" * 60)])
    assert rendered(long, 69).startswith("warning  x") and rendered(long, 68).startswith("warning: ")


def test_a_healthy_flight_has_few_lines_and_the_rest_is_asked_for():
    """Verdict, reason, one table, what to do; in 80 columns the table stays one, and nothing says that nothing is known."""
    answer = hexa_diagnosis(events=(), warnings=("motors (RCOU): 1 value that does not fit the neighbouring values ignored.",))
    short, whole = (rendered(terminal.diagnosis(answer, verbose), 80) for verbose in (False, True))
    lines = [line for line in short.splitlines() if line.strip()]
    assert len(lines) <= 17 and max(map(len, short.splitlines())) <= 80
    assert short.index("HEALTHY") < short.index("rotor   where") < short.index("→") < short.index("--verbose")
    assert [line.split()[0] for line in lines if "at most 4 %" in line] == [str(k) for k in range(1, 7)]
    for words in ("not assessed\n", "ignored", "Detections by method", "took", "blind", "Thrust curve"):
        assert words not in short
    for words in ("ignored", "Thrust curve", "read 0.12 s", "ardupilot-thrust-loss"):
        assert words in whole


def test_a_warning_that_is_about_the_answer_is_shown():
    said = "weak.bin was set aside: on its own it is diagnosed as a fault."
    assert f"! {said}" in rendered(terminal.diagnosis(hexa_diagnosis(warnings=(said,))))


def test_a_table_of_rotors_of_which_nothing_is_known_is_left_out():
    nothing = rendered(terminal.diagnosis(hexa_diagnosis(events=(), assessed_s=0.0)))
    assert "unobservable" not in nothing and "Not assessed: hardly any of the log is flight." in nothing
