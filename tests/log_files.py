"""Logs of one machine in every format, each written by the format's own reference library."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

BEGIN = 1_700_000_000 * 10**9
"""The time of the first sample in ns."""
COUNT, RATE = 300, 100
"""Samples at 100 Hz."""
TIMES = np.arange(COUNT) / RATE
SPEED = 2.0 * TIMES
HEATER = (TIMES >= 1.0).astype(float)
PLANT = """
std_msgs/Header header
float64 speed
float32[3] flows
bool heater
Tank[] tanks
================================================================================
MSG: plant_msgs/Tank
string name
float64 level
"""
LATENCY = 4 * 10**6
"""Time in ns from the stamp of a message to its recording."""


def stamps() -> np.ndarray:
    """Times (n,) in ns."""
    return BEGIN + np.round(TIMES * 1e9).astype(np.int64)


def csv(path: Path) -> None:
    rows = [f"{t:.2f};{v:.4f};{h:.0f}" for t, v, h in zip(TIMES, SPEED, HEATER, strict=True)]
    text = "Test bench 3\n\nTime [s];speed [m/s];heater\n" + "\n".join(rows).replace(".", ",")
    path.write_text(text + "\n", encoding="utf-8")


def arrow_table() -> Any:
    import pyarrow as pa

    return pa.table(
        {
            "time": pa.array(stamps()).cast(pa.timestamp("ns", tz="UTC")),
            "speed [m/s]": SPEED,
            "heater": HEATER > 0,
            "state": pa.array([{"x": v, "name": "a"} for v in SPEED]),
            "remark": ["none"] * COUNT,
        }
    )


def parquet(path: Path) -> None:
    from pyarrow import parquet

    parquet.write_table(arrow_table(), path)


def feather(path: Path) -> None:
    from pyarrow import feather

    feather.write_feather(arrow_table(), path)


def arrow(path: Path) -> None:
    import pyarrow as pa

    table = arrow_table()
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, table.schema) as stream:
        stream.write_table(table)


def tdms(path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    begin = np.datetime64(BEGIN, "ns").astype("datetime64[us]")
    about = {"wf_increment": 1 / RATE, "wf_start_offset": 0.0, "wf_start_time": begin}
    with TdmsWriter(path) as writer:
        for part in (slice(0, 100), slice(100, None)):
            writer.write_segment(
                [
                    ChannelObject("bench", "speed", SPEED[part], {**about, "unit_string": "m/s"}),
                    ChannelObject("bench", "heater", HEATER[part].astype("u1"), about),
                ]
            )


def mdf(path: Path) -> None:
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        file.append([Signal(SPEED, TIMES, name="speed", unit="m/s")])
        file.append([Signal(HEATER.astype("u1"), TIMES, name="heater")])
        file.save(path, overwrite=True)


def ros_types() -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(PLANT, "plant_msgs/msg/Plant"))
    return types


def messages(types: Any) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of recording in ns, and message; the order of the joints changes."""
    known = types.types
    for k, stamp in enumerate(stamps().tolist()):
        time = known["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = known["std_msgs/msg/Header"](stamp=time, frame_id="")
        speed = {"shoulder": SPEED[k], "elbow": -SPEED[k]}
        names = ["shoulder", "elbow"][:: 1 if k % 2 else -1]
        yield (
            "/joint_states",
            stamp + LATENCY,
            known["sensor_msgs/msg/JointState"](
                header=header,
                name=names,
                position=np.array([speed[name] for name in names]),
                velocity=np.zeros(2),
                effort=np.zeros(0),
            ),
        )
        yield (
            "/plant",
            stamp + LATENCY,
            known["plant_msgs/msg/Plant"](
                header=header,
                speed=SPEED[k],
                flows=np.array([0, 1, SPEED[k]], np.float32),
                heater=bool(HEATER[k]),
                tanks=[known["plant_msgs/msg/Tank"](name=n, level=SPEED[k]) for n in ("a", "b")],
            ),
        )


def ros2_bag(path: Path, *, mcap: bool = False) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    types, connections = ros_types(), {}
    storage = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for topic, time, message in messages(types):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            writer.write(connections[topic], time, types.serialize_cdr(message, kind))


def mcap(path: Path) -> None:
    """MCAP with ROS 2 messages, JSON, and an encoding that is not read."""
    from mcap.writer import Writer

    types, channels = ros_types(), {}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        for topic, time, message in messages(types):
            kind = message.__msgtype__
            if topic not in channels:
                text, _ = types.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(types.serialize_cdr(message, kind))
            writer.add_message(channels[topic], time, data, time)
        own = writer.register_channel(
            "/heating", "json", writer.register_schema("heating", "jsonschema", b"{}")
        )
        for time, power in zip(stamps().tolist(), HEATER, strict=True):
            text = json.dumps({"heater": {"power": power, "names": ["x"]}}).encode()
            writer.add_message(own, time, text, time)
        other = writer.register_channel("/camera", "protobuf", 0)
        writer.add_message(other, BEGIN, b"\x00", BEGIN)
        writer.finish()


SPEEDS = {
    "a.csv": (csv, "speed", "heater"),
    "a.parquet": (parquet, "speed", "heater"),
    "a.feather": (feather, "speed", "heater"),
    "a.arrow": (arrow, "speed", "heater"),
    "a.tdms": (tdms, "bench/speed", "bench/heater"),
    "a.mf4": (mdf, "speed", "heater"),
    "a.mcap": (mcap, "/joint_states.position[shoulder]", "/heating.heater.power"),
    "bag": (ros2_bag, "/plant.speed", "/plant.heater"),
}
"""By the name of a log: what writes it, and the names of two signals in it."""
