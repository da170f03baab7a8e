"""The words for numbers, rotors and events, which every sentence, table and page uses."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence

from rotorwatch.engine.drift.outcome import WORN
from rotorwatch.engine.events.decisions import MATTERS, TOTAL_LOSS
from rotorwatch.engine.motion.air_spans import Gap
from rotorwatch.flight.diagnosis import Event, Trend
from rotorwatch.flight.kinds import Words

CAUSES = {"propeller": "propeller", "motor_or_esc": "motor or ESC", "bearing": "bearing"}
BASELINE = "To detect smaller damage present at take-off, give a healthy flight of the same build: --baseline HEALTHY.LOG."
LONGEST, SAYS = 200, 40  # letters of a headline; of a sentence without its last clause, at least
NAMED = 5  # gaps that warnings name
VERDICTS = {
    "healthy": "Healthy", "fault": "Fault found", "crashed": "Crashed, no rotor fault", "ambiguous": "Ambiguous",
    "inconclusive": "Inconclusive",
}  # fmt: skip

# Grade of health, and its least loss. 5 %: scatter of propellers and motors of one build. 20 %: the rotor turns 12 %
# faster for the same thrust, which controllers hardly notice below. 50 %: of a vehicle with twice its weight in thrust, the rotor no
# longer carries its own share at full command. Above TOTAL_LOSS it carries almost nothing: the status "failed" as well. The status
# "degraded" covers any loss, so no grade has that name.
SCALE = (("healthy", 0.0), ("worn", WORN), ("weak", MATTERS), ("critical", 0.50), ("failed", TOTAL_LOSS))


def percent(share: float, digits: int = 0) -> str:
    """0.374 -> '37 %'. Never '-0 %'."""
    text = f"{100 * share:.{digits}f}"
    return f"{text.lstrip('-') if float(text) == 0 else text} %"


def up_to(share: float) -> str:
    """An upper bound in whole percent, never less than it is: 0.004 -> '1 %', 0.214 -> '22 %'."""
    return f"{min(100, max(1, math.ceil(round(100 * share, 6))))} %"


def interval(low: float, high: float) -> str:
    """A 95 % interval of shares: '33–41 %'."""
    return f"{percent(low)[:-2]}–{percent(high)}"


def probability(value: float) -> str:
    """'97 %', but never a certainty that was rounded up: '> 99.9 %'."""
    return "> 99.9 %" if value > 0.999 else percent(value, 1 if value > 0.985 else 0)


def seconds(time: float | None) -> str:
    """'41.20 s'; an event that lasts has no end: '–'."""
    return "–" if time is None else f"{time:.2f} s" if abs(time) < 1000 else f"{time:.1f} s"


def listed(words: Sequence[str], last: str = "and") -> str:
    """('a', 'b', 'c') -> 'a, b and c'."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}" if words else ""


def rotors(numbers: Iterable[int], places: Sequence[str] = ()) -> str:
    """(3,) -> 'rotor 3', (1, 2, 4) -> 'rotors 1, 2 and 4', () -> 'no rotor'; with places: 'rotor 3 (front left)'."""
    numbers = list(numbers)
    names = [f"{n} ({places[n - 1]})" if n <= len(places) and places[n - 1] else str(n) for n in numbers]
    if not names:
        return "no rotor"
    return f"rotor{'s' if len(names) > 1 else ''} {listed(names)}"


def not_commanded(gaps: Sequence[Gap], n: int) -> list[str]:
    """Sentences on the commands that the log of n rotors lacks in the air."""
    sentences = []
    for gap in gaps[:NAMED]:
        what = "No motor outputs are logged" if len(gap.rotors) == n else f"The log has no command for {rotors(gap.rotors)}"
        if gap.lasts:
            sentences.append(f"{what} from {gap.start:.1f} s to the end of the flight: nothing can be assessed after that.")
        elif gap.first:
            sentences.append(
                f"{what} from lift-off at {gap.start:.1f} s to {gap.end:.1f} s: the flight is assessed from then on, and earlier "
                "damage counts as present at take-off."
            )
        else:
            sentences.append(
                f"{what} from {gap.start:.1f} s to {gap.end:.1f} s, in the air: what happened in that time shows only by "
                "its effect afterwards."
            )
    if len(gaps) > NAMED:
        sentences.append(f"The same applies to {len(gaps) - NAMED} more gaps, the last one up to {gaps[-1].end:.1f} s.")
    return sentences


