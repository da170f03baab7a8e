"""ROS 2 bags: folders or single files, MCAP or SQLite, with topics of PX4 (px4_msgs) or of mavros. No ROS is needed.

px4_msgs carry the fields of PX4's own topics under their names, so `px4_topics` reads them as it reads a ULog. Topics:
/fmu/out/vehicle_attitude, /fmu/out/vehicle_status_v1 (a version of the message), /drone_1/fmu/out/.. (a name space).
https://docs.px4.io/main/en/middleware/uxrce_dds.html
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight
from rotorwatch.logs import bag_storage, cdr, container, mavros, px4_reports, px4_topics, ros2_definitions, series, wall_clock
from rotorwatch.logs.container import open_log

FORMAT = "ROS 2 bag"
ENDINGS = (".mcap", ".db3")
_ENOUGH = 20  # samples of a topic that is published all the time
_UNIX_US = 1e14  # larger stamps count from 1970, smaller ones from the autopilot's start
_TOPIC = re.compile(r"(?P<name>[a-z0-9_]*?[a-z])(?P<instance>_?\d)?(?P<version>_v\d+)?")
_OWN = "/rotorwatch/"  # topics of a diagnosis, written by this program


def sniff(head: bytes, name: str) -> bool:
    """True for an MCAP file and for an SQLite database with topics, or with a bag's name: other programs use SQLite, too."""
    if head.startswith(bag_storage.SQLITE):
        return b"topics" in head or name.lower().endswith(".db3")
    return head.startswith(bag_storage.MCAP)


def read(data, name: str, progress=None) -> Flight:
    """Read one file of a bag. Raises LogError when it holds no topic of PX4 or mavros."""
    bag = bag_storage.Bag(_wanted, container.most(len(data)))
    _take(data, bag, progress)
    return _flight(bag)


def _take(data, bag: bag_storage.Bag, progress) -> None:
    if bytes(data[: len(bag_storage.SQLITE)]) == bag_storage.SQLITE:
        bag_storage.read_sqlite(bytes(data), bag, progress)
    else:
        bag_storage.read_mcap(data, bag, progress)


def sniff_folder(path: Path) -> bool:
    """True for a folder with files of a bag in it."""
    return bool(_files(path))


def read_folder(path: Path, progress=None) -> Flight:
    """Read a bag: its files in the order of their numbers. Raises LogError when it holds no topic of PX4 or mavros."""
    files = _files(path)
    bag = bag_storage.Bag(_wanted, container.most(sum(file.stat().st_size for file in files)))
    for done, file in enumerate(files):

        def report(share, done=done):
            if progress:
                progress((done + share) / len(files))

        try:
            if file.name.lower().endswith(".db3"):
                bag_storage.read_sqlite(file, bag, report)
                if (left := file.with_name(file.name + "-wal")).exists() and left.stat().st_size:
                    bag.notes.append(f"{file.name}: the recording was interrupted; what {left.name} holds was not read")
            else:
                data, _, warnings = open_log(file)
                bag.notes += [f"{file.name}: {w}" for w in warnings]
                _take(data, bag, report)
        except LogError as error:
            if len(files) == 1:
                raise
            bag.notes.append(f"{file.name}: {error}")
    return _flight(bag)


def _files(path: Path) -> list[Path]:
    """The bag's files, in the order of the numbers in their names."""

    def number(file: Path) -> tuple[int, str]:
        match = re.search(r"_(\d+)\.\w+(?:\.\w+)?$", file.name)
        return (int(match[1]) if match else -1), file.name

    endings = tuple(ending + packed for ending in ENDINGS for packed in ("", *container.PACKED))
    return sorted((p for p in path.iterdir() if p.name.lower().endswith(endings) and p.is_file()), key=number)


def place(topic: str) -> tuple[str, str, int, bool] | None:
    """(name space, PX4's name, instance, out) of a topic of PX4, None for others: ("/drone_1", "actuator_outputs", 1, True).

    out: published by the autopilot, not sent to it by a companion computer. Of PX4 before 1.14 too: /fmu/vehicle_attitude/out,
    VehicleAttitude_PubSubTopic."""
    parts = topic.strip("/").split("/")
    for at in range(len(parts) - 1, -1, -1):
        word = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", parts[at].removesuffix("_PubSubTopic")).lower()
        for known, instance in ((word, 0), *_split(word)):
            if known in px4_topics.TOPICS:
                before = parts[: parts.index("fmu")] if "fmu" in parts else parts[:at]
                return "/".join(before), known, instance, "in" not in parts
    return None


def _split(word: str):
    """A topic's name without its version and the number of its instance."""
    match = _TOPIC.fullmatch(word)
    if match:
        number = match["instance"]
        yield match["name"] + (number or ""), 0
        yield match["name"], int(number.strip("_")) if number else 0


def _wanted(topic: str, kind: str) -> bool:
    if kind.startswith("px4_msgs/"):
        return place(topic) is not None
    return mavros.place(topic, kind) is not None


