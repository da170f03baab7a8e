"""ROS 2 bags: what rosbags writes of a flight is read as the flight's own log is, and answered alike."""

import bz2
import io
import signal
import sqlite3
import struct
import tracemalloc
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

import fuzzing
import ros2_bags
import rotorwatch as rw
from rotorwatch import airframes
from rotorwatch.base import incoming
from rotorwatch.errors import LogError, VehicleError
from rotorwatch.logs import bag_storage, cdr, container, mavros, ros2
from rotorwatch_lab.simulation import scenario, simulate

FAULT = {"kind": "loss", "rotor": 3, "onset_s": 25.0, "strength": 0.4}


def made(autopilot, folder):
    """A simulated flight's log, and the flight."""
    table = {
        **{"duration_s": 45.0, "autopilot": autopilot, "seed": 5, "trajectory": {"altitude_m": 6.0}, "faults": [FAULT]},
        **{"airframe": {"frame": "quad-x"}, "logging": {"profile": "default", "esc": True}},
    }
    simulation = simulate(scenario.from_table(table))
    log = simulation.write(folder / ("one.ulg" if autopilot == "px4" else "one.bin"), folder / "truth")[0]
    return log, simulation.flight


@pytest.fixture(scope="module")
def px4(tmp_path_factory):
    """(ULog, rows of a bag of it)."""
    log, _ = made("px4", tmp_path_factory.mktemp("px4"))
    return log, ros2_bags.of_ulog(log)


@pytest.fixture(scope="module")
def bag(px4, tmp_path_factory):
    return ros2_bags.write(tmp_path_factory.mktemp("bag") / "flight", px4[1])


@pytest.fixture(scope="module")
def plain(px4):
    """The ULog's flight without what bags do not hold: parameters, and the output limits and frame that come of them."""
    flight = rw.read(px4[0])
    return replace(flight, parameters={}, parameter_changes=())


def alike(flight, other, shift, skip=()):
    assert set(flight.signals) - set(skip) == set(other.signals) - set(skip)
    for name in set(flight.signals) - set(skip):
        one, two = flight[name], other[name]
        assert (one.unit, one.columns, one.frame) == (two.unit, two.columns, two.frame), name
        assert np.allclose(one.time, two.time + shift, rtol=0, atol=2e-6), name
        assert np.array_equal(one.valid, two.valid) and np.array_equal(one.values, two.values), name


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("storage, definitions", [("mcap", True), ("sqlite", True), ("sqlite", False)])
def test_px4_messages_are_read_as_the_ulog_is(px4, plain, tmp_path, storage, definitions):
    folder = ros2_bags.write(tmp_path / "flight", px4[1], storage, definitions)
    flight = rw.read(folder)
    shift = (flight.start_us - plain.start_us) * 1e-6
    # Of ESC telemetry and old layouts the shipped definitions know nothing.
    alike(plain, flight, shift, () if definitions else ("esc",))
    assert flight.format == "ROS 2 bag" and flight.autopilot == "PX4" and flight.rotor_count == 4
    assert flight.facts["utc_start"].startswith("2023-11-14T")
    states = [(m.kind, m.text) for m in plain.messages if m.kind in ("armed", "landed", "mode")]
    assert [(m.kind, m.text) for m in flight.messages] == states
    assert any("--vehicle" in w for w in flight.warnings)
    assert definitions or any("esc_status was left out: the bag does not carry its definition" in w for w in flight.warnings)


def test_the_diagnosis_is_that_of_the_ulog(bag, plain):
    one, two = rw.diagnose(plain), rw.diagnose(bag)
    assert one.verdict == two.verdict == "fault" and [e.rotors for e in two.events] == [(3,)]
    shift = (rw.read(bag).start_us - plain.start_us) * 1e-6
    assert two.events[0].onset_s + shift == pytest.approx(one.events[0].onset_s, abs=0.02)
    assert two.events[0].loss == pytest.approx(one.events[0].loss, abs=0.01)