def together(outputs: Sequence[Event]) -> list[tuple[str, bool]]:
    """(sentence, whether it lasts to the end) for each group of outputs that left the mixer together."""
    spans: dict[tuple[float, float | None], list[int]] = {}
    for e in outputs:
        spans.setdefault((e.onset_s, e.end_s), []).extend(e.rotors)
    sentences = []
    for (start, end), who in spans.items():
        until = "to the end" if end is None else f"to {end:.1f} s"
        what = f"the outputs of {rotors(sorted(who))} depart from the mixer at the same sample, from {start:.1f} s {until}"
        sentences.append((f"{sentence(what)}: the log is wrong there and is not evidence of a rotor fault.", end is None))
    return sentences


def candidates(event: Event, places: Sequence[str] = ()) -> str:
    """The rotors of an event with its alternatives: 'rotors 1 and 2, or rotors 3 and 4'."""
    all_alike = f"all {len(places)} rotors alike"
    every = 2 < len(places)
    sets = (all_alike if every and len(places) == len(s) else rotors(s, places) for s in event.explanations)
    return ", or ".join(sets) or "no single rotor"


def headline(parts: Sequence[str], main: int = 0, caveats: Sequence[str] = ()) -> str:
    """The sentences as a headline of at most LONGEST letters. main: index of the one that is kept; caveats: those of `parts` that the
    reason of the verdict also states. Too long a headline first loses quotes, then last clauses, caveats and sentences beside the main one,
    whose number is added: events and reason have them all."""
    kept, left = [(part, k == main) for k, part in enumerate(parts) if part], 0

    def text() -> str:
        ending = [f"And {left} more finding{'s' if left > 1 else ''}."] if left else []
        return " ".join([*(part for part, _ in kept), *ending])

    def shorter(how: Callable[[str], str], also: bool = False) -> bool:
        """Shorten the last sentence that can be, and return whether there was one; also: the main one, too."""
        for k in reversed(range(len(kept))):
            part, stays = kept[k]
            if (also or not stays) and (new := how(part)) != part:
                kept[k] = new, stays
                return True
        return False

    while len(text()) > LONGEST:
        if shorter(_unquoted) or shorter(_without_clause):
            continue
        beside = [k for k, (_, stays) in enumerate(kept) if not stays]
        said_elsewhere = [k for k in beside if kept[k][0] in caveats]
        if beside and not said_elsewhere and shorter(_without_reason, True):
            continue
        if beside:
            k = (said_elsewhere or beside)[-1]
            left += not said_elsewhere
            del kept[k]
        elif not shorter(_without_last_candidate, True) and not shorter(_without_clause, True):
            break
    return text()


def _unquoted(text: str) -> str:
    return re.sub(r' \("[^"]*"[^()]*\)', "", text)


def _without_clause(text: str) -> str:
    """A sentence cut at its last colon or semicolon, without further sentences."""
    cut = re.match(r'((?:[^":;]|"[^"]*"|[:;](?! ))*(?:[:;] .*)?)[:;] ', text)
    return f"{cut[1].rstrip('.')}." if cut else text


def _without_reason(text: str) -> str:
    """A sentence without its last clause, where the rest is a statement and no list of candidates."""
    cut = _without_clause(text)
    return cut if len(cut) > SAYS and not re.search(": (rotor|all )", text) else text


def _without_last_candidate(text: str) -> str:
    """A sentence that ends with sets of rotors, without the last of them."""
    if not re.search(": (rotor|all )", text):
        return text
    first, separator, _ = text.removesuffix(", or others.").rpartition(", or ")
    return f"{first}, or others." if separator else text


def losses(event: Event) -> str:
    """'37 % (33–41 %)', one per rotor, in the order of the rotors."""
    return ", ".join(f"{percent(v)} ({interval(*i)})" for v, i in zip(event.loss, event.interval, strict=False))


