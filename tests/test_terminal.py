"""Tables for a terminal: what they say of a log and of damaged copies, and where words stand."""

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
    ):
        assert words in text, words
    bad = rendered(terminal.info(info_of(frame="hexa X", autopilot="ArduCopter", ready=False, airborne_s=[], rotors=0)))
    for words in ("hexa X", "cannot be diagnosed", "never found airborne", "no commands found"):
        assert words in bad, words
    assert "hexarotor" not in bad and "ArduCopter ArduCopter" not in bad
    assert "unknown" in rendered(terminal.info(info_of(vehicle_type="")))


def test_a_note_stands_beside_its_word_where_there_is_room():
    notes = terminal.Notes([("warning", "first"), ("assumed", "second one")])
    assert [line.split() for line in rendered(notes, 60).splitlines()] == [
        ["warning", "first"],
        ["assumed", "second", "one"],
    ]
    assert rendered(notes, 59).splitlines() == ["warning: first", "assumed: second one"]
    long = terminal.Notes([("warning", "x" * 60)])
    assert rendered(long, 69).startswith("warning  x") and rendered(long, 68).startswith("warning: ")