def test_a_single_file_of_a_bag_is_enough(bag, px4, tmp_path, monkeypatch):
    flight = rw.read(next(bag.glob("*.mcap")))
    assert np.array_equal(flight["motors"].values, rw.read(bag)["motors"].values)
    (other,) = ros2_bags.write(tmp_path / "flight", px4[1], "sqlite").glob("*.db3")
    for in_memory in {bag_storage.IN_MEMORY, False}:  # Python 3.10 opens databases from files only
        monkeypatch.setattr(bag_storage, "IN_MEMORY", in_memory)
        assert np.array_equal(flight["gyro"].values, rw.read(other)["gyro"].values)
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / "FLIGHT_0.DB3.bz2").write_bytes(bz2.compress(other.read_bytes()))
    assert np.array_equal(flight["gyro"].values, rw.read(tmp_path / "packed")["gyro"].values)


def chunked(bag, path):
    """The bag's MCAP file once more, by Foxglove's library, in chunks of 50 kB as long recordings have."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with next(bag.glob("*.mcap")).open("rb") as source, path.open("wb") as target:
        reader, writer, channels = make_reader(source), Writer(target, chunk_size=50_000), {}
        writer.start("ros2")
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return path


def test_a_recording_that_was_cut_is_read_up_to_there(bag, tmp_path):
    data = chunked(bag, tmp_path / "whole.mcap").read_bytes()
    assert rw.read(tmp_path / "whole.mcap").duration == pytest.approx(45.0, abs=0.1)
    for share in (0.9, 0.5):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[: int(share * len(data))])
        flight = rw.read(path)
        assert "cut off" in flight.warnings[0] and abs(flight.duration - 45.0 * share) < 3.0


@pytest.fixture(scope="module")
def arducopter(tmp_path_factory):
    """(DataFlash log's flight, rows of a bag as mavros records it)."""
    log, _ = made("ardupilot", tmp_path_factory.mktemp("apm"))
    flight = rw.read(log)
    return flight, ros2_bags.of_flight(flight)


@pytest.mark.parametrize("storage, definitions", [("mcap", True), ("sqlite", False)])
def test_mavros_is_turned_into_our_frames(arducopter, tmp_path, storage, definitions):
    flight, rows = arducopter
    found = rw.read(ros2_bags.write(tmp_path / "flight", rows, storage, definitions))
    shift = found.start_us * 1e-6 - 1_700_000_000.0
    assert found.autopilot == "ArduPilot" and found.facts["outputs"] == (1, 2, 3, 4)
    for name in ("motors", "gyro", "accel", "attitude", "velocity", "position", "battery"):
        one, two = flight[name], found[name]
        assert (one.unit, one.columns, one.frame) == (two.unit, two.columns, two.frame), name
        assert np.allclose(one.time, two.time + shift, rtol=0, atol=5e-6), name
        values = two.values
        if name == "attitude":
            values = values * np.sign(np.sum(values * one.values, axis=1, keepdims=True))
        assert np.allclose(one.values, values, atol=2e-6, rtol=1e-6), name
    assert [m.text for m in found.messages if m.kind == "landed"][-2:] == ["in the air", "landed"]
    with pytest.raises(VehicleError, match="--vehicle FILE"):
        rw.diagnose(found)


def test_the_diagnosis_of_mavros_is_that_of_the_dataflash_log(arducopter, tmp_path):
    flight, rows = arducopter
    craft = airframes.identify(flight)
    same = {k: flight.signals[k] for k in ("motors", "gyro", "accel", "rates", "attitude", "velocity", "position", "battery")}
    one = rw.diagnose(replace(flight, signals=same), vehicle=craft)
    two = rw.diagnose(ros2_bags.write(tmp_path / "flight", rows), vehicle=craft)
    assert one.verdict == two.verdict == "fault" and [e.rotors for e in two.events] == [e.rotors for e in one.events] == [(3,)]
    assert two.events[0].loss == pytest.approx(one.events[0].loss, abs=0.03)


@pytest.mark.parametrize("storage, definitions", [("mcap", True), ("sqlite", False)])
def test_a_fix_that_mavros_passes_on_is_read(arducopter, tmp_path, storage, definitions):
    rows, store, found = arducopter[1], ros2_bags.types(), []
    at = [row for row in rows if row[0] == "/mavros/rc/out"]
    for k in range(40):
        message = ros2_bags.blank(
            *(store, "sensor_msgs/msg/NavSatFix"), header=at[5 * k][3].header, latitude=47.0 + 1e-4 * k, longitude=8.0,
            altitude=400.0 + k, status=ros2_bags.blank(store, "sensor_msgs/msg/NavSatStatus", status=-1 if k < 3 else 0),
        )  # fmt: skip
        found.append(("/mavros/global_position/raw/fix", "sensor_msgs/msg/NavSatFix", at[5 * k][2], message))
    with_fix = rw.read(ros2_bags.write(tmp_path / "flight", [*rows, *found], storage, definitions))
    gps = with_fix["gps"]
    assert not gps.valid[:3].any() and gps.valid[3:, :3].all() and not gps.valid[:, 3].any()
    assert gps.values[10, :3] == pytest.approx([7 * 11.118, 0.0, -7.0], abs=0.01)
    assert with_fix.duration == rw.read(ros2_bags.write(tmp_path / "without", rows, storage, definitions)).duration


def test_odometry_gives_the_same_velocity():
    """Body velocity forward of a vehicle that faces east and climbs: east and up."""
    q = np.array([[0.0, 0.0, 0.0, 1.0]])  # ROS: facing east
    assert np.allclose(mavros.turned(q) * np.sqrt(2), [[1, 0, 0, 1]])
    assert np.allclose(mavros._rotated(mavros.turned(q), np.array([[2.0, 0.0, -1.0]])), [[0.0, 2.0, -1.0]])


def test_mavros_gives_parameters_where_they_were_recorded(arducopter, tmp_path):
    rows = arducopter[1]
    store = ros2_bags.types()
    for k, (name, value) in enumerate((("FRAME_CLASS", 1), ("FRAME_TYPE", 1), ("SIM_SPEEDUP", 1), ("MOT_THST_EXPO", 0.61))):
        kind = {"type": 2, "integer_value": value} if isinstance(value, int) else {"type": 3, "double_value": value}
        message = ros2_bags.blank(
            *(store, "mavros_msgs/msg/ParamEvent"),
            header=rows[0][3].header,
            param_id=name,
            value=ros2_bags.blank(store, "rcl_interfaces/msg/ParameterValue", **kind),
        )
        rows = [*rows, ("/mavros/param/event", "mavros_msgs/msg/ParamEvent", rows[0][2] + k, message)]
    found = rw.read(ros2_bags.write(tmp_path / "flight", rows))
    assert found.parameters == {"FRAME_CLASS": 1.0, "FRAME_TYPE": 1.0, "MOT_THST_EXPO": pytest.approx(0.61)}
    assert airframes.identify(found).name == "ardupilot-quad-x"


def text(store, string="hello"):
    return store.types["std_msgs/msg/String"](string)


def test_what_is_no_flight_is_said_in_one_sentence(px4, tmp_path):
    store = ros2_bags.types()
    chatter = ros2_bags.write(tmp_path / "a", [("/chatter", "std_msgs/msg/String", 1, text(store))])
    with pytest.raises(LogError, match=r"no ROS 2 topic of PX4 .* its topics are /chatter"):
        rw.read(chatter)
    imu = ros2_bags.blank(store, "sensor_msgs/msg/Imu")
    with pytest.raises(LogError, match="record /mavros/rc/out"):
        rw.read(ros2_bags.write(tmp_path / "b", [("/robot/imu/data", "sensor_msgs/msg/Imu", 1, imu)]))
    database = tmp_path / "contacts.db3"
    import sqlite3

    with sqlite3.connect(database) as base:
        base.execute("CREATE TABLE people(name TEXT)")
    with pytest.raises(LogError, match="not a ROS 2 bag"):
        rw.read(database)


def test_a_bag_without_motor_commands_says_what_to_record(px4, tmp_path):
    rows = [r for r in px4[1] if "actuator" not in r[0] and "setpoint" not in r[0]]
    flight = rw.read(ros2_bags.write(tmp_path / "flight", rows))
    assert any("dds_topics.yaml" in w for w in flight.warnings) and not flight.has("motors")
    needed = [gap for gap in rw.info(flight)["missing"] if gap["signal"] == "motors"]
    assert len(needed) == 1 and "docs/foxglove.md" in needed[0]["setting"]


def test_of_several_vehicles_the_one_with_motors_is_read(px4, tmp_path):
    few = [r for r in px4[1] if "sensor_combined" not in r[0] and "esc" not in r[0]]
    other = [("/drone_2" + t, *rest) for t, *rest in few if "actuator" not in t]
    flight = rw.read(ros2_bags.write(tmp_path / "flight", [*few, *other]))
    assert flight.has("motors") and any("/ was read, drone_2 was not" in w for w in flight.warnings)


@pytest.mark.parametrize(
    "topic, expected",
    [
        ("/fmu/out/vehicle_status_v1", ("", "vehicle_status", 0, True)),
        ("/fmu/out/actuator_outputs_1", ("", "actuator_outputs", 1, True)),
        ("/fmu/out/actuator_controls_0", ("", "actuator_controls_0", 0, True)),
        ("/px4_1/fmu/in/actuator_motors", ("px4_1", "actuator_motors", 0, False)),
        ("/fmu/vehicle_attitude/out", ("", "vehicle_attitude", 0, True)),
        ("/VehicleAttitude_PubSubTopic", ("", "vehicle_attitude", 0, True)),
        ("/fmu/out/vehicle_odometry", None),
        ("/fmu/out/vehicle_attitude_groundtruth", None),
    ],
)
def test_names_of_topics(topic, expected):
    assert ros2.place(topic) == expected


def test_our_decoder_agrees_with_rosbags():
    """Strings, sequences, nested messages, every number and both byte orders, in messages of different lengths."""
    store = ros2_bags.types()
    kind = "mavros_msgs/msg/ESCTelemetry"
    rng = np.random.default_rng(1)
    header = store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"]
    messages = []
    for n in (0, 3, 4, 4, 1):
        items = [
            ros2_bags.blank(
                *(store, "mavros_msgs/msg/ESCTelemetryItem"),
                header=header(time(int(rng.integers(99)), 5), "x" * int(rng.integers(9))),
                voltage=float(np.float32(rng.normal())),
                rpm=int(rng.integers(-9999, 9999)),
                count=k,
            )
            for k in range(n)
        ]
        messages.append(store.types[kind](header(time(7, 8), "é" * n), items))
    definition = store.generate_msgdef(kind, ros_version=2)[0]
    for little in (True, False):
        payloads = [bytes(store.serialize_cdr(m, kind, little_endian=little)) for m in messages]
        payloads.insert(2, payloads[1][:-9])  # cut
        columns, rows = cdr.decode(payloads, cdr.parse(definition, kind), kind)
        assert rows.tolist() == [0, 1, 3, 4, 5]
        assert columns["header.frame_id"].tolist() == [m.header.frame_id for m in messages]
        for i, m in enumerate(messages):
            for k, item in enumerate(m.esc_telemetry):
                at = f"esc_telemetry[{k}]"
                assert columns[f"{at}.rpm"][i] == item.rpm and columns[f"{at}.count"][i] == k
                assert columns[f"{at}.voltage"][i] == item.voltage and columns[f"{at}.header.stamp.sec"][i] == item.header.stamp.sec
                assert columns[f"{at}.header.frame_id"][i] == item.header.frame_id
        assert np.isnan(columns["esc_telemetry[3].rpm"][[0, 1, 4]]).all()


@pytest.mark.parametrize("line", ["uint8[", "Thing[] x", "nonsense", "A[99999] x"])
def test_definitions_that_cannot_be_are_refused(line):
    loop = "\n===\nMSG: p/A\nuint64[999999999] y\nA a\n"
    with pytest.raises(cdr.Unreadable):
        cdr.decode([b"\0\1\0\0" + bytes(64)], cdr.parse(line + loop, "p/msg/T"), "p/msg/T")


@pytest.mark.parametrize("storage", ["mcap", "sqlite"])
def test_damaged_bags_are_read_or_refused_politely(px4, tmp_path, storage):
    rows = [r for r in px4[1] if "sensor_combined" not in r[0] and "esc" not in r[0]]
    folder = ros2_bags.write(tmp_path / "flight", rows[::7], storage)
    file = chunked(folder, tmp_path / "small.mcap") if storage == "mcap" else next(folder.glob("*.db3"))
    outcomes, failures = fuzzing.anywhere(file, 60, seed=5)
    assert failures == [] and sum(outcomes.values()) == 60 and outcomes["read with warnings"] > 0


ENDLESS = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"
TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
COMPUTED = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB AS (zeroblob(1000000)))"
ATTITUDE = "INSERT INTO topics VALUES (1, '/fmu/out/vehicle_attitude', 'px4_msgs/msg/VehicleAttitude', 'cdr')"


