"""A ULog as the tables that Flight Review v2 makes of it (crates/converter/src/converter.rs and metadata.rs): a table of each topic and
instance, `timestamp` first, the others by name, booleans and letters in types of their own, no nulls, ZSTD."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyulog import ULog

LEVELS = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG")


def convert(path, folder):
    """Write the tables and metadata.json of a ULog into a folder, which is made; returns it."""
    log = ULog(str(path))
    folder.mkdir()
    for data in log.data_list:
        kinds = {field.field_name: field.type_str for field in data.field_data}
        names = sorted(data.data, key=lambda name: (name != "timestamp", name))
        arrays = [_array(np.asarray(data.data[name]), kinds[name]) for name in names]
        schema = pa.schema([pa.field(name, array.type, nullable=False) for name, array in zip(names, arrays)])
        name = f"{data.name}_{data.multi_id}" if data.multi_id else data.name
        pq.write_table(pa.Table.from_arrays(arrays, schema=schema), folder / f"{name}.parquet", compression="zstd")
    texts = [
        {"level": LEVELS[m.log_level - ord("0")], "timestamp_us": m.timestamp, "message": m.message} for m in log.logged_messages
    ]  # fmt: skip
    about = {
        "sys_name": "PX4", "ver_hw": log.msg_info_dict.get("ver_hw"), "ver_sw": log.msg_info_dict.get("ver_sw"),
        "sys_uuid": log.msg_info_dict.get("sys_uuid"), "ver_sw_release_str": None, "start_timestamp_us": log.start_timestamp,
        "parameters": log.initial_parameters, "logged_messages": texts, "tagged_logged_messages": [], "analysis": {"diagnostics": []},
    }  # fmt: skip
    (folder / "metadata.json").write_text(json.dumps(about))
    (folder / "manifest.json").write_text(json.dumps({"version": 1, "source": path.name, "topics": {}, "diagnostics": []}))
    return folder


def _array(values, kind):
    if kind == "bool":
        return pa.array(values.astype(bool))
    return pa.array([chr(value) for value in values]) if kind == "char" else pa.array(values)