def grows(trend: Trend) -> str:
    """'is losing thrust at 7.3 % (5.5 to 9.1 %) per minute'."""
    return f"is losing thrust at {rate(trend.per_minute)} ({rate(trend.interval[0])[:-2]} to {rate(trend.interval[1])}) per minute"


def rate(share: float) -> str:
    """A change a minute: '0.12 %', '7.3 %', '60 %'."""
    size = abs(100 * share)
    return percent(share, 0 if size >= 20 else 1 if size >= 1 else 2)


def motor(numbers: Iterable[int], places: Sequence[str] = ()) -> str:
    """(3,) -> 'motor 3'; (3, 4) -> 'motor 3 or 4'; with places: 'motor 3 (front left)'."""
    names = [f"{n} ({places[n - 1]})" if n <= len(places) and places[n - 1] else str(n) for n in numbers]
    return f"motor {listed(names, 'or')}"


def sentence(text: str) -> str:
    """The text with a capital at the beginning."""
    return text[:1].upper() + text[1:]


def said(words: Words | str, event: Event, places: Sequence[str] = (), **more: str) -> str:
    """A template of the table of kinds (flight/kinds.py) filled for an event. places: `places.names`; more: values of further fields."""
    extra, count = event.extra, int(event.extra.get("count", 1))
    pieces = {
        "noun": event.means.noun,
        "who": rotors(event.rotors, places),
        "plain_who": rotors(event.rotors),
        "candidates": candidates(event, places),
        "motors": motor([r for own in event.explanations for r in own], places),
        "numbers": listed([str(r) for r in event.rotors]),
        "servos": listed([f"SERVO{r}_FUNCTION" for r in event.rotors]),
        "losses": losses(event),
        "lacks": lost(event),
        "lost": lost(event, " of thrust"),
        "lost_effect": lost(event, " of its effectiveness"),
        "at": seconds(event.onset_s),
        "when": when(event),
        "from_on": f"from {seconds(event.onset_s)}{' on' if event.end_s is None else ''}",
        "end": seconds(event.end_s),
        "why": event.reason.strip().removesuffix("."),
        "Why": sentence(event.reason.strip().removesuffix(".")),
        "cause": cause(event),
        "times": "once," if count == 1 else f"{count} times, first",
        "in_all": f", {count} times in all" if count > 1 else "",
        "log_speed": "" if extra.get("rpm") else "; log its speed next time (bidirectional DShot, eRPM)",
    }
    template = words if isinstance(words, str) else words.template(event)
    return template.format_map(pieces | more)


def lost(event: Event, what: str = "") -> str:
    """'lost 37 % (33-41 %)' and `what`; the thrust of a rotor that follows no command; the first size of a loss that grew in a step."""
    gives = event.extra.get("gives")
    if gives is None and "first_loss" in event.extra:
        return f"lost {percent(event.extra['first_loss'])}{what}"
    if gives is None:
        return f"lost {losses(event)}{what}"
    return f"stopped following its command (stuck at {gives:.1f} times hover thrust)"


def when(event: Event) -> str:
    """'at 41.20 s'; 'from 41.20 s' of a loss that ended; 'gradually from 41.20 s to 65.00 s' of a loss that grew;
    'at 29.95 s, and 100 % (89–100 %) from 50.04 s on' of one that grew in a step."""
    grew = event.extra.get("grew_until_s")
    at = seconds(event.onset_s)
    if grew is not None:
        return f"gradually from {at} to {seconds(grew)}"
    if "stepped_s" in event.extra:
        return f"at {at}, and {losses(event)} from {seconds(event.extra['stepped_s'])}{' on' if event.end_s is None else ''}"
    return f"at {at}" if event.end_s is None else f"from {at}"


def cause(event: Event) -> str:
    """The failed part, by ESC telemetry, to follow 'lost thrust': ', by its propeller'; empty when unknown."""
    part = CAUSES.get(event.extra.get("cause", ""))
    return f", by its {part}" if part and len(event.rotors) == 1 else ""