def database(path, *statements):
    with closing(sqlite3.connect(path)) as base:
        base.execute("PRAGMA page_size = 512")
        for statement in statements:
            base.execute(statement)
        base.commit()
    return path


def test_only_plain_tables_of_a_database_are_read(tmp_path):
    """Views may be endless, or say that they are tables, and computed columns may be of any size."""
    view = f"CREATE VIEW topics AS {ENDLESS} SELECT n AS id, 'x' AS name, 'y' AS type, 'json' AS serialization_format FROM c WHERE n < 0"
    messages = f"CREATE VIEW messages AS {ENDLESS} SELECT n AS rowid, 1 AS topic_id, 1 AS timestamp, zeroblob(1000000) AS data FROM c"
    named = "UPDATE sqlite_master SET type = 'table', rootpage = 2 WHERE name = 'topics'"
    columns = "'x' AS topic_type, 'y' AS encoded_message_definition, 'ros2msg' AS encoding"
    defined = f"CREATE VIEW message_definitions AS {ENDLESS} SELECT {columns} FROM c"
    for k, statements in enumerate(
        [
            (view, MESSAGES),
            (MESSAGES, view, "PRAGMA writable_schema = ON", named),
            (TOPICS, ATTITUDE, messages),
            (TOPICS, ATTITUDE, COMPUTED),
        ]
    ):
        path = database(tmp_path / f"{k}.db3", *statements)
        for source in (path, path.read_bytes()):
            with pytest.raises(LogError, match="not a ROS 2 bag, or is too damaged"):
                bag_storage.read_sqlite(source, bag_storage.Bag(ros2._wanted, 1 << 28))
    bag = bag_storage.Bag(ros2._wanted, 1 << 28)
    bag_storage.read_sqlite(database(tmp_path / "x.db3", TOPICS, MESSAGES, ATTITUDE, defined), bag)
    assert list(bag.topics) == ["/fmu/out/vehicle_attitude"] and bag.topics["/fmu/out/vehicle_attitude"].definition == ""