def tables(bag: bag_storage.Bag) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Topic -> (stamps of receipt (m,) ns, columns) of all decodable topics; `bag.notes` names the others."""
    out = {}
    for topic in bag.topics.values():
        if not topic.payloads:
            continue
        columns, rows = _decoded(topic)
        lost = len(topic.payloads) - rows.size
        if not rows.size:
            what = "its messages do not match their definition" if topic.definition else "the bag does not carry its definition"
            if topic.definition or (at := place(topic.name)) is None or at[1] not in px4_reports.TOPICS:
                bag.notes.append(f"{topic.name} was skipped: {what}")
            continue
        if lost:
            bag.notes.append(f"{topic.name}: {lost} of {len(topic.payloads)} messages are damaged and were skipped")
        out[topic.name] = np.array(topic.stamps, np.float64)[rows], columns
    return out


def _decoded(topic: bag_storage.Topic):
    """(columns, rows): by the bag's own definition, else by the stored form that the values fit."""
    wanted = mavros.FIELDS.get(topic.kind)
    for text in (topic.definition,) if topic.definition else ros2_definitions.forms(topic.kind):
        try:
            columns, rows = cdr.decode(topic.payloads, cdr.parse(text, topic.kind), topic.kind, wanted)
        except cdr.Unreadable:
            continue
        if rows.size and (topic.definition or ros2_definitions.fits(topic.kind, columns)):
            return columns, rows
    return {}, np.zeros(0, int)


def _flight(bag: bag_storage.Bag) -> Flight:
    topics = tables(bag)
    px4 = {name: t for name, t in topics.items() if bag.topics[name].kind.startswith("px4_msgs/")}
    rest = {name: (bag.topics[name].kind, *t) for name, t in topics.items() if name not in px4}
    moving = any((at := place(name)) and at[1] in ("actuator_motors", "actuator_outputs") for name in px4)
    if px4 and (moving or not mavros.has_outputs(rest)):
        return _px4_flight(px4, bag.notes)
    if rest:
        return mavros.flight(rest, bag.notes, FORMAT)
    if any(name.startswith(_OWN) for name in bag.others):
        raise LogError("this is a diagnosis that rotorwatch wrote, not a flight; give the log that was diagnosed")
    if bag.topics:
        why = "; ".join(bag.notes) or "no message was recorded"
        raise LogError(f"this bag holds topics of PX4 or mavros, but none could be read ({why})")
    names = ", ".join(sorted(bag.others)[:3]) or "none at all"
    raise LogError(f"this file holds no ROS 2 topic of PX4 (px4_msgs, /fmu/out/..) or of mavros (/mavros/..); its topics are {names}")


def _px4_flight(found, notes: list[str]) -> Flight:
    """The flight of one vehicle's px4_msgs."""
    spaces: dict[str, dict] = {}
    for name in sorted(found, key=lambda n: not place(n)[3]):  # pyright: ignore[reportOptionalSubscript]: all are PX4's
        space, topic, instance, out = place(name)  # pyright: ignore[reportGeneralTypeIssues]
        # Of the topics sent to the autopilot only motor commands are read, where the autopilot does not publish them.
        if "timestamp" in found[name][1] and (out or topic == "actuator_motors"):
            if spaces.setdefault(space, {}).setdefault((topic, instance), name) == name and not out:
                notes.append(f"motor commands are those sent to the autopilot ({name}); it does not publish its own")
    if not spaces:
        raise LogError("this bag holds topics of PX4, but none that says how the vehicle moved")
    chosen = max(sorted(spaces), key=lambda s: (_driven(spaces[s]), sum(len(found[n][0]) for n in spaces[s].values())))
    if len(spaces) > 1:
        others = ", ".join(sorted(s or "/" for s in spaces if s != chosen))
        notes.append(f"this bag is of several vehicles; {chosen or '/'} was read, {others} was not")
    parts = {key: found[name] for key, name in spaces[chosen].items()}
    stamps = {key: np.asarray(columns["timestamp"]).astype(np.int64) for key, (_, columns) in parts.items()}
    first = {key: int(s[series.steady(s * 1e-6)[0]]) for key, s in stamps.items() if s.size}
    often = [t for key, t in first.items() if stamps[key].size >= _ENOUGH]
    start = min(often or first.values())
    topics = px4_topics.Topics({key: {**columns, "timestamp": stamps[key]} for key, (_, columns) in parts.items()}, start)
    signals, facts = px4_topics.signals(topics, {})
    if "motors" not in signals:
        notes.append(
            "the bag has no motor commands: let PX4 publish actuator_motors (dds_topics.yaml) and record it, or diagnose this flight's ULog"
        )
    facts["utc_start"] = _utc(facts.get("utc_start"), start, stamps, parts)
    return Flight(
        format=FORMAT,
        autopilot="PX4",
        signals=signals,
        duration=series.end_of(signals),
        firmware="PX4",
        messages=tuple(sorted(px4_topics.messages(topics), key=lambda m: m.time)),
        warnings=(*notes, *topics.notes, "parameters are not in ROS 2 bags; --vehicle FILE describes the airframe"),
        start_us=start,
        facts=facts,
    )


def _driven(topics) -> bool:
    return any(name in ("actuator_motors", "actuator_outputs") for name, _ in topics)


def _utc(gps_start: str | None, start: int, stamps, parts) -> str | None:
    """UTC of second 0: by the GPS, else the stamps themselves where PX4 uses ROS's time, else the times of receipt."""
    if gps_start is not None:
        return gps_start
    if start > _UNIX_US:
        return wall_clock.start([0.0], [start * 1e-6])
    key = max(stamps, key=lambda k: stamps[k].size)
    return wall_clock.start((stamps[key] - start) * 1e-6, parts[key][0] * 1e-9)