def circular(path, topic):
    """A table of one row whose pages are each the child of another one seventy times, eight levels deep."""
    data = bytearray(database(path, TOPICS, MESSAGES, ATTITUDE, f"INSERT INTO messages VALUES (1, {topic}, 1, x'00010000')").read_bytes())
    with closing(sqlite3.connect(path)) as base:
        ((root,),) = base.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
    leaf, last = bytes(data[(root - 1) * 512 : root * 512]), len(data) // 512
    children, pages = range(last + 1, last + 9), {last + 8: leaf}
    for page, child in zip([root, *children], children):
        cells = b"".join(child.to_bytes(4, "big") + b"\x01" for _ in range(70))
        head = b"\x05\0\0" + (70).to_bytes(2, "big") + (512 - len(cells)).to_bytes(2, "big") + b"\0" + child.to_bytes(4, "big")
        places = b"".join((512 - len(cells) + 5 * k).to_bytes(2, "big") for k in range(70))
        pages[page] = (head + places).ljust(512 - len(cells), b"\0") + cells
    data += bytes(512 * 8)
    for page, content in pages.items():
        data[(page - 1) * 512 : page * 512] = content
    data[28:32] = (len(data) // 512).to_bytes(4, "big")
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("topic", [1, 2])
def test_a_database_that_never_ends_is_given_up_and_lets_signals_in(tmp_path, topic, monkeypatch):
    path = circular(tmp_path / "x.db3", topic)
    assert path.stat().st_size < 20_000
    with pytest.raises(LogError, match="decompresses to more than 16 MB" if topic == 1 else "takes too long to read for its size"):
        bag_storage.read_sqlite(path, bag_storage.Bag(ros2._wanted, 1 << 24))
    monkeypatch.setattr(bag_storage, "STEPS_BESIDES", 1 << 60)
    if hasattr(signal, "setitimer"):
        with pytest.raises(incoming.TooLong), incoming.within(0.2):
            bag_storage.read_sqlite(path, bag_storage.Bag(ros2._wanted, 1 << 60))


def mcap(*records):
    """A file of one topic with these records: (kind, content)."""

    def text(value):
        return struct.pack("<I", len(value)) + value

    known = (3, struct.pack("<H", 1) + text(b"px4_msgs/msg/VehicleAttitude") + text(b"ros2msg") + text(b"uint64 timestamp\nfloat32[4] q"))
    channel = (4, struct.pack("<HH", 1, 1) + text(b"/fmu/out/vehicle_attitude") + text(b"cdr") + text(b""))
    whole = ((1, text(b"ros2") + text(b"")), known, channel, *records)
    return bag_storage.MCAP + b"".join(bytes([kind]) + struct.pack("<Q", len(data)) + data for kind, data in whole)


def message(data):
    return 5, struct.pack("<HIQQ", 1, 0, 1, 1) + data


def chunk(packing, packed, declared):
    name = struct.pack("<I", len(packing)) + packing.encode()
    return 6, struct.pack("<QQQI", 0, 0, declared, 0) + name + struct.pack("<Q", len(packed)) + packed


def test_what_an_mcap_file_unfolds_to_is_limited(monkeypatch):
    """By what a chunk declares, by what it really holds, by all messages together, and by each that is packed for itself."""
    zstandard, lz4 = pytest.importorskip("zstandard"), pytest.importorskip("lz4.frame")
    kind, body = message(bytes(4 << 20))
    record = bytes([kind]) + struct.pack("<Q", len(body)) + body
    squeezed = {"zstd": zstandard.ZstdCompressor().compress(record), "lz4": lz4.compress(record)}
    packer = zstandard.ZstdCompressor().compressobj(size=1 << 32)
    claims = packer.compress(bytes(1000)) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)  # 4 GB, it says
    small = struct.pack("<BQ", 5, 22 + 30) + message(bytes(30))[1]
    many = zstandard.ZstdCompressor().compress(small * 40_000)
    monkeypatch.setattr(container, "SLACK", 3 << 20)
    large = [(chunk("zstd", many, 40_000 * len(small)),) * 2, (chunk("zstd", claims, 1 << 32),)]
    large += [(chunk(name, data, len(record)),) for name, data in squeezed.items()]
    damaged = [(chunk(name, data, 1000),) for name, data in squeezed.items()]
    damaged += [(chunk("zstd", claims, 1000),), (message(claims),)]
    tracemalloc.start()
    try:
        for records, words in [*((r, "decompresses to more than 3 MB") for r in large), *((r, "none could be read") for r in damaged)]:
            with pytest.raises(LogError, match=words):
                ros2.read(io.BytesIO(mcap(*records)).getbuffer(), "x.mcap")
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()
    bag = bag_storage.Bag(ros2._wanted, 1 << 30)
    bag_storage.read_mcap(mcap(chunk("zstd", squeezed["zstd"], len(record))), bag)
    assert [len(p) for t in bag.topics.values() for p in t.payloads] == [4 << 20]
